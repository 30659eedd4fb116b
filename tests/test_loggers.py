"""Loggers: plain files always, dashboards as far as they go, training never stopped or kept waiting."""

from __future__ import annotations

import importlib.util
import os
import shlex
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from modgnn_rl.configs.schema import LoggerConfig
from modgnn_rl.errors import InputError
from modgnn_rl.loggers import GuardedLogger, check_logger, make_logger
from modgnn_rl.run_folder import RunFolder


@pytest.fixture
def run(tmp_path):
    return RunFolder.create(tmp_path, "dagger", "seed: 0\n")


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


class FakeLogger:
    """Fails in the methods named."""

    def __init__(self, *broken):
        self.broken = broken
        self.calls = []
        self.experiment = type("Experiment", (), {"log_dir": "somewhere"})

    def log_metrics(self, metrics, step):
        """Note the call."""
        self._call("log", (step, metrics))

    def close(self):
        """Note the call."""
        self._call("close", None)

    def _call(self, name, value):
        self.calls.append((name, value))
        if name in self.broken:
            raise ConnectionError("the server\nis gone")


def test_none_does_nothing(run):
    before = sorted(run.path.iterdir())
    logger = make_logger(LoggerConfig(), run)
    logger.log(1, {"error": 0.5})
    assert logger.close() is None
    assert sorted(run.path.iterdir()) == before


def test_csv_lies_in_the_run_folder(run):
    logger = make_logger(LoggerConfig(name="csv"), run)
    logger.log(3, {"train/error": 0.5})
    logger.log(4, {"train/error": float("nan")})
    assert logger.close() == f"csv: {run.path}/csv"
    assert (run.path / "csv/scalars/train/error.csv").read_text() == "3,0.5\n4,nan\n"


def test_a_working_logger_is_passed_everything():
    fake = FakeLogger()
    logger = GuardedLogger("fake", lambda: fake)
    logger.log(1, {"error": 0.5})
    assert logger.close() == "fake: somewhere"
    assert logger.close() is None
    assert fake.calls == [("log", (1, {"error": 0.5})), ("close", None)]


@pytest.mark.parametrize("broken", ["log", "close"])
def test_the_first_failure_turns_a_logger_off_with_one_warning(broken):
    fake = FakeLogger(broken)

    def use():
        logger = GuardedLogger("fake", lambda: fake)
        for step in range(3):
            logger.log(step, {"error": 0.5})
        logger.close()
        logger.log(4, {"error": 0.5})
        logger.close()

    with pytest.warns(RuntimeWarning) as caught:
        use()
    assert [str(warning.message) for warning in caught] == [
        "logger=fake failed and is now off (the server); metrics.jsonl goes on"
    ]
    assert [name for name, _ in fake.calls].count(broken) == 1


def test_a_logger_that_cannot_be_made_is_off_with_one_warning():
    def build():
        raise PermissionError

    with pytest.warns(RuntimeWarning, match=r"off \(PermissionError\)") as caught:
        logger = GuardedLogger("fake", build)
    assert len(caught) == 1
    logger.log(1, {"error": 0.5})
    assert logger.close() is None


def test_ctrl_c_is_not_swallowed():
    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        GuardedLogger("fake", interrupt)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (LoggerConfig(name="wandv"), "did you mean 'wandb'"),
        (LoggerConfig(mode="on"), "not one of offline, online, disabled"),
        (LoggerConfig(init_timeout=100.0), "at most 15"),
    ],
)
def test_bad_settings_are_refused(config, message):
    with pytest.raises(InputError, match=message):
        check_logger(config)


def test_a_missing_tensorboard_is_said_before_anything_is_made(run, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    before = sorted(run.path.iterdir())
    with pytest.raises(InputError, match="pip install tensorboard"):
        make_logger(LoggerConfig(name="tensorboard"), run)
    assert sorted(run.path.iterdir()) == before


def wandb_files(run):
    return [path for path in run.path.rglob("*.wandb") if path.stat().st_size > 0]


@pytest.mark.usefixtures("clean_wandb")
def test_wandb_offline_writes_into_the_run_folder_only_and_is_silent(run, monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "online")
    for _ in range(2):
        logger = make_logger(LoggerConfig(name="wandb"), run)
        logger.log(1, {"train/error": 0.5})
        line = logger.close()
        synced = shlex.split(line.partition("wandb sync ")[2])
        assert wandb_files(run)
        assert list(Path(synced[0]).glob("*.wandb"))
    assert len(wandb_files(run)) == 2
    assert {path.name for path in tmp_path.iterdir()} == {run.path.name}
    assert os.environ["WANDB_MODE"] == "online"
    assert capfd.readouterr() == ("", "")


@pytest.mark.usefixtures("clean_wandb")
def test_wandb_disabled_keeps_nothing(run):
    logger = make_logger(LoggerConfig(name="wandb", mode="disabled"), run)
    logger.log(1, {"train/error": 0.5})
    assert "disabled" in logger.close()
    assert wandb_files(run) == []


def falls_back_to_offline(run, reason, capfd):
    with pytest.warns(RuntimeWarning, match=reason) as caught:
        logger = make_logger(LoggerConfig(name="wandb", mode="online", init_timeout=0.5), run)
    assert len(caught) == 1
    logger.log(1, {"train/error": 0.5})
    assert "wandb sync" in logger.close()
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


@pytest.mark.skipif(sys.platform != "linux", reason="finds the helper process through ps")
@pytest.mark.usefixtures("clean_wandb")
def test_wandb_killed_is_off_with_one_warning_and_does_not_harm_the_next_run(run):
    logger = make_logger(LoggerConfig(name="wandb"), run)
    children = subprocess.run(
        ["ps", "--ppid", str(os.getpid()), "-o", "pid=,comm="], capture_output=True, text=True, check=True
    ).stdout
    helpers = [int(line.split()[0]) for line in children.splitlines() if "wandb-core" in line]
    assert helpers
    for helper in helpers:
        os.kill(helper, signal.SIGKILL)

    def use():
        for step in range(20_000):  # the first few may still fit into the pipe to the dead process
            logger.log(step, {"train/error": 0.5})
        assert logger.close() is None

    with pytest.warns(RuntimeWarning, match="logger=wandb failed and is now off") as caught:
        use()
    assert len(caught) == 1
    logger = make_logger(LoggerConfig(name="wandb"), run)
    assert "wandb sync" in logger.close()
