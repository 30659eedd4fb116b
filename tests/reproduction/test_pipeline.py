"""The reproduction: its trainings, its results, its claims, its folder."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from modgnn_rl.configs.schema import FlockingConfig, ReproduceConfig, ScaleConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.reporting.table import as_csv
from modgnn_rl.reproduce import main
from modgnn_rl.reproduction.claims import CLAIMS, Claim, Operand, check_claim, claim_tables
from modgnn_rl.reproduction.folder import claim_folder
from modgnn_rl.reproduction.jobs import JobResults, run_jobs
from modgnn_rl.reproduction.measurements import VALIDATION, Results
from modgnn_rl.reproduction.pages import write_study
from modgnn_rl.reproduction.paper_tables import paper_tables, published
from modgnn_rl.reproduction.pipeline import jobs_of
from modgnn_rl.reproduction.store import ResultStore
from modgnn_rl.reproduction.studies import EvalSetting, ModelVariant, Study, equal_hidden, study_of
from modgnn_rl.tracking.loading import load_policy

TINY = ScaleConfig(
    name="tiny", episodes=4, steps=30, val_episodes=2, updates=6, batch_size=4, eval_episodes=2, eval_steps=8,
    sizes=[32], dagger_rounds=1, mappo_rounds=1, num_envs=2, study_updates=4,
    study_episodes=2, study_steps=8, study_sizes=[4, 32],
)  # fmt: skip
WORLD = EvalSetting("N32", 32, 2, 8)


@pytest.fixture(scope="module")
def reproduction(tmp_path_factory):
    """Two GCNs trained side by side, and Central, all measured."""
    folder = tmp_path_factory.mktemp("reproduction")
    config = ReproduceConfig(scale=TINY)
    study = Study(
        "tables",
        [ModelVariant("gcn", 1), ModelVariant("gcn", 2), ModelVariant("central", 1)],
        [WORLD],
        TINY.updates,
        32,
    )
    outcome = run_jobs(folder / "jobs", jobs_of(config, study, folder))
    assert not outcome.failures
    return folder, config, study, outcome


def test_models_trained_apart_see_the_same_batches_as_side_by_side(reproduction, tmp_path):
    """Else the rows of the tables, which are trained in groups, would not be comparable."""
    folder, config, _, outcome = reproduction
    alone = Study("alone", [ModelVariant("gcn", 2)], [], TINY.updates, 32)
    (tmp_path / "dataset").symlink_to(folder / "dataset")
    jobs = [job for job in jobs_of(config, alone, tmp_path) if "validation" not in job.name]
    apart = run_jobs(tmp_path / "jobs", jobs)
    (mine,) = (tmp_path / result["policies"]["gcn-K2"] for result in apart.results.values() if "policies" in result)
    beside = folder / outcome.results["tables-cloning-gcn-K12-seed0"]["policies"]["gcn-K2"]
    for name, weights in load_policy(mine).state_dict().items():
        torch.testing.assert_close(weights, load_policy(beside).state_dict()[name])


def test_a_second_run_computes_only_what_is_missing(reproduction, monkeypatch):
    folder, config, study, outcome = reproduction
    missing = "tables-cloning-gcn-K2-seed0-N32"
    store = ResultStore(folder / "jobs")
    store.write("tables-cloning", missing, None)
    write, written = ResultStore.write, []

    def record(self, group, job, entry):
        written.append(job)
        write(self, group, job, entry)

    monkeypatch.setattr(ResultStore, "write", record)
    again = run_jobs(folder / "jobs", jobs_of(config, study, folder))
    assert again.results == outcome.results
    assert set(written) == {missing}


def test_the_references_have_the_errors_that_they_must_have(reproduction):
    _, config, study, outcome = reproduction
    measured = Results(outcome, config, study)
    for env_config in (VALIDATION, "N32"):
        expert, local, idle = (
            measured.values(name, env_config, "error") for name in ("expert", "local expert (1 hop)", "zero action")
        )
        assert expert.max() == 0
        assert (idle <= config.env.max_speed**2 / 3 + 1e-6).all()
        assert (local < idle).all()
        assert expert.shape == local.shape == (1, 2)


@torch.no_grad()
def test_validation_is_the_error_at_the_states_of_the_expert(reproduction):
    """An independent way to the same number: step by step, the policy's action written beside the expert's."""
    from tensordict import TensorDict

    from modgnn_rl.data.dataset import EpisodeDataset

    folder, config, study, outcome = reproduction
    policy = load_policy(folder / outcome.results["tables-cloning-gcn-K12-seed0"]["policies"]["gcn-K2"])
    dataset = EpisodeDataset.open(folder / "dataset")
    state = None
    errors = []
    for step in range(dataset.steps):
        now = dataset.windows(torch.tensor([4 * dataset.steps + step]), 1)[:, 0]  # the first held-out rollout
        messages = {} if state is None else dict(state["next"].items())
        seen = policy(TensorDict({**now.to_dict(), **messages}, now.batch_size))
        difference = seen["agents", "action"] - now["agents", "expert_action"]
        errors.append(float(difference[0, 1:].square().mean()))
        state = seen
    found = Results(outcome, config, study).values(ModelVariant("gcn", 2), VALIDATION, "error")
    assert found[0, 0] == pytest.approx(np.mean(errors), rel=1e-4)  # all 30 states are fewer than the 50 taken


def test_page_tables_and_report_are_written(reproduction):
    folder, config, study, outcome = reproduction
    page = write_study(Results(outcome, config, study), folder)
    text = page.with_name("tables.md").read_text()
    assert page.name == "report.html"
    for name in ("Table 1", "Table 2", "Table 3", "orderings", "zero action", "Central", "0.267"):
        assert name in text
    assert {"table1.csv", "table1.tex", "table3.csv", "claims.tex"} <= {file.name for file in page.parent.iterdir()}


def test_additional_models_are_rows_beside_the_papers():
    config = ReproduceConfig(scale=TINY, models=["gcn", "pair_force"], hops=[1, 4])
    study = study_of(config)
    further = [variant for variant in study.variants if variant not in study_of(ReproduceConfig(scale=TINY)).variants]
    assert further == [ModelVariant("gcn", 4), ModelVariant("pair_force", 1), ModelVariant("pair_force", 4)]
    measured = Results(JobResults({}, {}, {}), config, study)
    rows = [line.partition(",")[0] for line in as_csv(paper_tables(measured)["table1"]).splitlines()]
    assert rows[-1] == '"pair_force'
    assert set(further) < set(study_of(dataclasses.replace(config, study="range")).variants)


def test_without_further_models_nothing_needs_to_be_set():
    check(ReproduceConfig())
    assert len(study_of(ReproduceConfig()).variants) == 16
    one = ReproduceConfig(models="pair_force", hops=2)
    check(one)
    assert study_of(one).variants[16:] == [ModelVariant("pair_force", 2)]


def test_failed_jobs_are_shown_in_the_tables(reproduction, tmp_path):
    _, config, study, outcome = reproduction
    lost = {name: result for name, result in outcome.results.items() if "gcn-K1-" not in name}
    broken = JobResults(lost, outcome.seconds, {"tables-cloning-gcn-K1-seed0-N32": "no luck"})
    page = write_study(Results(broken, config, study), tmp_path).with_name("tables.md").read_text()
    assert "Failed: tables-cloning-gcn-K1-seed0-N32: no luck." in page
    row = next(line for line in page.splitlines() if line.startswith("| GCN, K = 1") and "0.363" in line)
    assert "failed" in row


@pytest.mark.parametrize(
    "study", ["tables", *(pytest.param(study, marks=pytest.mark.slow) for study in ("range", "faults"))]
)
def test_where_all_failed_the_page_says_so(tmp_path, study):
    config = ReproduceConfig(scale=TINY, study=study)
    measured = Results(JobResults({}, {}, {"dataset": "the disk is full"}), config, study_of(config))
    page = write_study(measured, tmp_path).with_name("tables.md").read_text()
    assert "Failed: dataset: the disk is full." in page
    assert "failed" in page


def test_the_papers_figures_are_in_the_package():
    tables = published()
    assert tables["validation_loss"]["gcn"][3] == 0.657
    assert tables["model_evaluation"]["expert"]["inf"]["leader_distance"] == [3.55, 3.96]
    assert tables["generalization"]["no_mid"][1][16] == 0.237


class Paper:
    """Results that say what the paper's tables say: every rollout of a row has the paper's mean."""

    config = ReproduceConfig(seeds=3)

    def values(self, row, env_config, figure):  # noqa: D102
        if env_config == VALIDATION:
            entry = published()["validation_loss"][row.model][row.hops]
        elif env_config == "N32":
            there = published()["model_evaluation"][row.model][row.hops]
            name, _, part = figure.partition("_s")
            mean, deviation = (there["error"], 0.0) if figure == "error" else there[name]
            entry = {"pread": deviation, "quare": mean**2 + deviation**2}.get(part, mean)
        else:
            entry = published()["generalization"][row.model][row.hops][int(env_config[1:])]
        return np.full((3, 5), entry)


def test_every_claim_holds_of_the_papers_own_figures():
    assert {check_claim(claim, Paper())[0] for claim in CLAIMS} == {"holds"}


def test_margins_of_the_papers_own_figures_are_those_in_its_text():
    """At least 42 % in error; 25, 33 and 72 % in the std of separation, which its rounded table gives as 32."""
    rows = claim_tables(Paper())["margins"].rows
    assert [row[1] for row in rows] == [row[2] for row in rows] == ["46% lower", "42% lower", "46% lower"]
    assert [row[3] for row in rows] == [row[4] for row in rows] == ["25% lower", "32% lower", "72% lower"]


def test_a_claim_is_reversed_undecided_or_not_measured():
    rollouts = {"gcn": [[1.0, 2, 3, 4, 5, 6]], "no_mid": [[2.0, 3, 4, 5, 6, 7]], "no_pre": [[2.0, 1, 4, 3, 6, 5]]}

    class Made:
        def values(self, row, env_config, figure):
            found = rollouts.get(row.model)
            return None if found is None else np.array(found)

    def word(*pairs):
        claim = Claim("", tuple((Operand(better, (1,)), Operand(worse, (1,))) for better, worse in pairs))
        return check_claim(claim, Made())[0]

    assert word(("gcn", "no_mid")) == "holds"
    assert word(("no_mid", "gcn")) == "does not hold"
    assert word(("gcn", "no_pre")) == "undecided"
    assert word(("gcn", "central")) == "not measured"
    assert word(("gcn", "no_mid"), ("gcn", "no_pre")) == "undecided"
    assert word(("gcn", "no_pre"), ("no_mid", "gcn"), ("gcn", "central")) == "does not hold"


def test_studies_at_equal_parameters_have_equal_parameters():
    from modgnn_rl.models.factory import make_model

    def size(variant):
        model = make_model(variant.model, variant.hops, variant.hidden, layers=variant.layers, seed=0)
        return sum(weights.numel() for weights in model.parameters())

    sizes = [size(variant) for variant in study_of(ReproduceConfig(study="layers")).variants]
    assert max(sizes) < 1.06 * min(sizes)
    assert equal_hidden("modgnn_mlp", 1, 1) == 32


@pytest.mark.parametrize("study", ["tables", "communication", "layers", "range", "faults", "size"])
def test_jobs_of_every_study_have_unique_names_and_known_dependencies(study, tmp_path):
    config = ReproduceConfig(study=study, after="mappo", seeds=2)
    jobs = jobs_of(config, study_of(config), tmp_path)
    names = [job.name for job in jobs]
    assert len(set(names)) == len(names)
    assert {need for job in jobs for need in job.depends_on} <= set(names)
    assert all(math.isfinite(job.cost) and job.cost > 0 for job in jobs)


def test_a_folder_keeps_to_its_settings(tmp_path):
    folder = str(tmp_path / "one")
    config = ReproduceConfig(folder=folder, env=FlockingConfig(leader_max_speed=math.inf))
    assert claim_folder(config) == claim_folder(dataclasses.replace(config, seeds=5, study="range", after="dagger"))
    changed = dataclasses.replace(config, scale=dataclasses.replace(config.scale, updates=7))
    with pytest.raises(InputError, match=r"was started with scale.updates=6000"):
        claim_folder(changed)
    (tmp_path / "one" / "settings.json").write_text("{")
    with pytest.raises(InputError, match="damaged"):
        claim_folder(config)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        claim_folder(dataclasses.replace(config, folder=str(tmp_path / "file" / "below")))


def test_a_folder_beside_the_user_is_meant_from_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert claim_folder(ReproduceConfig()) == tmp_path / "reproduction" / "small"
    assert claim_folder(ReproduceConfig(folder="mine")) == tmp_path / "mine"  # runs know themselves by absolute paths


def test_a_world_that_no_dataset_can_hold_is_refused_before_anything_is_made(tmp_path):
    folder = tmp_path / "one"
    config = ReproduceConfig(folder=str(folder), env=FlockingConfig(position_noise=0.1))
    with pytest.raises(InputError, match=r"env\.position_noise=0\.1"):
        main(config)
    assert not folder.exists()
