"""What ``python -m modgnn_rl`` prints: the commands, what to try first, and how to switch on Tab completion."""

from __future__ import annotations

import ast
import shutil
import textwrap
from pathlib import Path

import modgnn_rl

__all__ = ["commands", "overview"]

ROOT = Path(modgnn_rl.__file__).parent
FIRST = {
    "train": "trainer.rounds=10 evaluation.num_flocks=10",
    "replay": "'run=runs/<date>-<name>'",
    "runs": "",
}


def commands() -> dict[str, str]:
    """The first sentence of each command's docstring, by its name.

    A command is a module in ``modgnn_rl/`` that calls `modgnn_rl.cli.command.run_command`. The files are read, not
    imported, since that takes long.
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
    """The commands and what to try first, as wide as the terminal."""
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
        "Try first: a few minutes of training, then a table and a replay",
        *(f"  python -m modgnn_rl.{name} {settings}".rstrip() for name, settings in FIRST.items()),
        "",
        "All choices and settings of a command",
        "  python -m modgnn_rl.train --help",
        "",
        "Tab completion of commands, choices and settings in bash (or zsh, fish)",
        '  eval "$(python -m modgnn_rl --completion bash)"',
    ]
    return "\n".join(lines)
