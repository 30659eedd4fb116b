"""Several policies cloned side by side: the same batches for all, and a run folder of each."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

from modgnn_rl import load_policy, make_model
from modgnn_rl.configs.schema import BCConfig, EvaluationConfig, FlockingConfig, ModelConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.experiment.training import train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers import bc as trainer_module
from modgnn_rl.trainers.collectors.behaviour import ActionNoise
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.rollout_buffer import RolloutBuffer, make_buffer
from modgnn_rl.trainers.imitation.learner import ImitationLearner, fit_together, validate_together
from modgnn_rl.trainers.imitation.side_by_side import member_configs
from modgnn_rl.trainers.loop.callbacks import Callback

ENV = FlockingConfig(num_agents=4, max_steps=30)


@pytest.fixture
def bc_config(small_config):
    """Makes configurations of small runs of behaviour cloning."""
    small = {"batch_size": 8, "cloning_steps": 12, "cloning_updates": 20, "ema_decay": 0.8}
    return lambda runs, **settings: small_config(runs, "bc", **{**small, "env": ENV, **settings})


def _equal(policy, other):
    mine, theirs = policy.state_dict(), other.state_dict()
    return mine.keys() == theirs.keys() and all(torch.equal(value, theirs[name]) for name, value in mine.items())


SEVERAL = {"models": ["modgnn_mlp", "gcn"], "hops": [1, 2], "seeds": 2}
NAMES = [f"{model}-K{hops}-seed{seed}" for model in ("modgnn_mlp", "gcn") for hops in (1, 2) for seed in (0, 1)]


class _Trained(Callback):
    """Keeps the policies that training ended with."""

    def on_end(self, policies):
        self.policies = policies


def test_a_run_of_several_policies(tmp_path, bc_config):
    """Folders, names, metrics, and the rows of the evaluation."""
    config, trained = bc_config(tmp_path, **SEVERAL, cloning_steps=8, num_val_envs=1), _Trained()
    run = train(dataclasses.replace(config, evaluation=EvaluationConfig(num_flocks=2, steps=4)), callbacks=[trained])
    assert sorted(path.name for path in run.path.iterdir() if (path / "config.yaml").exists()) == sorted(NAMES)
    rows = json.loads((run.path / "evaluation.json").read_text())["4"]["rows"]
    assert list(rows)[: len(NAMES)] == list(trained.policies) == NAMES
    for line in run.read_metrics():
        expected = {f"{name}/4/{metric}" for name in NAMES for metric in ("loss", "validation_loss")}
        assert expected <= set(line)
    assert all(f"{name}/4/error" in run.read_metrics()[-1] for name in NAMES)
    assert load_checkpoint(run.checkpoints).state["learners"] == NAMES

    weights = []
    for name in NAMES:
        config = RunFolder.open(run.path / name).config
        model, hops, seed = name.split("-")
        assert (config["model"]["name"], f"K{config['model']['hops']}") == (model, hops)
        assert (config["trainer"]["models"], config["trainer"]["hops"], config["trainer"]["seeds"]) == (None, None, 1)
        assert (config["seed"] == 0) == (seed == "seed0")
        policy = load_policy(run.path / name)
        assert policy.hops == int(hops[1:])
        assert _equal(policy, trained.policies[name])
        weights.append(torch.cat([value.flatten() for value in policy.state_dict().values()]))
    for pair in range(0, len(NAMES), 2):
        assert not torch.equal(weights[pair], weights[pair + 1])  # seeds
    assert _equal(load_policy(run.path), load_policy(run.path / NAMES[0]))


def test_the_seed_determines_a_run_of_several_policies(tmp_path, bc_config):
    metrics = [
        train(bc_config(tmp_path, **SEVERAL, cloning_updates=2), evaluate=False).metrics_file.read_bytes()
        for _ in range(2)
    ]
    assert metrics[0] == metrics[1]


def test_a_policy_trained_beside_others_equals_the_one_trained_alone(tmp_path, bc_config):
    """All random numbers come from the first of several seeds, whose data, weights and batches are as if alone."""
    model = ModelConfig(name="mpnn", layers=2, hidden=8)
    alone = train(bc_config(tmp_path, model=model), evaluate=False)
    several = train(bc_config(tmp_path, model=model, seeds=2), evaluate=False)
    mine, theirs = load_policy(several.path / "mpnn-K1-seed0"), load_policy(alone.path)
    for name, value in mine.state_dict().items():
        torch.testing.assert_close(value, theirs.state_dict()[name], rtol=1e-4, atol=1e-5)
    losses = [run.read_metrics()[-1] for run in (alone, several)]
    assert losses[1]["mpnn-K1-seed0/4/validation_loss"] == pytest.approx(losses[0]["4/validation_loss"], rel=1e-3)


def test_names_and_seeds_of_the_members(bc_config):
    members = member_configs(bc_config("runs", **SEVERAL))
    assert list(members) == NAMES
    assert members["gcn-K2-seed0"].model == ModelConfig(name="gcn", hops=2, hidden=8)
    assert members["gcn-K2-seed1"].seed == members["modgnn_mlp-K1-seed1"].seed != 0
    assert list(member_configs(bc_config("runs"))) == ["pair_force"]
    assert list(member_configs(bc_config("runs", models=["gcn"], hops=[3]))) == ["gcn"]
    assert list(member_configs(bc_config("runs", models="gcn", hops=[1, 3]))) == ["gcn-K1", "gcn-K3"]
    assert list(member_configs(bc_config("runs", seeds=2))) == ["pair_force-K1-seed0", "pair_force-K1-seed1"]


def test_each_policy_is_trained_with_its_own_settings(tmp_path, bc_config):
    class Start(Callback):
        def on_start(self, policies):
            self.policies = {
                name: {key: value.clone() for key, value in policy.state_dict().items()}
                for name, policy in policies.items()
            }

    start = Start()
    train(bc_config(tmp_path, models=["gcn"], hops=[1, 2], cloning_updates=1), callbacks=[start], evaluate=False)
    for hops in (1, 2):
        fresh = member_configs(bc_config(tmp_path, models=["gcn"], hops=[1, 2]))[f"gcn-K{hops}"]
        expected = trainer_module.make_learner(fresh, FlockingTask(fresh.env), (1, 1)).ema_policy.state_dict()
        assert all(torch.equal(value, expected[key]) for key, value in start.policies[f"gcn-K{hops}"].items())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"models": ["gcn", "gnc"]}, r"trainer\.models=gnc is not one of .*did you mean 'gcn'"),
        ({"hops": [1, -1]}, r"trainer\.hops=-1 is out of range"),
        (
            {"models": ["gcn", "pair_force"], "hops": [0, 1]},
            "model.name=pair_force with model.hops=0 has nothing to learn",
        ),
    ],
)
def test_what_cannot_be_trained_is_refused_before_anything_is_created(tmp_path, settings, message, bc_config):
    with pytest.raises(InputError, match=message):
        train(bc_config(tmp_path / "runs", **settings))
    assert not list(tmp_path.iterdir())


def test_dart_collects_in_four_parts_with_the_error_of_the_policy_as_noise(tmp_path, monkeypatch, bc_config):
    scales, forward = [], ActionNoise.forward

    def watched(self, tensordict):
        if not scales or scales[-1] != self.scale:
            scales.append(self.scale)
        return forward(self, tensordict)

    monkeypatch.setattr(ActionNoise, "forward", watched)
    metrics = train(bc_config(tmp_path, dart=True, noise=0.1, cloning_updates=40), evaluate=False).read_metrics()
    # Construction and validation are without noise; each part has the error of the round before it.
    after = [metrics[index]["4/validation_loss"] ** 0.5 for index in (9, 19, 29)]
    assert scales == pytest.approx([0.0, 0.1, 0.0, *after])
    # The metric is the noise in the data of that part.
    expected = [noise for noise in (0.1, *after) for _ in range(10)]
    assert [line["noise"] for line in metrics] == pytest.approx(expected)


@pytest.mark.parametrize("rounds", [2, 6])
@pytest.mark.parametrize(("settings", "sets"), [({}, 1), ({"dart": True}, 4)])
def test_dart_collects_as_much_data_as_plain_cloning(tmp_path, monkeypatch, settings, sets, rounds, bc_config):
    seen, extend = [], RolloutBuffer.extend

    def watched(self, rollouts):
        extend(self, rollouts)
        seen.append((*rollouts.shape, self.seen))

    monkeypatch.setattr(RolloutBuffer, "extend", watched)
    train(bc_config(tmp_path, cloning_updates=rounds, stride=1, noise=0.2, **settings), evaluate=False)
    of_training = [entry for entry in seen if entry[0] == 8]
    assert len(of_training) == sets
    assert sum(steps for _, steps, _ in of_training) == 12
    assert of_training[-1][2] == 8 * 12


def _collected(policies, **settings):
    trainer = BCConfig(**{"num_envs": 1, "batch_size": 8, "ema_decay": 0.8, **settings})
    spec = RolloutSpec(FlockingTask(ENV).training_env, 6, 4, steps=12, seed=0)
    data = make_buffer(spec, trainer, policies, Reynolds(), hold_steps=12)
    data.extend(data.collect(1.0))
    return trainer, data.buffer


@pytest.mark.parametrize(
    "models",
    [
        [("modgnn_mlp", {"hops": 2}), ("gcn", {"hops": 1})],  # one after the other, over windows
        [("mpnn", {"layers": 2}), ("mpnn", {"layers": 2})],  # at once, over windows
        [("pair_force", {}), ("pair_force", {}), ("pair_force", {})],  # at once, from stored messages
    ],
)
def test_fitting_together_equals_fitting_each_alone_on_the_same_batches(models):
    def policies():
        return [make_model(name, hidden=8, seed=seed, **model) for seed, (name, model) in enumerate(models)]

    trainer, buffer = _collected(policies(), hide_velocity=0.0)
    together = [ImitationLearner(policy, FlockingTask(ENV), trainer, (12, 12), seed=0) for policy in policies()]
    losses = fit_together(together, buffer, 12)
    final = validate_together(together, buffer)
    for number, policy in enumerate(policies()):
        _, buffer = _collected(policies())  # the same data and the same batches
        alone = ImitationLearner(policy, FlockingTask(ENV), trainer, (12, 12), seed=0)
        assert fit_together([alone], buffer, 12)[0] == pytest.approx(losses[number], rel=1e-4)
        assert alone.validate(buffer) == pytest.approx(final[number], rel=1e-3)
        for kind in ("policy", "ema_policy"):
            for name, value in getattr(alone, kind).state_dict().items():
                torch.testing.assert_close(
                    getattr(together[number], kind).state_dict()[name], value, rtol=1e-3, atol=1e-5
                )
        assert together[number].updates_done == alone.updates_done == 12
        assert together[number].learning_rate == alone.learning_rate


def test_each_policy_has_its_folder_even_after_an_interruption(tmp_path, bc_config):
    class Interrupt(Callback):
        def on_round(self, index, metrics):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(bc_config(tmp_path, models=["gcn", "modgnn_mlp"]), callbacks=[Interrupt()])
    (folder,) = tmp_path.iterdir()
    for name in ("gcn-K1", "modgnn_mlp-K1"):
        load_policy(folder / name)
