"""Tasks on the command line: classes in modules, presets of the user, settings in the help."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import EvaluateConfig, TrainConfig
from modgnn_rl.experiment.resume import for_task_of_run, with_stored_choices
from modgnn_rl.tracking.run_folder import RunFolder
from tests.foreign_tasks import GatherConfig

GATHER = "tests.foreign_tasks:Gather"
Run = Callable[..., tuple[list[TrainConfig], str, str]]


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Types a command line; returns the settings of each job, standard output and standard error."""

    def call(*arguments: str) -> tuple[list[TrainConfig], str, str]:
        seen: list[TrainConfig] = []
        monkeypatch.setattr(sys, "argv", ["train", *arguments])
        with contextlib.suppress(SystemExit):
            run_command(lambda config: seen.append(config), TrainConfig, "train")
        captured = capsys.readouterr()
        return seen, captured.out, captured.err

    return call


def test_a_class_in_a_module_is_a_choice_with_its_own_settings(typed: Run) -> None:
    (config,), _, _ = typed(f"env={GATHER}", "env.comm_range=0.5", "env.num_agents=[3,6]")
    assert config.env == GatherConfig(name=GATHER, comm_range=0.5, num_agents=[3, 6])
    assert config.model.name is None


def test_several_tasks_are_jobs_of_a_multirun(typed: Run) -> None:
    configs, _, _ = typed("--multirun", f"env={GATHER},coverage", "trainer=mappo")
    assert [config.env.name for config in configs] == [GATHER, "coverage"]


def test_the_help_lists_the_settings_of_the_task(typed: Run) -> None:
    _, text, _ = typed("--help", f"env={GATHER}")
    assert "env.* Robots that gather at one place." in text
    assert "env.comm_range=1.0" in text
    assert "env.separation_gain" not in text


def test_a_preset_of_the_user_begins_with_a_task(typed: Run, tmp_path: Path) -> None:
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "near.yaml").write_text(f"defaults:\n  - {GATHER}\n  - _self_\ncomm_range: 0.3\n")
    (config,), _, _ = typed("--config-dir", str(tmp_path), "env=near")
    assert config.env == GatherConfig(name=GATHER, comm_range=0.3)
    (tmp_path / "env" / "near.yaml").write_text("comm_range: 0.3\n")
    _, _, error = typed("--config-dir", str(tmp_path), "env=near")
    assert "env/near.yaml has settings of env but does not say of which: begin it with" in error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["env=nowhere:Task"], "task 'nowhere:Task' cannot be imported (No module named 'nowhere')"),
        (["env=tests.foreign_tasks:Scatter"], "has no attribute 'Scatter'"),
        (["env=coverag"], "did you mean 'coverage'?"),
        ([f"env={GATHER}", "env.com_range=1"], "unknown setting env.com_range; did you mean 'env.comm_range'?"),
        ([f"env={GATHER}", "env.comm_range=-1"], "env.comm_range=-1.0 is out of range"),
        (["~env.wind"], "env.wind cannot be removed"),
        (["~logger"], "logger cannot be removed"),
        (["hydra.run.dir=out"], "hydra.run.dir has no effect"),
    ],
)
def test_an_error_is_one_line(typed: Run, arguments: list[str], words: str) -> None:
    seen, _, error = typed(*arguments)
    assert not seen
    assert words in error
    assert error.count("\n") == 1


def test_a_command_on_a_run_has_the_settings_of_its_task(tmp_path: Path) -> None:
    text = f"env:\n  name: {GATHER}\ntrainer:\n  name: bc\nmodel:\n  name: gcn\n"
    run = RunFolder.create(tmp_path, "x", text)
    assert with_stored_choices(["train", f"resume={run.path}"]) == [
        "train", f"resume={run.path}", f"env={GATHER}", "trainer=bc"
    ]  # fmt: skip
    schema = for_task_of_run(EvaluateConfig, [f"run={run.path}"])
    assert issubclass(schema, EvaluateConfig)
    assert set(vars(schema(run=str(run.path)).env)) == {"comm_range", "dims", "actions", "done", "group"}
    assert for_task_of_run(EvaluateConfig, ["run=nowhere"]) is EvaluateConfig
