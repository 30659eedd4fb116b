"""Foreign tasks from training to tables and replays."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule

from modgnn_rl import ACTION, OBSERVATION, InputError, load_policy, make_task
from modgnn_rl.configs.schema import EvaluateConfig, EvaluationConfig, ReplayConfig, TrainConfig
from modgnn_rl.configs.settings import overrides_of
from modgnn_rl.evaluation.recording import record
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.experiment.evaluate import evaluate_run
from modgnn_rl.experiment.replay import replay_run
from modgnn_rl.experiment.training import resume, train
from modgnn_rl.registry import TASKS
from tests.foreign_tasks import Gather, GatherConfig

SETTINGS: dict[str, dict[str, Any]] = {
    "bc": {"cloning_steps": 6, "cloning_updates": 3, "num_val_envs": 1, "batch_size": 8},
    "dagger": {
        "rounds": 2, "cloning_steps": 6, "cloning_updates": 2, "steps_per_round": 5, "updates_per_round": 2,
        "num_val_envs": 1, "batch_size": 8,
    },
    "mappo": {"rounds": 2, "steps_per_round": 5, "epochs": 1, "num_minibatches": 1, "critic_warmup": 1},
}  # fmt: skip


@pytest.fixture
def config(tmp_path, small_config) -> Any:
    """Makes the settings of a short training on the gather task."""

    def make(trainer: str, num_envs: int = 2, **env: Any) -> TrainConfig:
        whole = {"env": GatherConfig(**env), "evaluation": EvaluationConfig(num_flocks=2)}
        return dataclasses.replace(
            small_config(tmp_path / "runs", trainer, num_envs=num_envs, **SETTINGS[trainer], **whole),
            model=TrainConfig(trainer=None).model,
        )

    return make


@pytest.mark.parametrize("env", [{}, {"actions": "categorical"}, {"dims": 1, "num_agents": [3, 5]}])
@pytest.mark.parametrize("trainer", ["bc", "dagger", "mappo"])
def test_every_trainer_trains_a_foreign_task(config, trainer, env):
    run = train(config(trainer, **env))
    assert run.config["model"]["name"] == "modgnn_mlp"
    tables = json.loads((run.path / "evaluation.json").read_text())
    for size, table in tables.items():
        assert table["task"] == "gather"
        assert set(table["rows"]["expert"]) == {"error", "reward", "success", "error_by_quarter"}
        assert table["rows"]["expert"]["error"]["mean"] == 0
        assert (run.path / f"replay-{size}.html").exists()
    text = (run.path / "evaluation.md").read_text()
    assert "leader" not in text
    assert "cohesion" not in text
    policy = load_policy(run.path)
    size = int(next(iter(tables)))
    metrics = rollout(policy, make_task(GatherConfig(**env)), num_agents=size, num_flocks=2, steps=4, seed=0)
    assert metrics["reward"].isfinite().all()


def test_a_run_is_resumed_evaluated_and_replayed(config):
    run = train(config("dagger"), evaluate=False)
    run = resume(run.path, {"trainer.rounds": 3}, evaluate=False)
    assert [json.loads(line)["step"] for line in (run.path / "metrics.jsonl").read_text().splitlines()][-1] == 3
    changes = overrides_of(GatherConfig)(comm_range=0.5)
    settings = EvaluationConfig(num_flocks=2, num_agents=6, steps=5)
    file = evaluate_run(EvaluateConfig(run=str(run.path), env=changes, evaluation=settings))
    assert json.loads(file.read_text())["6"]["steps"] == 5
    assert "comm_range=0.5" in file.name
    for format in ("html", "png"):
        nothing = overrides_of(GatherConfig)()
        assert replay_run(ReplayConfig(run=str(run.path), env=nothing, steps=5, format=format)).exists()


def test_without_an_expert_there_is_mappo_alone(config, monkeypatch):
    monkeypatch.setattr(Gather, "expert", lambda self: None)
    for trainer in ("bc", "dagger"):
        with pytest.raises(InputError, match=f"trainer={trainer} imitates an expert, which task 'gather' does not"):
            train(config(trainer))
    run = train(config("mappo"))
    rows = json.loads((run.path / "evaluation.json").read_text())["4"]["rows"]
    assert list(rows) == ["modgnn_mlp", "zero action"]
    assert set(rows["zero action"]) == {"reward", "success"}


@pytest.mark.parametrize(
    ("trainer", "settings", "sentence"),
    [
        ("bc", {"noise": 0.1}, "trainer.noise=0.1 is for continuous actions"),
        ("bc", {"dart": True}, "trainer.dart=True is for continuous actions"),
        ("dagger", {"gate": "disagreement"}, "trainer.gate=disagreement is for continuous actions"),
    ],
)
def test_what_discrete_actions_exclude_is_one_sentence(config, trainer, settings, sentence):
    wrong = config(trainer, actions="categorical")
    with pytest.raises(InputError, match=sentence):
        train(dataclasses.replace(wrong, trainer=dataclasses.replace(wrong.trainer, **settings)))


def test_a_policy_of_another_width_is_refused_as_a_start(config):
    run = train(config("dagger"), evaluate=False)
    wrong = dataclasses.replace(config("mappo", dims=3), init_from=str(run.path))
    with pytest.raises(InputError, match="4 numbers in an observation and 2 in an action; task 'gather' has 6 and 3"):
        train(wrong)


def test_discrete_labels_are_never_rotated():
    assert make_task(GatherConfig()).can_rotate is False  # a box is not a box after a rotation
    assert make_task(GatherConfig(dims=1)).can_rotate
    assert not make_task(GatherConfig(actions="categorical")).can_rotate


def test_episodes_that_end_early_count_with_the_steps_they_have():
    task = make_task(GatherConfig(max_steps=40))
    expert = task.reference_policies()["expert"]
    metrics = rollout(expert, task, num_agents=4, num_flocks=5, steps=40, seed=0)
    assert metrics["success"].all()
    assert (metrics.lengths < 40).all()
    env = task.evaluation_env(5, 4, 0, "cpu", steps=40)
    data, totals = env.reset(), torch.zeros(5)
    running = torch.ones(5, dtype=torch.bool)
    for _ in range(40):
        data = env.step(expert(data))
        totals += torch.where(running, data["next", "agents", "reward"].mean((1, 2)), 0.0)
        running &= ~data["next", "done"].flatten()
        data = env.step_mdp(data)
        if not running.any():
            break
    torch.testing.assert_close(metrics["reward"].float(), totals)


def test_a_recording_ends_with_its_episode_and_shows_what_the_task_has():
    task = make_task(GatherConfig(max_steps=40))
    recording = record(task.reference_policies()["expert"], task, num_agents=4, steps=40, seed=0)
    assert len(recording) < 40
    assert (recording.leader, recording.dims, recording.arrow_name) == (None, 2, "action")
    assert not recording.position[..., 2].any()
    assert recording.marks.shape == (len(recording), 1, 3)
    longer = recording.extended(40)
    assert len(longer) == 40
    assert (longer.frame(39).position == recording.frame(len(recording) - 1).position).all()
    assert not longer.arrow[len(recording) :].any()


def test_a_reference_to_a_class_in_a_module_is_a_task():
    entry = TASKS["tests.foreign_tasks:Gather"]
    assert entry.load() is Gather
    assert entry.option("settings") is GatherConfig
    config = GatherConfig(name="tests.foreign_tasks:Gather")
    assert make_task(config).name == "tests.foreign_tasks:Gather"
    with pytest.raises(InputError, match="cannot be imported"):
        TASKS["tests.foreign_tasks:Scatter"]
    with pytest.raises(InputError, match="not a class derived from"):
        make_task(GatherConfig(name="tests.foreign_tasks:GatherEnv"))


def test_a_given_expert_takes_the_place_of_the_tasks_own():
    task = make_task(GatherConfig())
    idle = TensorDictModule(lambda observation: 0 * observation[..., :2], [OBSERVATION], [ACTION])
    changed = task.with_expert(idle)
    metrics = rollout(idle, changed, num_agents=4, num_flocks=2, steps=4, seed=0)
    assert metrics["error"].tolist() == [0.0, 0.0]
    assert task.teacher is not changed.teacher
