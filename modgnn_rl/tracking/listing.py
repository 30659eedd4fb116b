"""A list of runs with their state and main metrics."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections.abc import Callable, Collection, Sequence
from datetime import datetime

from modgnn_rl.metrics import higher_is_better
from modgnn_rl.tracking.summary import RunSummary, training_metrics
from modgnn_rl.utils.text import aligned, format_duration, format_value, markdown, printable

__all__ = ["list_runs", "next_steps", "sort_key", "state_of"]

ENDED_EARLY = ("stopped", "killed", "failed")
LABELS = {"validation_loss": "loss"}
LESS_IMPORTANT = ("speed", "age", "took", "reward", "best")  # columns to leave out if there is no room, in this order
SHORTEST_NAME = 24
LEGEND = (
    "took: training time; last: the trainer's objective in the last round (error on the policy's rollouts, validation "
    "loss, or reward per step); best: its best mean over 5 rounds; eval., reward: error and reward in the "
    "evaluation"
)


def list_runs(runs: Sequence[RunSummary], width: int | None = None) -> str:
    """A table with a row per run, the problems of some, and what to do next.

    Args:
        runs: in the order of the rows.
        width: columns are left out and names shortened to fit; default: everything, as Markdown.
    """
    if not runs:
        return "No runs to list.\nNext: python -m modgnn_rl.train starts one"
    rows = [row for run in runs for row in (run, *run.policies)]
    columns = _columns({policy.path for run in runs for policy in run.policies})
    if len({run.task for run in runs}) < 2:
        del columns["task"]
    cells = {header: [header, *map(cell, rows)] for header, cell in columns.items()}
    if width is None:
        table = markdown(list(zip(*cells.values(), strict=True)))
    else:
        for header in LESS_IMPORTANT:
            if _excess(cells, width) > 0:
                del cells[header]
        longest = max(map(len, cells["run"])) - max(0, _excess(cells, width))
        cells["run"] = [_shortened(name, max(SHORTEST_NAME, longest)) for name in cells["run"]]
        table = aligned(list(zip(*cells.values(), strict=True)))
    notes = [printable(f"{run.name}: {note}") for run in runs if (note := run.problem or run.reason)]
    parts = [
        table,
        "\n".join(notes),
        textwrap.fill(LEGEND, width or 120),
        "\n".join(next_steps(runs) or _next_looks(runs)),
    ]
    return "\n\n".join(part for part in parts if part)


def _next_looks(runs: Sequence[RunSummary]) -> list[str]:
    """What to do with the last finished runs."""
    finished = list(dict.fromkeys(run.run for run in runs if run.state == "finished"))
    if len(finished) > 1:
        return [f"Next: python -m modgnn_rl.runs {shlex.quote(f'compare=[{finished[-2]},{finished[-1]}]')}"]
    return [f"Next: python -m modgnn_rl.evaluate {shlex.quote(f'run={run}')}" for run in finished]


def sort_key(run: RunSummary, sort: str) -> tuple[float, str]:
    """Key that sorts the newest, longest or best run last, and runs without the value first.

    Args:
        run: a run.
        sort: see `modgnn_rl.configs.schema.RunsConfig`.
    """
    if sort in ("started", "updated"):
        time = run.started if sort == "started" else run.updated
        rank = time.timestamp() if time else None
    elif sort == "seconds":
        rank = run.seconds
    else:
        rank = _evaluated(run, "error") if sort == "evaluation" else run.last.get(sort)
        if rank is not None and not higher_is_better(sort):
            rank = -rank
    return -math.inf if rank is None else rank, run.path.name


def next_steps(runs: Sequence[RunSummary]) -> list[str]:
    """How to resume the last of the runs that ended early."""
    ended = list(dict.fromkeys(run.run for run in runs if run.state in ENDED_EARLY))
    if not ended:
        return []
    others = [f"{len(ended) - 1} more can be resumed like this."] if len(ended) > 1 else []
    return [f"Next: python -m modgnn_rl.train {shlex.quote(f'resume={ended[-1]}')}", *others]


def state_of(run: RunSummary) -> str:
    """The state, with the progress of a run that is not finished."""
    return (
        f"{run.state} {run.share:.0%}"
        if run.share is not None and run.state in ("training", *ENDED_EARLY)
        else run.state
    )


def _columns(policies: Collection[object]) -> dict[str, Callable[[RunSummary], str]]:
    """The cells of a row by header; what several policies share is in the row of their run only."""

    def shared(cell: Callable[[RunSummary], str]) -> Callable[[RunSummary], str]:
        return lambda run: "" if run.path in policies else cell(run)

    now = datetime.now().astimezone()
    return {
        "run": lambda run: f"  {run.path.name}" if run.path in policies else run.name,
        "task": shared(lambda run: run.task or "-"),
        "state": shared(state_of),
        "age": shared(lambda run: format_duration((now - run.updated).total_seconds() if run.updated else None)),
        "took": shared(lambda run: format_duration(run.seconds)),
        "last": _last_value,
        "best": lambda run: format_value(run.best),
        "eval.": lambda run: format_value(_evaluated(run, "error")),
        "reward": lambda run: format_value(_evaluated(run, "reward")),
        "speed": shared(lambda run: f"{format_value(run.speed)} {run.unit}/s" if run.speed else "-"),
    }


def _last_value(run: RunSummary) -> str:
    """The last value of the trainer's objective, or of another metric if there is none."""
    metric = next((name for name in (run.objective, *training_metrics()) if name in run.last), None)
    return "-" if metric is None else f"{LABELS.get(metric, metric)} {format_value(run.last[metric])}"


def _evaluated(run: RunSummary, metric: str) -> float | None:
    """Mean of a metric in the evaluation at the size and in the environment of training, else at another size."""
    tables = [table for size in run.sizes if (table := run.evaluations.get(f"{size} agents"))]
    tables += [table for name, table in run.evaluations.items() if "," not in name]
    spread = tables[0][metric] if tables else None
    return spread["mean"] if spread else None


def _excess(cells: dict[str, list[str]], width: int) -> int:
    """By how many characters a table is too wide."""
    return sum(max(map(len, column)) + 2 for column in cells.values()) - 2 - width


def _shortened(name: str, length: int) -> str:
    """A name without its middle: it begins with a date and ends with the name of the run."""
    return name if len(name) <= length else f"{name[: length // 3]}...{name[len(name) - (length - length // 3 - 3) :]}"
