"""``python -m modgnn_rl``, and Tab in a shell."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import modgnn_rl
from modgnn_rl.__main__ import main
from modgnn_rl.cli.overview import FIRST, commands, overview
from modgnn_rl.cli.tab import completion_script

ROOT = Path(__file__).parents[2]
NAMES = {path.stem for path in (ROOT / "configs").glob("*.yaml")}  # each command has a file there
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}


def test_the_overview_lists_every_command_without_importing_any():
    code = "import sys; from modgnn_rl.__main__ import main; main([]); print({'torch', 'hydra'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert (done.stderr, done.stdout.splitlines()[-1]) == ("", "set()")
    listed = [line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ") and line[2] != " "]
    assert {name for name in listed if name in NAMES} == NAMES == set(commands())


@pytest.mark.parametrize("name", sorted(NAMES))
def test_a_command_has_a_summary_and_examples(name):
    module = __import__(f"modgnn_rl.{name}", fromlist=["main"])
    assert commands()[name] == module.main.__doc__.partition("\n\n")[0]
    assert commands()[name] in " ".join(overview().split())
    examples = [line.strip() for line in module.main.__doc__.splitlines() if "python -m" in line]
    assert examples
    assert all(line.startswith(f"python -m modgnn_rl.{name}") for line in examples)


@pytest.mark.parametrize("width", [60, 80, 200])
def test_the_overview_is_as_wide_as_the_terminal(monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    lines = [line for line in overview().splitlines() if "python -m" not in line]  # to be pasted
    assert max(map(len, lines)) <= max(width, 80)


@pytest.mark.parametrize(
    ("arguments", "code", "out", "err"),
    [
        (["--version"], 0, f"modgnn_rl {modgnn_rl.__version__}\n", ""),
        (["train", "seed=1"], 2, "", "error: commands are modules: use python -m modgnn_rl.train\n"),
        (["evalute"], 2, "", "error: unknown command 'evalute'; did you mean 'evaluate'?\n"),
        (
            ["--completion", "fisch"],
            2,
            "",
            "error: unknown shell 'fisch': there is completion for bash, fish, zsh; did you mean",
        ),
    ],
)
def test_answers_and_exit_codes(capsys, arguments, code, out, err):
    assert main(arguments) == code
    captured = capsys.readouterr()
    assert captured.out == out
    assert captured.err.startswith(err)
    assert captured.err.count("\n") == (1 if err else 0)


BASH = """\
try() {{ COMP_LINE=$1 COMP_POINT=${{#1}}; _modgnn_rl; echo "${{COMPREPLY[@]}}"; }}
try 'python -m modgnn_rl.re'
try 'python -m modgnn_rl.train --mu'
try '{python} -m modgnn_rl.train trainer='
try "{python} -m modgnn_rl.train 'env.num_agents=[8,16]' trainer.ro"
try "{python} -m modgnn_rl.runs 'runs=here' so"
try '{python} -m modgnn_rl.evaluate run=ru'
try 'python setup.py b'
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_tab_in_bash(tmp_path):
    script = completion_script("bash") + BASH.format(python=shlex.quote(sys.executable))
    done = subprocess.run(
        ["bash", "--norc", "-c", script], env=ENVIRONMENT, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        "modgnn_rl.reproduce" if "replay" not in NAMES else "modgnn_rl.replay modgnn_rl.reproduce",
        "--multirun",
        "bc dagger mappo",  # what stands behind =, where bash breaks words
        "trainer.rotate= trainer.rounds=",
        "sort=",
        "",  # then bash completes files
        "",
    ]


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_a_closed_pipe_is_not_an_error():
    python = f"{shlex.quote(sys.executable)} -m modgnn_rl.train"
    first = f"{python} {FIRST['train']} --cfg job"  # can be composed
    script = f"{python} --help | true; echo ${{PIPESTATUS[0]}}; {first} | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", script], env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert (done.stdout.split(), done.stderr) == (["141", "141"], "")


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_can_parse_their_script(shell):
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell}")
    done = subprocess.run([shell, "-n"], input=completion_script(shell), capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
