"""What dashboards show of a training beyond metrics, and that the training does not change for it."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from modgnn_rl import load_policy
from modgnn_rl.configs.schema import (
    FlockingConfig,
)
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.experiment import training
from modgnn_rl.experiment.training import train
from modgnn_rl.registry import METRICS
from modgnn_rl.tracking.backends import Backend
from modgnn_rl.tracking.loggers import LoggerGroup
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.loop import dashboard_callback
from modgnn_rl.trainers.loop.dashboard_callback import DashboardCallback, log_evaluation
from modgnn_rl.visualization import video


class Recorder(Backend):
    """Keeps what it is shown."""

    shows_videos = True

    def __init__(self):
        self.histograms, self.videos, self.tables, self.references = [], [], {}, []

    def log(self, step, metrics):
        """Leave it: this is about the rest."""

    def close(self):
        """Say where it lies."""
        return "recorder: here"

    def log_histogram(self, step, name, values):
        """Keep it."""
        self.histograms.append((step, name, values))

    def log_video(self, step, name, path):
        """Keep it."""
        self.videos.append((step, name, path))

    def log_table(self, name, columns, rows):
        """Keep it."""
        self.tables[name] = (columns, rows)

    def log_references(self, step, references):
        """Keep it."""
        self.references.append((step, references))


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    monkeypatch.setattr(dashboard_callback, "STEPS", 6)
    monkeypatch.setattr(dashboard_callback, "FLOCKS", 0)  # that is one


@pytest.fixture
def watch(tmp_path, small_config):
    recorder = Recorder()
    config = small_config(tmp_path, "dagger", env=FlockingConfig(num_agents=[4, 5]), video_rounds=100)
    run = RunFolder.create(tmp_path, "dagger", "seed: 0\n")
    policies = {"idle": FlockingTask(config.env).reference_policies()["zero action"]}
    watch = DashboardCallback(config, FlockingTask(config.env), run, LoggerGroup({"recorder": lambda: recorder}))
    watch.on_start(policies)
    return watch, recorder


@pytest.mark.parametrize("name", ["bc", "dagger", "mappo"])
def test_training_is_the_same_to_the_last_bit(tmp_path, name, monkeypatch, small_config):
    recorder = Recorder()
    monkeypatch.setattr(dashboard_callback, "write_video", lambda *_: None)
    plain = train(small_config(tmp_path, name), evaluate=False)
    monkeypatch.setattr(training, "make_logger", lambda *_: LoggerGroup({"recorder": lambda: recorder}))
    watched = train(small_config(tmp_path, name, video_rounds=1), evaluate=False)
    assert len(recorder.videos) == len(watched.read_metrics()) - (name == "dagger")  # which begins with round 0
    assert recorder.tables
    assert recorder.references
    assert recorder.histograms
    weights, others = (load_policy(run.path).state_dict() for run in (plain, watched))
    assert all(torch.equal(weights[key], others[key]) for key in weights)
    assert (plain.path / "metrics.jsonl").read_bytes() == (watched.path / "metrics.jsonl").read_bytes()


def test_the_evaluation_is_logged_as_a_table_of_all_metrics():
    recorder = Recorder()
    row = {name: {"mean": float(number), "low": 0.5, "high": 2.0} for number, name in enumerate(METRICS)}
    row["min_distance"]["min"] = 7.0
    small = row | {"error": None}  # a flock of one has no controlled agent
    log_evaluation(LoggerGroup({"recorder": lambda: recorder}), {8: {"mine": row, "small": small}})
    columns, (mine, other) = recorder.tables["evaluation/8"]
    assert columns == ["policy", *METRICS, "error, low", "error, high"]
    means = {name: float(number) for number, name in enumerate(METRICS)} | {"min_distance": 7.0}
    assert mine == ["mine", *means.values(), 0.5, 2.0]
    cells = dict(zip(columns, other, strict=True))
    assert all(math.isnan(cells[name]) for name in ("error", "error, low", "error, high"))
    assert all(cells[name] == means[name] for name in METRICS if name != "error")


def test_reference_lines_are_those_of_the_reference_rollouts(watch):
    watch, recorder = watch
    env_config = watch.config.env
    for size in (4, 5):
        columns, rows = recorder.tables[f"references/{size}"]
        assert [row[0] for row in rows] == list(FlockingTask(env_config).reference_policies())
        assert (
            dict(zip(columns, rows[-1], strict=True))["error"] == watch.references[f"{size}/error"]["zero action"] > 0
        )
    watch.on_round(1, {"4/error": 0.5, "pair_force-K1/5/cohesion": 3.0, "error": 0.5, "4/loss": 0.1})
    ((step, lines),) = recorder.references
    assert step == 1
    assert set(lines) == {"4/error", "pair_force-K1/5/cohesion", "error"}
    assert lines["error"]["zero action"] == pytest.approx(
        sum(watch.references[f"{size}/error"]["zero action"] for size in (4, 5)) / 2
    )
    assert lines["4/error"]["expert"] == 0
    seed = dashboard_callback.derive_seed(watch.config.seed, "references", 5)
    expert = FlockingTask(env_config).reference_policies()["expert"]
    rollouts = rollout(expert, FlockingTask(env_config), num_agents=5, num_flocks=1, steps=6, seed=seed)
    assert lines["pair_force-K1/5/cohesion"]["expert"] == float(rollouts["cohesion"].mean())


def test_reference_lines_are_extended_every_ten_rounds_for_new_metrics_and_at_the_end(watch):
    watch, recorder = watch
    watch.config.video_rounds = 0
    for index in range(1, 24):
        watch.on_round(index, {"4/error": 0.5} | ({"4/leader_lost": 0.0} if index > 12 else {}))
    watch.on_end({})
    assert [step for step, _ in recorder.references] == [1, 10, 13, 20, 23]


def test_logged_actions_are_those_of_controlled_agents(watch):
    watch, recorder = watch
    action = torch.arange(2 * 3 * 4 * 3.0).view(2, 3, 4, 3)
    controlled = torch.ones(2, 3, 4, dtype=torch.bool)
    controlled[..., 0] = False
    watch.on_collect(7, TensorDict({"agents": {"action": action, "controlled": controlled}}, [2, 3]))
    ((step, name, values),) = recorder.histograms
    assert (step, name) == (7, "4/actions")
    assert values.tolist() == action[:, :, 1:].flatten().tolist()


def test_videos_are_made_every_n_rounds_and_at_the_end(watch):
    pytest.importorskip("av")
    pytest.importorskip("matplotlib")
    watch, recorder = watch
    watch.config.video_rounds = 2
    before = torch.get_rng_state()
    for index in range(4):
        watch.on_round(index, {})
    watch.on_end({})
    assert torch.equal(before, torch.get_rng_state())
    folder = watch.run.path / "videos"
    videos = [(index, "4/rollout", folder / f"round_{index:05d}.mp4") for index in (2, 3)]
    assert recorder.videos == videos
    assert sorted(folder.iterdir()) == [path for *_, path in videos]


def test_the_random_numbers_of_training_are_not_touched(watch):
    watch, _ = watch
    before = torch.get_rng_state()
    watch._attempt("a sample", lambda: torch.rand(1))
    assert torch.equal(before, torch.get_rng_state())


def test_what_fails_is_left_out_with_one_warning(watch, monkeypatch):
    watch, recorder = watch

    def fail(*_, **__):
        raise RuntimeError("no room\nleft")

    def go_on():
        for index in range(1, 10):
            watch.on_round(index, {"4/error": 0.5})

    watch.config.video_rounds = 2
    monkeypatch.setattr(dashboard_callback, "record", fail)
    with pytest.warns(RuntimeWarning) as caught:
        go_on()
    assert [str(warning.message) for warning in caught] == [
        "dashboards no longer show videos (no room); training continues"
    ]
    assert recorder.references


def test_missing_packages_are_reported_once(tmp_path, monkeypatch, small_config):
    monkeypatch.setattr(video.importlib.util, "find_spec", lambda name: None)
    config = small_config(tmp_path, "dagger")
    watch = DashboardCallback(config, FlockingTask(config.env), None, LoggerGroup({"recorder": Recorder}))

    def use():
        watch.on_start({})
        for index in range(1, 41):
            watch.on_round(index, {})

    with pytest.warns(RuntimeWarning, match="no longer show videos .*pip install av matplotlib") as caught:
        use()
    assert len(caught) == 1
