"""A still image of recorded rollouts, for papers: agents, edges, arrows, trails, a leader as a star."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modgnn_rl.utils.files import write_atomically
from modgnn_rl.visualization.recording import QUANTUM, Recording, shortest_edges

__all__ = ["write_image"]

Array = NDArray[Any]

YAW, PITCH = -2.05, 0.42  # rad; the initial view of the replay page
TRAIL = 1.5  # s
PANEL = 4.2  # inches
MAX_EDGES = 3000  # the shortest are drawn
COLOURS = {"agent": "#172033", "leader": "#d01f2e", "edge": "#d9a400", "target": "#1b62d0", "trail": "#9aa5ba"}


def write_image(path: str | os.PathLike[str], recordings: Mapping[str, Recording], index: int) -> None:
    """Draw rollouts at one step, side by side at the same scale, and write the image atomically.

    Args:
        path: the file; its suffix is ``.svg``, ``.png`` or another that matplotlib writes, and its folder must exist.
        recordings: by the name of the acting policy.
        index: index of the step among the recorded ones; an episode that has ended shows its last one.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Text remains text, and equal rollouts give equal files.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "modgnn_rl", "font.family": "sans-serif"}):
        figure = Figure(figsize=(PANEL * len(recordings), PANEL * 1.04), facecolor="white")
        FigureCanvasAgg(figure)
        figure.subplots_adjust(0.01, 0.01, 0.99, 0.93, 0.03)
        panels = []
        for column, (name, recording) in enumerate(recordings.items()):
            axes = figure.add_subplot(1, len(recordings), column + 1)
            axes.set_axis_off()
            axes.set_aspect("equal")
            axes.set_title(f"{name}, {index * recording.period:.1f} s", fontsize=11, color=COLOURS["agent"])
            panels.append((axes, _draw(axes, recording, min(index, len(recording) - 1))))
        extent = 1.04 * max(extent for _, extent in panels)
        for axes, _ in panels:
            axes.set(xlim=(-extent, extent), ylim=(-extent, extent))
        kind = Path(path).suffix.removeprefix(".").lower() or "svg"
        file = io.BytesIO()
        figure.savefig(file, format=kind, dpi=160, metadata={"Date": None} if kind == "svg" else None)
    write_atomically(path, file.getvalue())


def _draw(axes: Any, recording: Recording, index: int) -> float:
    """Draw one flock around its centre; return the largest coordinate drawn, m."""
    begin = max(0, index - round(TRAIL / recording.period))
    metres = recording.position[begin : index + 1].astype(np.float64) * QUANTUM
    plane = _view_plane(recording.dims)
    paths = (metres - metres[-1].mean(0)) @ plane  # [T, N, 2]
    frame = recording.frame(index)
    spots, tips = paths[-1], frame.arrow.astype(np.float64) @ plane
    pairs = shortest_edges(frame, MAX_EDGES)
    length = np.linalg.norm(frame.position[pairs[:, 0]] - frame.position[pairs[:, 1]], axis=-1)
    bounds = (0.0, 0.4, 0.7, 1.01)
    longest = length.max() if len(length) else 1.0
    for low, high, alpha in zip(bounds, bounds[1:], (0.8, 0.45, 0.25), strict=False):
        some = pairs[(length / longest >= low) & (length / longest < high)]
        axes.plot(*_strokes(spots[some]).T, color=COLOURS["edge"], linewidth=0.6, alpha=alpha, zorder=1)
    axes.plot(*_strokes(paths[::4].swapaxes(0, 1)).T, color=COLOURS["trail"], linewidth=0.9, alpha=0.8, zorder=2)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.0055, "headwidth": 3.6, "headlength": 4.2}
    leads = np.arange(len(spots)) == (-1 if recording.leader is None else recording.leader)
    for some, colour in ((~leads, "target"), (leads, "leader")):
        axes.quiver(*spots[some].T, *tips[some].T, color=COLOURS[colour], zorder=3, **arrows)
    size = 5.5 * min(1.0, (32 / len(spots)) ** (1 / 3)) + 0.5
    white = {"markeredgecolor": "white", "markeredgewidth": 0.6, "linestyle": "none"}
    axes.plot(*spots[~leads].T, marker="o", markersize=size, color=COLOURS["agent"], zorder=4, **white)
    marks = (frame.marks - metres[-1].mean(0)) @ plane
    axes.plot(*marks.T, marker="+", markersize=9, color=COLOURS["leader"], linestyle="none", zorder=4)
    axes.plot(*spots[leads].T, marker="*", markersize=17, color=COLOURS["leader"], zorder=5, **white)
    return float(np.abs(np.concatenate((spots, spots + tips))).max())


def _view_plane(dims: int) -> Array:
    """The image's axes in the world frame, [3, 2]: seen from above if space has fewer than three dimensions."""
    if dims < 3:
        return np.eye(3)[:, :2]
    right = np.array((-np.sin(YAW), np.cos(YAW), 0.0))
    up = np.array((-np.sin(PITCH) * np.cos(YAW), -np.sin(PITCH) * np.sin(YAW), np.cos(PITCH)))
    return np.stack((right, up), 1)


def _strokes(lines: Array) -> Array:
    """Lines [L, P, 2] as one line with gaps [L (P + 1), 2], which makes much smaller files than many lines."""
    return np.pad(lines, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)
