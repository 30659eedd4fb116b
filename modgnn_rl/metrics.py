"""The registered metrics: their headings, and their values. Nothing here imports torch.

A metric is registered where its function is defined, with ``@METRICS.register(name, ...)``, and appears from there in
the evaluation table and its JSON, on dashboards, in replays and in comparisons of runs. The options, all literals:

- ``title``: name for people; ``unit``: ``"%"`` for a fraction of episodes, empty for none; ``better``: ``"lower"`` or
  ``"higher"``; ``about``: what it is, for the note below a table.
- ``task``: the task that it is a metric of; default: all tasks that have its inputs.
- ``inputs``: what the function takes, of ``position``, ``action``, ``expert_action``, ``difference`` (of these two),
  ``controlled``, ``reward``, ``success``, and the task's own; default: the position. ``settings``: settings of the task
  that it takes after them; default: none.
- ``over_time``: how the steps of an episode become one value. ``"mean"`` and ``"sum"`` also average over the agents if
  the function returns a value per agent; ``"min"``, ``"any"``, and ``"last"``, the state after the last step, do not.
- ``cell``: format of a cell of the table, of ``mean``, ``std``, ``median``, ``low`` and ``high`` over episodes, and, of
  a minimum over time, ``min``.
- ``every``: number of steps between two evaluations of a costly metric; default: 1.
- ``replay``: whether replays plot it; default: False.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from modgnn_rl.registry import METRICS, TASKS

if TYPE_CHECKING:
    from torch import Tensor

    from modgnn_rl.configs.schema import TaskConfig

__all__ = ["compute_metrics", "heading", "higher_is_better", "over_flocks", "unit_of"]


def heading(name: str, task: str) -> str:
    """Title of a metric with its unit in brackets; of one that is not registered, its name in words."""
    if name not in METRICS:
        return name.replace("_", " ")
    title, unit = str(METRICS[name].options["title"]), unit_of(name, task)
    return f"{title} [{unit}]" if unit else title


def unit_of(name: str, task: str) -> str:
    """Unit of a metric; a task may say what that of the error or the reward is, with ``units=`` where it registers."""
    entry = TASKS.peek(task)
    units = {} if entry is None else entry.option("units", {})
    return str(units.get(name, METRICS[name].options["unit"]))


def higher_is_better(name: str) -> bool:
    """Whether higher values of a metric are better; of one that is not registered, such as a loss, they are not."""
    return name in METRICS and METRICS[name].options["better"] == "higher"


def compute_metrics(names: Iterable[str], config: TaskConfig, quantities: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Values of registered metrics.

    Args:
        names: of the metrics.
        config: settings of the task, for the settings that metrics depend on.
        quantities: by name, what the metrics are computed from (``inputs``), each with leading dimensions ``*B``.

    Returns:
        by name, ``[*B]``, or ``[*B, N]`` of a metric that has a value per agent.
    """
    values = {}
    for name in names:
        entry = METRICS[name]
        inputs = [quantities[key] for key in entry.options.get("inputs", ("position",))]
        values[name] = entry.load()(*inputs, *(getattr(config, key) for key in entry.options.get("settings", ())))
    return values


def over_flocks(name: str, values: Tensor) -> float:
    """One value for all flocks and steps: the minimum of what is a minimum over time, else the mean."""
    if METRICS[name].options["over_time"] == "min":
        return float(values.min())
    return float((values if values.is_floating_point() else values.double()).mean())
