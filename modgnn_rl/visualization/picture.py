"""A still picture of recorded rollouts, for papers: agents, links, target velocities, trails, the leader as a star."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modgnn_rl.envs.flocking.recording import QUANTUM, Recording
from modgnn_rl.utils.files import write_atomically

__all__ = ["write_picture"]

Array = NDArray[Any]

YAW, PITCH = -2.05, 0.42  # rad; from where the page looks at first
TRAIL = 1.5  # s
PANEL = 4.2  # inches
MOST_LINKS = 3000  # the shortest are drawn
COLOURS = {"agent": "#172033", "leader": "#d01f2e", "link": "#d9a400", "target": "#1b62d0", "trail": "#9aa5ba"}


def write_picture(path: str | os.PathLike[str], rollouts: Mapping[str, Recording], step: int) -> None:
    """Draw rollouts at one step, side by side and of one scale, and write the picture, whole or not at all.

    Args:
        path: the file, whose name ends in ``.svg``, ``.png`` or another that matplotlib writes; its folder must exist.
        rollouts: recordings by the name of who flies.
        step: index of the step among those that were kept.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Text stays text, and the same rollout gives the same file.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "modgnn_rl", "font.family": "sans-serif"}):
        figure = Figure(figsize=(PANEL * len(rollouts), PANEL * 1.04), facecolor="white")
        FigureCanvasAgg(figure)
        figure.subplots_adjust(0.01, 0.01, 0.99, 0.93, 0.03)
        drawn = []
        for column, (name, rollout) in enumerate(rollouts.items()):
            axes = figure.add_subplot(1, len(rollouts), column + 1)
            axes.set_axis_off()
            axes.set_aspect("equal")
            axes.set_title(
                f"{name}, {step * rollout.stride / rollout.frequency:.1f} s", fontsize=11, color=COLOURS["agent"]
            )
            drawn.append((axes, _draw(axes, rollout, step)))
        reach = 1.04 * max(float(reach) for _, reach in drawn)
        for axes, _ in drawn:
            axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
        kind = Path(path).suffix.removeprefix(".").lower() or "svg"
        file = io.BytesIO()
        figure.savefig(file, format=kind, dpi=160, metadata={"Date": None} if kind == "svg" else None)
    write_atomically(path, file.getvalue())


def _draw(axes: Any, rollout: Recording, step: int) -> float:
    """Draw one flock about its centre; return the distance from there to the farthest thing drawn, m."""
    seconds = rollout.stride / rollout.frequency
    begin = max(0, step - round(TRAIL / seconds))
    metres = rollout.position[begin : step + 1].astype(np.float64) * QUANTUM
    centre = metres[-1].mean(0)
    axis_x = np.array((-np.sin(YAW), np.cos(YAW), 0.0))
    axis_y = np.array((-np.sin(PITCH) * np.cos(YAW), -np.sin(PITCH) * np.sin(YAW), np.cos(PITCH)))
    plane = np.stack((axis_x, axis_y), 1)
    paths = (metres - centre) @ plane  # [T, N, 2]
    spots, tips = paths[-1], rollout.target_velocity[step].astype(np.float64) @ plane
    spots3 = metres[-1]
    links = rollout.links(step)
    agents = len(spots)
    receiver, sender = links // agents, links % agents
    pairs = np.unique(np.sort(np.stack((receiver, sender), 1), 1), axis=0)
    length = np.linalg.norm(spots3[pairs[:, 0]] - spots3[pairs[:, 1]], axis=-1)
    pairs, length = (values[np.argsort(length)[:MOST_LINKS]] for values in (pairs, np.sort(length)))
    shares = (0.0, 0.4, 0.7, 1.01)
    longest = length.max() if len(length) else 1.0
    for low, high, alpha in zip(shares, shares[1:], (0.8, 0.45, 0.25), strict=False):
        some = pairs[(length / longest >= low) & (length / longest < high)]
        axes.plot(*_strokes(spots[some]).T, color=COLOURS["link"], linewidth=0.6, alpha=alpha, zorder=1)
    axes.plot(*_strokes(paths[::4].swapaxes(0, 1)).T, color=COLOURS["trail"], linewidth=0.9, alpha=0.8, zorder=2)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.0055, "headwidth": 3.6, "headlength": 4.2}
    for some, colour in ((slice(1, None), "target"), (slice(0, 1), "leader")):
        axes.quiver(*spots[some].T, *tips[some].T, color=COLOURS[colour], zorder=3, **arrows)
    size = 5.5 * min(1.0, (32 / agents) ** (1 / 3)) + 0.5
    white = {"markeredgecolor": "white", "markeredgewidth": 0.6, "linestyle": "none"}
    axes.plot(*spots[1:].T, marker="o", markersize=size, color=COLOURS["agent"], zorder=4, **white)
    axes.plot(*spots[:1].T, marker="*", markersize=17, color=COLOURS["leader"], zorder=5, **white)
    return float(np.abs(np.concatenate((spots, spots + tips))).max())


def _strokes(lines: Array) -> Array:
    """Lines [L, P, 2] as one line with gaps [L (P + 1), 2], which makes far smaller files than many."""
    return np.pad(lines, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)
