"""Tab completion of ``python -m modgnn_rl.<command>`` in bash, zsh and fish."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from modgnn_rl.cli.overview import commands
from modgnn_rl.errors import InputError, suggestion

__all__ = ["answer_tab", "completion_script"]

SHELLS = ("bash", "fish", "zsh")


def completion_script(shell: str) -> str:
    """The script after which a shell completes ``python -m modgnn_rl.<command>``, in the shell's language.

    Args:
        shell: ``"bash"``, ``"zsh"`` or ``"fish"``.

    Raises:
        InputError: another shell.
    """
    if shell not in SHELLS:
        raise InputError(
            f"unknown shell '{shell}': there is completion for {', '.join(SHELLS)}{suggestion(shell, SHELLS)}"
        )
    modules = " ".join(f"modgnn_rl.{name}" for name in commands())
    script = Path(__file__).with_name(f"completion.{shell}")
    return script.read_text(encoding="utf-8").replace("@MODULES@", modules)


def answer_tab(ask_hydra: Callable[[], Any], arguments: Sequence[str], schema: type) -> None:
    """Answer ``--shell-completion``.

    For ``install=<shell>`` print our script, since Hydra's does not know ``python -m``. For a query print what Hydra
    offers, without what does not belong to the command: groups of other commands, and Hydra's own settings.

    Args:
        ask_hydra: prints Hydra's answer.
        arguments: command line without flags.
        schema: dataclass of the command's settings.
    """
    if arguments and arguments[0].startswith("install="):
        print(completion_script(arguments[0].removeprefix("install=")))
        return
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        ask_hydra()
    own = {field.name for field in dataclasses.fields(schema)}
    print("\n".join(word for word in output.getvalue().split() if re.split("[.=]", word.lstrip("+~"))[0] in own))
