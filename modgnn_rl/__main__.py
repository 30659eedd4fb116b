"""``python -m modgnn_rl``: what there is, and what to try first."""

from __future__ import annotations

import argparse
import sys

import modgnn_rl
from modgnn_rl.cli.overview import commands, completion, overview
from modgnn_rl.configs.settings import suggestion
from modgnn_rl.errors import InputError


def main(arguments: list[str]) -> int:
    """Print the overview, the version or a completion script; return the exit code."""
    parser = argparse.ArgumentParser(add_help=False, usage=argparse.SUPPRESS, exit_on_error=False)
    parser.add_argument("--version", action="store_true")
    parser.add_argument("--completion", metavar="SHELL")
    parser.add_argument("-h", "--help", action="store_true")
    try:
        flags, others = parser.parse_known_args(arguments)
        if others:
            raise InputError(_not_understood(others[0]))
        if flags.version:
            print("modgnn_rl", modgnn_rl.__version__)
        else:
            print(completion(flags.completion) if flags.completion else overview())
    except (argparse.ArgumentError, InputError) as error:
        print("error:", error, file=sys.stderr)
        return 2
    return 0


def _not_understood(word: str) -> str:
    """What to write instead of a word that this module has no use for."""
    if word in (found := commands()):
        return f"a command is a module of its own: python -m modgnn_rl.{word}"
    return f"{word} is no command{suggestion(word, found) or '; the commands are ' + ', '.join(found)}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
