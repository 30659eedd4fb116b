"""Loggers: plain files always, dashboards as far as they go, training never stopped or kept waiting."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import math
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig, ModelConfig, TrainConfig, WandbConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.experiment import training
from modgnn_rl.tracking.backends import Backend
from modgnn_rl.tracking.loggers import LoggerGroup, check_logger, make_logger
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.loop.callbacks import Callback


def config(logger, **wandb):
    """A run that logs to these loggers."""
    return TrainConfig(trainer=DAggerConfig(), logger=logger, wandb=WandbConfig(**wandb))


@pytest.fixture
def run(tmp_path):
    return RunFolder.create(tmp_path, "dagger", "trainer:\n  rounds: 7\n")


@pytest.fixture
def clean_wandb(monkeypatch, tmp_path):
    """Weights & Biases without a key, a home or anything left of an earlier run."""
    wandb = pytest.importorskip("wandb")
    wandb.teardown()
    for name in [name for name in os.environ if name.startswith("WANDB_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.setenv("WANDB_ERROR_REPORTING", "false")
    yield
    wandb.teardown()


class Fake(Backend):
    """Fails, or takes its time, in the methods named."""

    shows_videos = True

    def __init__(self, *broken, error=None, seconds=0.0):
        self.broken, self.seconds = broken, seconds
        self.error = error or ConnectionError("the server\nis gone")
        self.calls = []

    def close(self):
        """Say where it lies."""
        return self._call("close") or "fake: somewhere"

    def _call(self, name, *arguments):
        self.calls.append((name, *arguments))
        if name in self.broken:
            time.sleep(self.seconds)
            raise self.error


for method in ("log", "log_histogram", "log_video", "log_table", "log_references"):
    setattr(Fake, method, functools.partialmethod(Fake._call, method))


def everything(loggers):
    """Call each method once."""
    loggers.log(1, {"error": 0.5})
    loggers.log_histogram(1, "actions", torch.tensor([0.0, math.nan, 1.0, math.inf]))
    loggers.log_video(1, "rollout", Path("rollout.mp4"))
    loggers.log_table("rows", ["who", "error"], [["expert", 0.0]])
    loggers.log_references(1, {"error": {"expert": 0.0}})


def test_none_does_nothing(run):
    before = sorted(run.path.iterdir())
    for logger in ("none", []):
        loggers = make_logger(config(logger), run)
        assert not loggers
        everything(loggers)
        assert loggers.close() == []
    assert sorted(run.path.iterdir()) == before


def test_csv_lies_in_the_run_folder(run):
    loggers = make_logger(config("csv"), run)
    assert not loggers.shows_videos
    everything(loggers)
    loggers.log(3, {"train/error": 0.5})
    loggers.log(4, {"train/error": float("nan")})
    assert loggers.close() == [f"csv: {run.path}/csv"]
    assert (run.path / "csv/scalars/train/error.csv").read_text() == "3,0.5\n4,nan\n"
    assert (run.path / "csv/tables/rows.csv").read_text() == "who,error\nexpert,0.0\n"
    settings = (run.path / "csv/texts/hparams0.txt").read_text().splitlines()
    assert "trainer.rounds: 7" in settings
    assert f"made_with.torch: {torch.__version__}" in settings


def test_tensorboard_holds_everything_and_a_run_for_each_reference(run, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    loggers = make_logger(config("tensorboard"), run)
    everything(LoggerGroup({"tensorboard": lambda: _without_videos(loggers)}))
    assert loggers.close() == [f"tensorboard --logdir {run.path}/tensorboard"]
    (own, expert) = (EventAccumulator(str(run.path / "tensorboard" / name)).Reload() for name in ("", "expert"))
    assert [(event.step, event.value) for event in own.Scalars("error")] == [(1, 0.5)]
    assert [(event.step, event.value) for event in expert.Scalars("error")] == [(1, 0.0)]
    (histogram,) = own.Histograms("actions")
    assert (histogram.histogram_value.num, histogram.histogram_value.max) == (2, 1)
    table, settings = (
        own.Tensors(f"{name}/text_summary")[0].tensor_proto.string_val[0].decode() for name in ("rows", "settings")
    )
    assert table == "who|error\n---|---\nexpert|0"
    assert "trainer.rounds|7\n" in settings
    assert "made_with.torchrl|" in settings


def _without_videos(loggers):
    """The first backend, without videos: there is none here to show."""
    backend = next(iter(loggers._backends.values()))
    backend.log_video = lambda *_: None
    return backend


def test_working_loggers_receive_everything():
    fakes = {"one": Fake(), "other": Fake()}
    loggers = LoggerGroup({name: lambda fake=fake: fake for name, fake in fakes.items()})
    everything(loggers)
    assert loggers.shows_videos
    assert loggers.close() == ["fake: somewhere"] * 2
    assert loggers.close() == []
    for fake in fakes.values():
        assert fake.calls[0] == ("log", 1, {"error": 0.5})
        assert fake.calls[1][3].tolist() == [0.0, 1.0]  # what is finite
        assert fake.calls[-1] == ("close",)
        assert len(fake.calls) == 6


@pytest.mark.parametrize("broken", ["log", "log_histogram", "log_video", "log_table", "log_references", "close"])
def test_the_first_failure_turns_a_dashboard_off_with_one_warning_and_the_others_go_on(broken):
    fake, other = Fake(broken), Fake()

    def use():
        loggers = LoggerGroup({"fake": lambda: fake, "other": lambda: other})
        for _ in range(3):
            everything(loggers)
        assert loggers.close() == ["fake: somewhere"]
        everything(loggers)

    with pytest.warns(RuntimeWarning) as caught:
        use()
    assert [str(warning.message) for warning in caught] == [
        "logger=fake failed and is now off (the server); metrics.jsonl is still written"
    ]
    assert [name for name, *_ in fake.calls].count(broken) == 1
    assert len(other.calls) == 16


def test_a_dashboard_that_hangs_is_left_alone():
    fake = Fake("log", seconds=5.0)
    loggers = LoggerGroup({"fake": lambda: fake}, timeout=0.1)
    began = time.monotonic()
    with pytest.warns(RuntimeWarning, match=r"off \(no answer within 0.1 s\)"):
        loggers.log(1, {"error": 0.5})
    assert time.monotonic() - began < 3
    assert not loggers


def test_a_dashboard_that_cannot_be_made_is_off_with_one_warning():
    def build():
        raise PermissionError

    with pytest.warns(RuntimeWarning, match=r"off \(PermissionError\)") as caught:
        loggers = LoggerGroup({"fake": build})
    assert len(caught) == 1
    everything(loggers)
    assert loggers.close() == []


def test_ctrl_c_is_not_swallowed():
    with pytest.raises(KeyboardInterrupt):
        everything(LoggerGroup({"fake": lambda: Fake("log", error=KeyboardInterrupt())}))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"logger": "wandv"}, "did you mean 'wandb'"),
        ({"logger": ["csv", "wandv"]}, "did you mean 'wandb'"),
        ({"logger": None}, "logger=None is not one of none, csv"),
        ({"logger": ["csv", "csv"]}, r"logger=\[csv,csv\] must name each logger once"),
        ({"logger": ["none", "csv"]}, "none only on its own"),
        ({"wandb": WandbConfig(mode="on")}, "not one of offline, online, disabled"),
        ({"wandb": WandbConfig(init_timeout=100.0)}, "at most 12"),
        ({"video_rounds": -1}, "at least 0"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    def refuse():
        bad = TrainConfig(trainer=DAggerConfig(), **settings)
        check(bad)
        check_logger(bad)

    with pytest.raises(InputError, match=message):
        refuse()


def test_a_missing_tensorboard_is_said_before_anything_is_made(run, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    before = sorted(run.path.iterdir())
    with pytest.raises(InputError, match="pip install tensorboard"):
        make_logger(config(["csv", "tensorboard"]), run)
    assert sorted(run.path.iterdir()) == before


def wandb_files(run):
    return [path for path in run.path.rglob("*.wandb") if path.stat().st_size > 0]


@pytest.mark.usefixtures("clean_wandb")
def test_wandb_offline_writes_into_the_run_folder_only_and_is_silent(run, monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "online")
    for _ in range(2):
        logger = make_logger(config("wandb"), run)
        logger.log(1, {"train/error": 0.5})
        (line,) = logger.close()
        synced = shlex.split(line.partition("wandb sync ")[2])
        assert wandb_files(run)
        assert list(Path(synced[0]).glob("*.wandb"))
    assert len(wandb_files(run)) == 2
    assert {path.name for path in tmp_path.iterdir()} == {run.path.name}
    assert os.environ["WANDB_MODE"] == "online"
    assert capfd.readouterr() == ("", "")


@pytest.mark.usefixtures("clean_wandb")
def test_wandb_disabled_keeps_nothing(run):
    logger = make_logger(config("wandb", mode="disabled"), run)
    logger.log(1, {"train/error": 0.5})
    assert "disabled" in logger.close()[0]
    assert wandb_files(run) == []


def falls_back_to_offline(run, reason, capfd):
    with pytest.warns(RuntimeWarning, match=reason) as caught:
        logger = make_logger(config("wandb", mode="online", init_timeout=0.5), run)
    assert len(caught) == 1
    logger.log(1, {"train/error": 0.5})
    assert "wandb sync" in logger.close()[0]
    assert capfd.readouterr() == ("", "")
    assert list(run.path.glob("wandb/offline-run-*/*.wandb"))


@pytest.mark.usefixtures("clean_wandb")
def test_wandb_online_without_a_key_is_offline_and_asks_nothing(run, monkeypatch, capfd):
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("asked for input"))
    falls_back_to_offline(run, "no API key", capfd)


@pytest.mark.usefixtures("clean_wandb")
def test_wandb_online_with_a_server_that_never_answers_is_offline(run, monkeypatch, capfd):
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setenv("WANDB_BASE_URL", f"http://127.0.0.1:{server.getsockname()[1]}")
        monkeypatch.setenv("WANDB_API_KEY", "a" * 40)
        falls_back_to_offline(run, "cannot be reached", capfd)


@pytest.mark.usefixtures("clean_wandb")
def test_wandb_holds_everything(run, tmp_path):
    film = tmp_path / "rollout.mp4"
    film.write_bytes(b"a film")
    for step, error in enumerate((0.5, math.nan, 0.25)):
        run.log(step, {"error": error})
    loggers = make_logger(config("wandb", group="mine"), run)
    everything(LoggerGroup({"wandb": lambda: _without_videos(loggers)}))
    loggers = make_logger(config("wandb", group="mine"), run)
    assert loggers.shows_videos
    loggers.log_video(2, "rollout", film)
    loggers.log_table("rows", ["who", "error"], [["expert", 0.0]])
    loggers.log_references(2, {"error": {"expert": 0.0, "zero action": 1.0}})
    assert len(loggers.close()) == 1
    folder = run.path / "wandb" / "latest-run" / "files" / "media"
    assert [path.read_bytes() for path in folder.rglob("*.mp4")] == [b"a film"]
    tables = {path.name.partition("_")[0]: json.loads(path.read_text()) for path in folder.rglob("*.table.json")}
    assert tables["rows"]["data"] == [["expert", 0.0]]
    assert tables["error"]["data"] == [
        *([step, "this run", error] for step, error in ((0, 0.5), (2, 0.25))),
        *([step, "expert", 0.0] for step in (0, 2)),
        *([step, "zero action", 1.0] for step in (0, 2)),
    ]


def wandb_helpers():
    """The process ids of its helpers."""
    children = subprocess.run(
        ["ps", "--ppid", str(os.getpid()), "-o", "pid=,comm="], capture_output=True, text=True, check=True
    ).stdout
    return [int(line.split()[0]) for line in children.splitlines() if "wandb-core" in line]


@pytest.mark.skipif(sys.platform != "linux", reason="finds the helper process through ps")
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
@pytest.mark.usefixtures("clean_wandb")
def test_wandb_without_its_helper_is_off_with_one_warning_and_does_not_harm_the_next_run(run, monkeypatch, sent):
    monkeypatch.setattr("modgnn_rl.tracking.loggers.LOGGER_TIMEOUT", 1.5)
    logger = make_logger(config("wandb"), run)
    helpers = wandb_helpers()
    assert helpers
    for helper in helpers:
        os.kill(helper, sent)

    def use():
        for step in range(20_000):  # the first few may still fit into the pipe to the dead process
            if not logger:
                break
            logger.log(step, {"train/error": 0.5})
        assert logger.close() == []

    began = time.monotonic()
    with pytest.warns(RuntimeWarning, match="logger=wandb failed and is now off") as caught:
        use()
    assert time.monotonic() - began < 15
    assert len(caught) == 1
    assert not set(wandb_helpers()) & set(helpers)
    logger = make_logger(config("wandb"), run)
    assert "wandb sync" in logger.close()[0]


@pytest.mark.skipif(sys.platform != "linux", reason="finds the helper process through ps")
@pytest.mark.usefixtures("clean_wandb")
def test_training_continues_without_wandb_and_metrics_are_complete(tmp_path):
    class Kill(Callback):
        def on_round(self, index, metrics):
            for helper in wandb_helpers() if index == 2 else ():
                os.kill(helper, signal.SIGKILL)

    trainer = DAggerConfig(
        num_envs=1,
        batch_size=16,
        cloning_steps=8,
        cloning_updates=2,
        rounds=12,
        steps_per_round=4,
        updates_per_round=2,
        num_val_envs=1,
    )
    whole = TrainConfig(
        env=FlockingConfig(num_agents=4, max_steps=4),
        model=ModelConfig(name="pair_force", hidden=8),
        trainer=trainer,
        logger=["csv", "wandb"],
        video_rounds=0,
        runs=str(tmp_path),
        threads=1,
    )
    with pytest.warns(RuntimeWarning, match="logger=wandb failed and is now off"):
        run = training.train(whole, callbacks=[Kill()], evaluate=False)
    rounds = [line["step"] for line in run.read_metrics()]
    assert rounds == list(range(13))
    with (run.path / "csv/scalars/4/loss.csv").open() as file:
        assert [int(line.partition(",")[0]) for line in file] == rounds


ON_A_TERMINAL = """
import pathlib, sys, warnings
from modgnn_rl import training
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig, ModelConfig, TrainConfig, WandbConfig
from modgnn_rl.tracking.loggers import make_logger
from modgnn_rl.tracking.run_folder import RunFolder

assert sys.stdin.isatty() and sys.stdout.isatty()
run = RunFolder.open(sys.argv[1])
config = TrainConfig(trainer=DAggerConfig(), logger="wandb", wandb=WandbConfig(mode="online"))
logger = make_logger(config, run)
logger.log(1, {"error": 0.5})
print(*logger.close())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
@pytest.mark.usefixtures("clean_wandb")
def test_wandb_online_without_a_key_on_a_terminal_asks_nothing(run):
    import pty

    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", ON_A_TERMINAL, str(run.path)]
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # the other end is closed
            while part := os.read(ours, 4096):
                shown += part
        assert process.wait(60) == 0, shown.decode()
    os.close(ours)
    assert b"no API key" in shown
    assert b"wandb sync" in shown
