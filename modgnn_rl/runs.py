"""``python -m modgnn_rl.runs``: list runs, or compare them."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import RunsConfig, as_list
from modgnn_rl.errors import InputError
from modgnn_rl.tracking.comparison import compare, differing_settings
from modgnn_rl.tracking.listing import list_runs, sort_key
from modgnn_rl.tracking.summary import RunSummary, find_runs, summarise_run

__all__ = ["find_run", "show_runs"]


def main(config: RunsConfig) -> None:
    """List runs with their state and main metrics, or compare some of them.

    Examples::

        python -m modgnn_rl.runs
        python -m modgnn_rl.runs 'state=[stopped,killed]'
        python -m modgnn_rl.runs 'compare=[gcn-seed0,gcn-seed1]'
    """
    print(show_runs(config, width=shutil.get_terminal_size((100, 24)).columns))


def show_runs(config: RunsConfig, width: int = 100) -> str:
    """The text that the command prints.

    Args:
        config: settings of the command.
        width: of the terminal, in characters.

    Raises:
        InputError: no such folder or run, or nothing to compare.
    """
    root = Path(config.runs)
    if config.compare is not None:
        found = [find_run(str(part), root) for part in as_list(config.compare)]
        runs = [run for whole in found for run in whole.policies or [whole]]
        text = compare(runs)
        return _as_json({"settings": differing_settings(runs), "runs": runs}) if config.format == "json" else text
    if not root.is_dir():
        raise InputError(f"the folder {root} does not exist: give the one that contains the runs, as in runs=runs")
    runs = [summarise_run(path, name) for name, path in _named(root).items()]
    runs = [run for run in runs if config.state is None or run.state in as_list(config.state)]
    runs.sort(key=lambda run: sort_key(run, config.sort))
    if config.format == "json":
        return _as_json(runs)
    return list_runs(runs, width if config.format == "text" else None)


def find_run(part: str, root: Path) -> RunSummary:
    """Find a run, or one of several policies of a run, by its folder or a unique part of its name.

    Args:
        part: a run folder, or a part of the name of one run in ``root``; if no run matches, of one policy, whose name
            is ``<run>/<policy>``.
        root: the folder that contains the runs.

    Raises:
        InputError: no run or several runs match, or the run cannot be read.
    """
    names, folder = _named(root), Path(part)
    if (folder / "config.yaml").is_file():
        found = [policy for policy in summarise_run(folder.parent).policies if policy.path == folder]
        found = found or [summarise_run(folder)]
    elif part in names:
        found = [summarise_run(names[part], part)]
    elif matches := [name for name in names if part in name]:
        found = [summarise_run(names[name], name) for name in matches]
    else:
        policies = [policy for name, path in names.items() for policy in summarise_run(path, name).policies]
        found = [policy for policy in policies if part in policy.name]
    if not found:
        raise InputError(f"no run in {root} has {part!r} in its name: python -m modgnn_rl.runs lists all")
    if len(found) > 1:
        several = ", ".join(run.name for run in found[:4]) + (", ..." if len(found) > 4 else "")
        raise InputError(f"{len(found)} runs have {part!r} in their names ({several}): give a longer part of the name")
    if not found[0].config:
        raise InputError(f"{found[0].path} cannot be compared ({found[0].problem}): leave it out")
    return found[0]


def _named(root: Path) -> dict[str, Path]:
    """The run folders in a folder by their relative names."""
    return {path.absolute().name if path == root else str(path.relative_to(root)): path for path in find_runs(root)}


def _as_json(found: Any) -> str:
    return json.dumps(found, indent=2, default=_plain)


def _plain(value: Any) -> Any:
    """What JSON contains of a summary: all but the settings."""
    if isinstance(value, RunSummary):
        return {entry.name: getattr(value, entry.name) for entry in dataclasses.fields(value) if entry.name != "config"}
    return str(value)


if __name__ == "__main__":
    run_command(main, RunsConfig, "runs")
