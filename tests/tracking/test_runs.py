"""The list of runs and their comparison, on folders that the writers of run folders have made."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from modgnn_rl.configs.schema import BCConfig, DAggerConfig, MAPPOConfig, ModelConfig, RunsConfig, TrainConfig
from modgnn_rl.errors import InputError
from modgnn_rl.registry import METRICS
from modgnn_rl.runs import find_run, show_runs
from modgnn_rl.tracking import reader
from modgnn_rl.tracking.comparison import compare, differing_settings
from modgnn_rl.tracking.listing import list_runs
from modgnn_rl.tracking.reader import last_records
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.tracking.summary import find_runs, summarise_run

YAML: dict[str, str] = {}
ERRORS = [0.9, 0.8, 0.4, 0.3, 0.2, 0.1]


def stored(trainer):
    """The configuration of a run, as YAML, made once."""
    if (key := repr(trainer)) not in YAML:
        YAML[key] = OmegaConf.to_yaml(
            OmegaConf.structured(TrainConfig(model=ModelConfig(name="moment_force"), trainer=trainer))
        )
    return YAML[key]


def make_run(root, name="dagger-gcn", *, state="finished", trainer=None, metrics=None, **status):
    """A run folder as a trainer leaves it, with a metric of two sizes."""
    run = RunFolder.create(root, name, stored(trainer or DAggerConfig(rounds=10)))
    run.note_status(state, **{"done": 30, "total": 40, "unit": "updates", "seconds": 10.0, **status})
    for step, error in enumerate(ERRORS):
        run.log(step, metrics or {"error": error, "8/validation_loss": error, "16/validation_loss": 3 * error})
    return run


def write_evaluation(run, rows, sizes=(8,), changes=""):
    """Tables with the given mean error of each row."""

    def row(error):
        spread = {"mean": error, "std": 0.1, "median": error, "low": error - 0.1, "high": error + 0.1, "n": 5}
        fractions = {name for name, entry in METRICS.items() if entry.options["unit"] == "%"}
        return {name: {"mean": 0.25, "n": 5} if name in fractions else spread for name in METRICS}

    settings = {"num_flocks": 5, "steps": 40, "seed": 0}
    tables = {str(size): {**settings, "rows": {name: row(error) for name, error in rows.items()}} for size in sizes}
    run.write(f"evaluation{changes}.json", json.dumps(tables))


def test_summaries_show_the_logged_metrics(tmp_path):
    run = make_run(tmp_path)
    run.log(len(ERRORS), {"error": math.nan, "8/validation_loss": 7.0, "16/validation_loss": math.nan})
    found = summarise_run(run.path)
    assert found.last["error"] == ERRORS[-1]
    assert found.recent["error"] == pytest.approx(np.mean(ERRORS[-5:]))
    assert found.last["validation_loss"] == pytest.approx(2 * ERRORS[-1])
    assert "reward" not in found.last
    assert (found.state, found.share, found.speed, found.round, found.rounds) == ("finished", 0.75, 3.0, 6, 10)


@pytest.mark.parametrize(("trainer", "best"), [(DAggerConfig(), -0.3), (MAPPOConfig(), 0.3), (BCConfig(), -0.3)])
def test_a_score_is_shown_as_the_metric_it_comes_from(tmp_path, trainer, best):
    run = make_run(tmp_path, trainer=trainer)
    (run.best / "step_000000005").mkdir(parents=True)
    (run.best / "step_000000005" / "state.json").write_text('{"score": -0.3}')
    (run.best / "step_000000006.tmp").mkdir()
    (run.best / "step_000000006.tmp" / "state.json").write_text('{"sco')
    assert summarise_run(run.path).best == best


@given(st.lists(st.integers(0, 60), max_size=12), st.integers(1, 5), st.integers(1, 200), st.booleans())
def test_the_last_lines_are_those_of_the_whole_file(tmp_path_factory, lengths, count, block, cut):
    file = tmp_path_factory.mktemp("metrics") / "metrics.jsonl"
    records = [{"step": step, "text": "x" * length} for step, length in enumerate(lengths)]
    file.write_text("".join(json.dumps(record) + "\n" for record in records) + ('{"step": 99' if cut else ""))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reader, "BLOCK", block)
        assert last_records(file, count) == records[-count:]


def test_a_run_trains_as_long_as_its_lock_is_held(tmp_path):
    run = make_run(tmp_path, state="training")
    assert summarise_run(run.path).state == "killed"
    with run.lock():
        assert summarise_run(run.path).state == "training"
        assert run.is_locked
    assert summarise_run(run.path).state == "killed"


def test_a_run_that_trains_is_as_far_as_its_metrics(tmp_path):
    run = make_run(tmp_path, state="training", done=1, total=100)
    later = time.time() + 50
    os.utime(run.metrics_file, (later, later))
    assert summarise_run(run.path).share == 0.01
    with run.lock():
        found = summarise_run(run.path)
    assert found.share == 0.5
    assert found.seconds == pytest.approx(60, abs=2)


def test_the_reason_is_that_of_the_last_time_it_ended(tmp_path):
    run = make_run(tmp_path, state="stopped", reason="stopped by SIGTERM")
    assert "stopped by SIGTERM" in show_runs(RunsConfig(runs=str(tmp_path)))
    run.note_status("finished")
    assert "SIGTERM" not in show_runs(RunsConfig(runs=str(tmp_path)))


def test_the_last_line_says_what_to_do_next(tmp_path):
    def last_line():
        return show_runs(RunsConfig(runs=str(tmp_path))).splitlines()[-1]

    first = make_run(tmp_path, "first").path
    assert last_line() == f"Next: python -m modgnn_rl.evaluate run={first}"
    second = make_run(tmp_path, "second").path
    assert last_line() == f"Next: python -m modgnn_rl.runs 'compare=[{first},{second}]'"
    stopped = make_run(tmp_path, "third", state="stopped").path
    assert last_line() == f"Next: python -m modgnn_rl.train resume={stopped}"


def test_listing_and_comparing_change_no_file(tmp_path):
    with make_run(tmp_path, state="training").lock():
        write_evaluation(make_run(tmp_path, "bc-gcn"), {"moment_force": 0.5})

        def content():
            return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in tmp_path.rglob("*")}

        before = content()
        show_runs(RunsConfig(runs=str(tmp_path)))
        show_runs(RunsConfig(runs=str(tmp_path), compare=["dagger", "bc"]))
        assert content() == before


def test_several_policies_are_listed_under_their_run(tmp_path):
    names = ("gcn-K1", "gcn-K2")
    metrics = {"validation_loss": 0.4} | {
        f"{n}/{s}/validation_loss": i + s for i, n in enumerate(names) for s in (1, 3)
    }
    run = make_run(tmp_path, "bc-gcn", state="stopped", trainer=BCConfig(models=["gcn"], hops=[1, 2]), metrics=metrics)
    write_evaluation(run, {"gcn-K1": 0.5, "gcn-K2": 0.6, "expert": 0.0})
    found = summarise_run(run.path)
    assert [policy.name for policy in found.policies] == [f"{run.path.name}/{name}" for name in names]
    assert [policy.last["validation_loss"] for policy in found.policies] == [2, 3]
    assert [policy.evaluations["8 agents"]["error"]["mean"] for policy in found.policies] == [0.5, 0.6]
    assert found.last["validation_loss"] == 0.4
    text = list_runs([found], 100)
    assert text.splitlines()[2].split() == ["gcn-K1", "loss", "2", "-", "0.5", "0.5"]
    for name in names:
        RunFolder.create_inside(run, name, OmegaConf.to_yaml(run.config))
    by_name, by_folder = find_run("gcn-K2", tmp_path), find_run(str(run.path / "gcn-K2"), tmp_path)
    assert by_name.path == by_folder.path == run.path / "gcn-K2"
    assert by_name.last == by_folder.last == {"validation_loss": 3}
    # What is resumed is the run.
    assert f"resume={run.path}\n" in show_runs(RunsConfig(runs=str(tmp_path), compare=["bc-gcn"])) + "\n"


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("config.yaml", "a: [", "config.yaml is damaged"),
        ("config.yaml", "3", "not the configuration of a run"),
        ("config.yaml", "schema_version: 99\nenv: {}", "schema_version 99, this program reads 2"),
        ("config.yaml", None, "no config.yaml"),
        ("evaluation.json", '{"8": {}}', "evaluation.json cannot be read"),
        ("evaluation.json", "{", "evaluation.json cannot be read"),
        ("status.json", "[]", "unknown"),
        ("metrics.jsonl", "[]\n3\n{", ""),
    ],
)
def test_unreadable_files_are_named(tmp_path, file, text, said):
    run, other = make_run(tmp_path), make_run(tmp_path, "other")
    write_evaluation(run, {"moment_force": 0.5})
    (run.path / file).unlink() if text is None else (run.path / file).write_text(text)
    listed = show_runs(RunsConfig(runs=str(tmp_path)))
    assert said in listed
    assert run.path.name in listed
    assert f"{other.path.name}  " in listed


def test_no_damage_ends_in_an_error(tmp_path):
    run = make_run(tmp_path, state="training")
    write_evaluation(run, {"moment_force": 0.5})
    files = ["config.yaml", "status.json", "metrics.jsonl", "evaluation.json"]
    whole = {file: (run.path / file).read_bytes() for file in files}

    @given(st.sampled_from(files), st.integers(0, 3000), st.binary(max_size=4), st.booleans())
    def damage(file, place, new, cut):
        place %= len(whole[file])
        rest = b"" if cut else whole[file][place + len(new) :]
        (run.path / file).write_bytes(whole[file][:place] + new + rest)
        for form in ("text", "json"):
            assert run.path.name in show_runs(RunsConfig(runs=str(tmp_path), format=form))
        (run.path / file).write_bytes(whole[file])

    damage()


def test_a_list_fits_the_terminal(tmp_path):
    runs = [make_run(tmp_path, "dagger-" + "long" * length, state="stopped") for length in (1, 4, 12)]
    for run in runs:
        write_evaluation(run, {"moment_force": 1.23456e-7})
    found = [summarise_run(run.path) for run in runs]
    for width in (60, 80, 100, 160):
        table, *_ = list_runs(found, width).split("\n\n")
        assert max(map(len, table.splitlines())) <= width
        assert len(table.splitlines()) == 4


def test_all_columns_are_shown_if_there_is_room(tmp_path):
    run = make_run(tmp_path, done=30)
    write_evaluation(run, {"moment_force": 0.5}, sizes=(8, 32))
    row = list_runs([summarise_run(run.path)], 160).splitlines()[1]
    assert row.split()[0] == run.path.name
    assert row.split()[-9:] == ["10", "s", "error", "0.1", "-", "0.5", "0.5", "3", "updates/s"]


def test_the_listed_evaluation_is_that_of_the_size_and_environment_of_training(tmp_path):
    run = make_run(tmp_path)  # 32 agents

    def shown():
        header, row, *_ = (
            line.split("|") for line in list_runs([summarise_run(run.path)]).splitlines() if "--" not in line
        )
        cells = dict(zip(map(str.strip, header), map(str.strip, row), strict=True))
        return [cells["eval."], cells["reward"]]

    write_evaluation(run, {"moment_force": 0.7}, changes="-wind=1")
    assert shown() == ["-", "-"]
    write_evaluation(run, {"moment_force": 0.5}, sizes=(8,))
    assert shown() == ["0.5", "0.5"]
    assert list(summarise_run(run.path).evaluations) == ["8 agents", "8 agents, wind=1"]
    tables = json.loads((run.path / "evaluation.json").read_text())
    write_evaluation(run, {"moment_force": 0.6}, sizes=(32,))
    tables |= json.loads((run.path / "evaluation.json").read_text())
    run.write("evaluation.json", json.dumps(tables))
    assert shown() == ["0.6", "0.6"]


def test_the_best_is_last(tmp_path):
    values = {"good": 0.1, "bad": 0.9, "middling": 0.5}
    for name, value in values.items():
        write_evaluation(make_run(tmp_path, name, metrics={"error": value, "reward": value}), {"moment_force": value})

    def names(sort):
        found = json.loads(show_runs(RunsConfig(runs=str(tmp_path), sort=sort, format="json")))
        return [run["name"].rpartition("-")[2] for run in found]

    assert names("error") == names("evaluation") == ["bad", "middling", "good"]
    assert names("reward") == ["good", "middling", "bad"]


def test_only_the_states_asked_for_are_listed(tmp_path):
    for state in ("finished", "stopped", "failed"):
        make_run(tmp_path, state, state=state)
    found = json.loads(show_runs(RunsConfig(runs=str(tmp_path), state=["stopped", "failed"], format="json")))
    assert {run["state"] for run in found} == {"stopped", "failed"}


def test_runs_in_groups_are_found_and_folders_inside_runs_are_not(tmp_path):
    inside = make_run(tmp_path / "sweep", "dagger")
    RunFolder.create_inside(inside, "gcn-K2", "seed: 0\n")
    assert find_runs(tmp_path) == [inside.path]
    assert find_runs(inside.path) == [inside.path]
    assert show_runs(RunsConfig(runs=str(tmp_path))).splitlines()[1].startswith(f"sweep/{inside.path.name}")


def test_settings_are_compared_among_the_runs_that_have_them(tmp_path):
    trainers = [DAggerConfig(rounds=3), DAggerConfig(rounds=4), MAPPOConfig()]
    runs = [summarise_run(make_run(tmp_path, "run", trainer=trainer).path) for trainer in trainers]
    found = differing_settings(runs)
    assert found["trainer.rounds"] == [3, 4, 100]
    assert found["trainer.name"] == ["dagger", "dagger", "mappo"]
    assert not {"trainer.gate", "env.comm_range", "runs", "name"} & set(found)
    assert differing_settings(runs[:2]) == {"trainer.rounds": [3, 4]}


def test_a_comparison_is_markdown_with_a_column_for_each_run(tmp_path):
    first, second = make_run(tmp_path, "first"), make_run(tmp_path, "second", state="failed")
    write_evaluation(first, {"moment_force": 0.5, "expert": 0.0}, sizes=(8, 16))
    write_evaluation(second, {"moment_force": 0.75}, sizes=(16,))
    text = compare([summarise_run(run.path) for run in (first, second)])
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in rows} == {4}
    assert [line.split("|")[2].strip() for line in rows if " error [m²/s²] " in line] == ["0.5 [0.4, 0.6]"] * 2
    assert [line.split("|")[3].strip() for line in rows if " error [m²/s²] " in line] == ["-", "0.75 [0.65, 0.85]"]
    assert next(line.split("|")[2].strip() for line in rows if "| error [m²/s²]: mean of the last 5 " in line) == "0.36"
    assert text.endswith(f"resume={second.path}")
    assert "Settings that differ" not in text  # they do not


def test_a_run_is_found_by_a_unique_part_of_its_name(tmp_path):
    runs = [make_run(tmp_path, name) for name in ("dagger-gcn", "dagger-gcn_final", "bc-gcn")]
    assert find_run("bc", tmp_path).path == runs[2].path
    assert find_run(runs[0].path.name, tmp_path).path == runs[0].path  # a whole name, though part of another
    assert find_run(str(runs[1].path), tmp_path / "elsewhere").path == runs[1].path
    with pytest.raises(InputError, match="2 runs have 'dagger' in their names"):
        find_run("dagger", tmp_path)
    with pytest.raises(InputError, match=r"no run in .* has 'mappo' in its name"):
        find_run("mappo", tmp_path)
    with pytest.raises(InputError, match="give two or more"):
        show_runs(RunsConfig(runs=str(tmp_path), compare="bc"))
    (runs[2].path / "config.yaml").write_text("{")
    with pytest.raises(InputError, match=r"cannot be compared \(config.yaml is damaged\)"):
        find_run("bc", tmp_path)


def test_control_characters_are_not_printed(tmp_path):
    make_run(tmp_path, state="failed", reason="bad \x1b[2J news")
    assert "\x1b" not in show_runs(RunsConfig(runs=str(tmp_path)))


def command(*arguments, **options):
    """Run the command, without torch."""
    code = "import sys; sys.modules['torch'] = None; from modgnn_rl.cli.command import run_command as run; "
    code += "from modgnn_rl.runs import main, RunsConfig; run(main, RunsConfig, 'runs')"
    return subprocess.Popen([sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, text=True, **options)


def test_the_command_needs_no_torch_and_stops_at_a_closed_pipe(tmp_path):
    for number in range(3):
        make_run(tmp_path, f"run{number}")
    process = command(f"runs={tmp_path}", "format=json", stdout=subprocess.PIPE)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err, len(json.loads(out))) == (0, "", 3)
    reader, writer = os.pipe()
    os.close(reader)
    process = command(f"runs={tmp_path}", stdout=writer)
    os.close(writer)
    assert (process.communicate(timeout=60)[1], process.returncode) == ("", 141)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        show_runs(RunsConfig(runs=str(tmp_path / "missing")))
    assert show_runs(RunsConfig(runs=str(tmp_path))).endswith("python -m modgnn_rl.train starts one")


@pytest.mark.slow
def test_names_of_metrics_are_those_that_training_logs(tmp_path):
    from modgnn_rl.configs.schema import EvaluationConfig, FlockingConfig
    from modgnn_rl.experiment.training import train

    small = {"num_envs": 1, "cloning_steps": 10, "cloning_updates": 20, "batch_size": 16, "num_val_envs": 1}
    trainer = BCConfig(models=["moment_force", "gcn"], **small)
    settings = EvaluationConfig(num_flocks=2, steps=8)
    run = train(
        TrainConfig(FlockingConfig(num_agents=[4, 5]), trainer=trainer, evaluation=settings, runs=str(tmp_path))
    )
    found, last = summarise_run(run.path), run.read_metrics()[-1]
    assert (found.state, found.share) == ("finished", 1.0)
    assert found.last["validation_loss"] == last["validation_loss"]
    tables = json.loads((run.path / "evaluation.json").read_text())
    for name, policy in zip(["moment_force-K1", "gcn-K1"], found.policies, strict=True):
        assert policy.last["loss"] == pytest.approx((last[f"{name}/4/loss"] + last[f"{name}/5/loss"]) / 2)
        assert policy.best is not None
        assert policy.config["model"]["name"] == name.removesuffix("-K1")
        for size in ("4", "5"):
            row = tables[size]["rows"][name]
            assert policy.evaluations[f"{size} agents"]["error"]["mean"] == row["error"]["mean"]
