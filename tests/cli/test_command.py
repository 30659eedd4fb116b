"""The command line, on a toy command with a folder of YAML files of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from modgnn_rl import registry
from modgnn_rl.cli.command import run_command, settings_given
from modgnn_rl.cli.tab import completion_script
from modgnn_rl.configs.settings import group, setting
from modgnn_rl.errors import InputError
from modgnn_rl.registry import Entry, Reference, Registry
from modgnn_rl.utils.signals import Stopped

ROOT = Path(__file__).parents[2]


@dataclass
class World:
    """A group with one dataclass."""

    num_agents: Any = setting(32, "agents in a flock, or several sizes", ge=1)
    comm_range: float = setting(3.5, "hearing distance, m", gt=0)


@dataclass
class Trainer:
    """What the choices of the second group share."""

    name: str = "bc"
    lr: float = setting(1e-3, "learning rate", gt=0, le=1)


TOYS = Registry("trainer", "TOYS", "tests")
TOYS.register("bc")(len)


@dataclass
class Dagger(Trainer):
    """A choice with settings of its own."""

    name: str = "dagger"
    rounds: int = setting(10, "rounds of collection", ge=1)
    schedule: str = setting("linear", "mixing schedule", choices=("constant", "linear"))


TOYS.register("dagger", settings=Dagger)(max)


@dataclass
class Toy:
    """The whole configuration."""

    seed: int = setting(0, "random seed, $5 or ${more}", ge=0)
    source: str = setting("here", "where from")
    env: World = field(default_factory=World)
    trainer: Trainer = group(TOYS, Trainer)


FILES = {
    "conf/toy.yaml": "defaults:\n  - toy_schema\n  - env: flocking\n  - trainer: dagger\n  - _self_\n",
    "conf/env/flocking.yaml": "{}\n",
    "conf/env/paper.yaml": "comm_range: 7\n",
    "conf/trainer/patient.yaml": "defaults:\n  - dagger\nrounds: 99\n",
    "mine/trainer/mine.yaml": "defaults:\n  - dagger\nrounds: 4\n",
    "mine/trainer/wrong.yaml": "defaults:\n  - dagger\nroundz: 4\n",
    "mine/trainer/broken.yaml": "rounds: [4\n",
}


class Outcome(NamedTuple):
    """What one call of the command did."""

    code: object
    out: str
    err: str
    configs: list[Toy]


Run = Callable[..., Outcome]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Call the toy command in an empty folder, beside the folders ``conf`` and ``mine``."""
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    workplace = tmp_path / "workplace"
    workplace.mkdir()
    monkeypatch.chdir(workplace)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")

    def call(*arguments: str, main: Callable[[Toy], int | None] | None = None) -> Outcome:
        configs: list[Toy] = []

        def remember(config: Toy) -> None:
            """Train a toy flock.

            A second paragraph.
            """
            configs.append(config)

        monkeypatch.setattr(sys, "argv", ["toy", *arguments])
        code: object = 0
        try:
            run_command(main or remember, Toy, "toy", config_path=str(tmp_path / "conf"))
        except SystemExit as stop:
            code = stop.code
        assert Path.cwd() == workplace
        assert not list(workplace.iterdir())
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err, configs)

    return call


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], Toy(trainer=Dagger())),
        (["seed=3", "env.num_agents=[8,16]"], Toy(3, env=World([8, 16]), trainer=Dagger())),
        (["env=paper", "trainer=bc"], Toy(env=World(comm_range=7), trainer=Trainer())),
        (["trainer.rounds=2", "env=paper", "env.comm_range=1"], Toy(env=World(comm_range=1), trainer=Dagger(rounds=2))),
        (["trainer=patient"], Toy(trainer=Dagger(rounds=99))),
        (["--config-dir", "../mine", "trainer=mine"], Toy(trainer=Dagger(rounds=4))),
        (["hydra.searchpath=[file://../mine]", "trainer=mine"], Toy(trainer=Dagger(rounds=4))),
    ],
)
def test_settings_reach_main_as_the_dataclass(run: Run, arguments: list[str], expected: Toy) -> None:
    outcome = run(*arguments)
    assert (outcome.code, outcome.out, outcome.err) == (0, "", "")
    assert outcome.configs == [expected]
    assert type(outcome.configs[0].trainer) is type(expected.trainer)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["trainer.rouns=1"], ["unknown setting trainer.rouns", "did you mean 'trainer.rounds'?"]),
        (["rounds=1"], ["unknown setting rounds", "did you mean 'trainer.rounds'?"]),
        (["+trainer.roundz=1"], ["unknown setting trainer.roundz", "'trainer.rounds'"]),
        (["++sed=1"], ["unknown setting sed", "'seed'"]),
        (["trainr=bc"], ["unknown setting trainr", "'trainer'"]),
        (["qqq=1"], ["unknown setting qqq", "--help"]),
        (["~seed"], ["seed cannot be removed"]),
        (["trainer=dager"], ["trainer=dager is not one of bc, dagger, patient", "did you mean 'dagger'?"]),
        (["seed=x"], ["seed: ", "'x'", "Integer"]),
        (["seed=-1"], ["seed=-1 is out of range", "at least 0"]),
        (["trainer=bc", "trainer.name=dagger"], ["trainer.name=dagger does not fit settings of type Trainer"]),
        (["trainer.name=dager"], ["trainer 'dager' is not one of bc, dagger; did you mean 'dagger'?"]),
        (["trainer.lr=0"], ["trainer.lr=0.0 is out of range", "greater than 0"]),
        (["trainer.schedule=liner"], ["trainer.schedule=liner is not one of", "'linear'"]),
        (["env.num_agents=[8,0]"], ["env.num_agents", "at least 1"]),
        (["seed=???"], ["seed must be given"]),
        (["source=${her}"], ["source: ", "'her' not found"]),
        (["seed=[1"], ["cannot read 'seed=[1'", "key=value"]),
        (["seed"], ["cannot read 'seed'"]),
        (["seed=0,1"], ["seed=0,1", "--multirun"]),
        (["--config-dir", "nowhere"], ["nowhere", "not found"]),
        (["hydra.searchpath=[file://nowhere]"], ["nowhere", "not available"]),
        (["--config-dir", "../mine", "trainer=wrong"], ["trainer/wrong", "unknown setting trainer.roundz", "rounds"]),
        (["--config-dir", "../mine", "trainer=broken"], ["broken.yaml", "line"]),
        (["--config-name", "other"], ["other.yaml"]),
        (["--colour"], ["--colour", "--help"]),
        (["--run", "--multirun"], ["--run, --multirun"]),
        (["--multirun", "seed=0,a"], ["seed: ", "'a'"]),
        (["--multirun", "seed=0,-1"], ["seed=-1 is out of range"]),
        (["--multirun", "trainer=bc,dager"], ["trainer=dager", "'dagger'"]),
    ],
)
def test_a_user_error_is_one_line(run: Run, arguments: list[str], words: list[str]) -> None:
    outcome = run(*arguments)
    assert outcome.code == 2
    assert outcome.configs == []
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1
    assert outcome.out == ""
    for word in words:
        assert word in outcome.err


def test_input_error_of_main_is_one_line(run: Run) -> None:
    def main(config: Toy) -> None:
        raise InputError("no such run;\ntry another")

    assert run(main=main)[:3] == (2, "", "error: no such run; try another\n")


@pytest.mark.parametrize("error", [ValueError("a bug"), OSError("a full disk"), ZeroDivisionError()])
def test_other_errors_of_main_keep_their_traceback(run: Run, error: Exception) -> None:
    def main(config: Toy) -> None:
        raise error

    with pytest.raises(type(error)) as caught:
        run(main=main)
    assert "main" in [entry.name for entry in caught.traceback]


def test_ctrl_c_is_one_line(run: Run) -> None:
    def main(config: Toy) -> None:
        raise KeyboardInterrupt

    assert run(main=main)[:3] == (130, "", "interrupted\n")


def test_the_exit_code_names_the_signal(run: Run) -> None:
    def main(config: Toy) -> None:
        raise Stopped(signal.SIGTERM)

    assert run(main=main)[:3] == (143, "", "")


def test_a_job_that_fails_does_not_stop_the_others(run: Run) -> None:
    began = []

    def main(config: Toy) -> int:
        began.append(config.seed)
        if config.seed == 1:
            raise InputError("no such dataset")
        if config.seed == 2:
            raise ZeroDivisionError("a bug")
        return 0

    outcome = run("--multirun", "seed=0,1,2,3", main=main)
    assert began == [0, 1, 2, 3]
    assert outcome.code == 2
    first, *trace, bug, summary = outcome.err.strip().splitlines()
    assert first == "error: no such dataset"
    assert trace[0].startswith("Traceback")
    assert bug == "ZeroDivisionError: a bug"
    assert summary == "2 of 4 jobs failed: seed=1; seed=2"


def test_settings_given_are_those_on_the_command_line(run: Run) -> None:
    given = []
    run("seed=3", "trainer=dagger", "env.comm_range=2", main=lambda config: given.append(settings_given(config)))
    assert given == [{"seed": 3, "trainer": Dagger(), "env.comm_range": 2}]


def test_return_value_of_main_is_the_exit_code(run: Run) -> None:
    assert run(main=lambda config: 3).code == 3
    assert run("--multirun", "seed=0,4,1", main=lambda config: config.seed).code == 4


def test_an_installed_package_is_imported_when_its_choice_is_used(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    imported = []

    class Plugin(EntryPoint):
        def load(self) -> object:
            imported.append(self.name)
            TOYS.register("plugged", settings=Plugged)(min)
            return min

    def entry_points(*, group: str, name: str = "plugged") -> EntryPoints:
        return EntryPoints([Plugin("plugged", "a:b", group)]).select(name=name)

    @dataclass
    class Plugged(Trainer):
        horizon: int = setting(5, "an installed package's own setting", ge=1)

    monkeypatch.setattr(registry, "entry_points", entry_points)
    monkeypatch.setattr(TOYS, "plugins", "toys")
    monkeypatch.setattr(TOYS, "_added", dict(TOYS._added))
    assert "trainer=bc, dagger*, patient, plugged" in " ".join(run("--help").out.split())
    assert "did you mean 'plugged'?" in run("trainer=pluged").err
    assert not imported
    assert run("trainer=plugged", "trainer.horizon=3").configs == [Toy(trainer=Plugged("plugged", horizon=3))]
    assert imported == ["plugged"]
    monkeypatch.setenv("COMP_LINE", "toy trainer=plugged trainer.h")
    assert run("--shell-completion", "query=bash").out.split() == ["trainer.horizon="]


def test_settings_declared_beside_slow_code_are_imported_when_their_choice_is_used(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "slow_toy.py").write_text(f"import sys\nSlowConfig = sys.modules[{__name__!r}].Dagger\n")
    monkeypatch.syspath_prepend(tmp_path)
    slow = Reference("slow_toy", "SlowConfig")
    monkeypatch.setitem(TOYS.built_in, "slow", Entry("slow", slow, {"settings": slow}))
    assert "trainer=bc, dagger*, patient, slow" in " ".join(run("--help").out.split())
    assert "slow_toy" not in sys.modules
    assert run("trainer=slow", "trainer.rounds=3").configs == [Toy(trainer=Dagger("slow", rounds=3))]
    monkeypatch.delitem(sys.modules, "slow_toy")


def test_settings_of_a_choice_must_be_derived_from_those_of_its_group(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TOYS, "_added", dict(TOYS._added))
    TOYS.register("odd", settings=World)(min)
    outcome = run()
    assert (outcome.code, outcome.err.count("\n")) == (2, 1)
    assert "trainer 'odd' is registered with settings=" in outcome.err
    assert "expected a Trainer" in outcome.err


def test_multirun_calls_main_for_every_combination(run: Run) -> None:
    outcome = run("--multirun", "seed=0,1", "trainer=bc,dagger")
    assert outcome.code == 0
    assert [(config.seed, type(config.trainer)) for config in outcome.configs] == [
        (0, Trainer),
        (0, Dagger),
        (1, Trainer),
        (1, Dagger),
    ]


def test_help_lists_choices_and_settings_with_doc_default_and_range(run: Run) -> None:
    outcome = run("--help", "env=paper")
    lines = [" ".join(line.split()) for line in outcome.out.splitlines()]
    assert (outcome.code, outcome.err) == (0, "")
    for line in [
        "Train a toy flock.",
        "env=flocking, paper*",
        "trainer=bc, dagger*, patient",
        "seed=0 random seed, $5 or ${more} [at least 0]",
        "env.comm_range=7.0 hearing distance, m [greater than 0]",
        "trainer.lr=0.001 learning rate [greater than 0, at most 1]",
        "trainer.schedule=linear mixing schedule [constant, linear]",
    ]:
        assert line in lines
    assert "schema" not in outcome.out
    assert "rounds" not in run("--help", "trainer=bc").out


def test_cfg_job_prints_the_configuration(run: Run) -> None:
    outcome = run("--cfg", "job", "seed=7", "trainer=bc")
    assert (outcome.code, outcome.configs) == (0, [])
    assert outcome.out.startswith("seed: 7\n")
    assert "hydra" not in outcome.out


def test_help_is_as_wide_as_the_terminal_and_has_a_section_for_each_node(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs = {}
    for width in (80, 120):
        monkeypatch.setenv("COLUMNS", str(width))
        outputs[width] = run("--help").out
        lines = outputs[width].splitlines()
        assert max(map(len, lines)) <= width
        assert lines.index("env.* A group with one dataclass.") < lines.index(
            "trainer.* A choice with settings of its own."
        )
    assert outputs[80].split() == outputs[120].split()


def test_help_shows_the_examples_of_the_docstring(run: Run) -> None:
    def main(config: Toy) -> None:
        """Train a toy flock.

        Examples::

            python -m toy seed=1
        """

    lines = run("--help", main=main).out.splitlines()
    assert lines[2:7] == ["Train a toy flock.", "", "Examples:", "    python -m toy seed=1", ""]


def test_tab_offers_the_settings_of_the_command_only(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMP_LINE", "toy ")
    assert set(run("--shell-completion", "query=bash").out.split()) == {
        *("seed=", "source=", "env=", "env.", "trainer=", "trainer."),
    }


def test_hydras_install_prints_our_completion_script(run: Run) -> None:
    assert run("-sc", "install=bash").out == f"{completion_script('bash')}\n"
    outcome = run("-sc", "install=tcsh")
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err == "error: unknown shell 'tcsh': there is completion for bash, fish, zsh\n"


def test_a_broken_pipe_of_something_else_is_a_bug(run: Run) -> None:
    def main(config: Toy) -> None:
        raise BrokenPipeError("a worker's")

    with pytest.raises(BrokenPipeError, match="worker"):
        run(main=main)


def test_tab_completes_choices_and_settings(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    for typed, completions in [
        ("trainer=", {"trainer=bc", "trainer=dagger", "trainer=patient"}),
        ("trainer.r", {"trainer.rounds="}),
    ]:
        line = f"toy {typed}"
        monkeypatch.setenv("COMP_LINE", line)
        monkeypatch.setenv("COMP_POINT", str(len(line)))
        assert set(run("--shell-completion", "query=bash").out.split()) == completions


def test_an_error_is_reported_at_once_without_torch(tmp_path: Path) -> None:
    (tmp_path / "toy.yaml").write_text("defaults:\n  - toy_schema\n")
    (tmp_path / "toy.py").write_text(
        textwrap.dedent("""\
            import atexit, pathlib, sys
            from dataclasses import dataclass
            from modgnn_rl.cli.command import run_command

            @dataclass
            class Toy:
                seed: int = 0

            atexit.register(lambda: print("torch" in sys.modules))
            run_command(lambda config: None, Toy, "toy", config_path=str(pathlib.Path(__file__).parent))
            """)
    )
    process = subprocess.run(
        [sys.executable, "toy.py", "sed=1"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (process.returncode, process.stdout) == (2, "False\n")
    assert process.stderr == "error: unknown setting sed; did you mean 'seed'?\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["toy.py", "toy.yaml"]
