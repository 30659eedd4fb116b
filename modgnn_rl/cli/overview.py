"""What ``python -m modgnn_rl`` says: which commands there are, what to try first, and how Tab completes them."""

from __future__ import annotations

import ast
import shutil
import textwrap
from pathlib import Path

import modgnn_rl
from modgnn_rl.errors import InputError, suggestion

__all__ = ["commands", "completion", "overview"]

ROOT = Path(modgnn_rl.__file__).parent
FIRST = {
    "train": "trainer.rounds=10 evaluation.num_flocks=10",
    "replay": "'run=runs/<date>-<name>'",
    "runs": "",
}


def commands() -> dict[str, str]:
    """The first sentence of each command's docstring, by its name.

    Read from the files, where whatever calls `modgnn_rl.cli.command.run_command` is a command: importing them takes
    long.
    """
    found = {}
    for path in sorted(ROOT.glob("*.py")):
        source = path.read_text(encoding="utf-8")
        if "    run_command(main" in source:
            body = {getattr(node, "name", ""): node for node in ast.parse(source).body}
            if isinstance(main := body.get("main"), ast.FunctionDef):
                found[path.stem] = (ast.get_docstring(main) or "").partition("\n\n")[0]
    return found


def overview() -> str:
    """What there is and what to try first, as wide as the terminal."""
    width = min(max(shutil.get_terminal_size((120, 24)).columns, 60), 120)
    found = commands()
    column = max(map(len, found)) + 4
    indent = " " * column
    summary = (modgnn_rl.__doc__ or "").partition("\n")[0].removeprefix("modgnn_rl: ")
    lines = [
        f"modgnn_rl {modgnn_rl.__version__}: {summary}",
        "",
        "python -m modgnn_rl.<command> [setting=value ...]",
        "",
        *(
            textwrap.fill(f"  {name}".ljust(column) + text, width, subsequent_indent=indent)
            for name, text in found.items()
        ),
        "",
        "Try first: a few minutes of training, which end with a table and a rollout",
        *(f"  python -m modgnn_rl.{name} {settings}".rstrip() for name, settings in FIRST.items()),
        "",
        "Every choice and every setting of a command",
        "  python -m modgnn_rl.train --help",
        "",
        "Tab completes commands, choices and settings in bash (or zsh, fish) after",
        '  eval "$(python -m modgnn_rl --completion bash)"',
    ]
    return "\n".join(lines)


def completion(shell: str) -> str:
    """The script after which a shell completes ``python -m modgnn_rl.<command>``, in the shell's own language.

    Args:
        shell: ``"bash"``, ``"zsh"`` or ``"fish"``.

    Raises:
        InputError: it is another one.
    """
    scripts = {path.suffix[1:]: path for path in sorted(Path(__file__).parent.glob("completion.*"))}
    if shell not in scripts:
        raise InputError(f"there is completion for {', '.join(scripts)}, not for {shell}{suggestion(shell, scripts)}")
    modules = " ".join(f"modgnn_rl.{name}" for name in commands())
    return scripts[shell].read_text(encoding="utf-8").replace("@MODULES@", modules)
