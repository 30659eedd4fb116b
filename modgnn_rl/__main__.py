"""``python -m modgnn_rl``: an overview of the commands."""

from __future__ import annotations

import argparse
import sys

import modgnn_rl
from modgnn_rl.cli.overview import commands, overview
from modgnn_rl.cli.tab import completion_script
from modgnn_rl.errors import InputError, suggestion


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
            print(completion_script(flags.completion) if flags.completion else overview())
    except (argparse.ArgumentError, InputError) as error:
        print("error:", error, file=sys.stderr)
        return 2
    return 0


def _not_understood(word: str) -> str:
    """Say what to type instead of an unexpected word."""
    if word in (found := commands()):
        return f"commands are modules: use python -m modgnn_rl.{word}"
    return f"unknown command '{word}'{suggestion(word, found) or '; the commands are ' + ', '.join(found)}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
