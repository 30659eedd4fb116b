"""What the studies draw: curves with bands and points with intervals, with references as labelled lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from modgnn_rl.reporting.figure import INK, MUTED, PAPER, styles_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

__all__ = ["Curve", "Estimate", "draw_curves", "draw_intervals", "draw_panels"]

_MARKERS = "o^sDvP"
_DASHES = (0, (4, 3))  # of references
NARROW = 5.0  # inches; narrower figures are for a phone, or panels
_LABEL, _LINE_HEIGHT = 7.5, 1.25  # points; in font sizes


@dataclass(frozen=True)
class Curve:
    """A line with its band, all of one length ``[P]``.

    Attributes:
        x: positions; a NaN in `y` breaks the line.
        y: the mean over seeds or rollouts.
        low: lower end of the interval; None draws no band.
        high: upper end of the interval.
    """

    x: ArrayLike
    y: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None

    @classmethod
    def over_seeds(cls, x: ArrayLike, values: ArrayLike, *, rng: np.random.Generator) -> Curve:
        """The mean of several curves with its 95 % percentile bootstrap interval (Efron 1979), whole curves resampled.

        Args:
            x: positions ``[P]``.
            values: one curve a seed or rollout ``[S, P]``; where one of them is NaN, the line is broken.
            rng: source of the resampling.
        """
        curves = np.asarray(values, dtype=np.float64)
        weights = rng.multinomial(len(curves), np.full(len(curves), 1 / len(curves)), size=2000) / len(curves)
        low, high = np.quantile(weights @ curves, [0.025, 0.975], axis=0)
        return cls(x, curves.mean(0), low, high)


@dataclass(frozen=True)
class Estimate:
    """A value with the ends of its confidence interval; equal ends draw no interval."""

    value: float
    low: float
    high: float


def draw_curves(
    figure: Figure,
    curves: Mapping[str, Curve],
    *,
    x_label: str,
    y_label: str,
    references: Mapping[str, float] | None = None,
    marks: Mapping[str, float] | None = None,
    log_x: bool = False,
    log_y: bool = False,
) -> None:
    """Draw curves with their bands, each named at its end in its colour.

    Args:
        figure: an empty figure.
        curves: by name; a model always has the same colour, see `modgnn_rl.reporting.figure.styles_of`.
        x_label: with its unit.
        y_label: with its unit.
        references: heights of horizontal lines by name, such as ``{"expert": 0.0}``; a logarithmic axis leaves out what
            is not above zero.
        marks: positions of vertical lines by name, such as ``{"trained with": 32}``.
        log_x: powers of two on the axis.
        log_y: a logarithmic axis.
    """
    axes = figure.add_subplot(xlabel=x_label, ylabel=y_label)
    ends: dict[str, tuple[float, str, Any]] = {}
    positions = np.unique(np.concatenate([np.asarray(curve.x, float) for curve in curves.values()] or [np.zeros(0)]))
    few = len(positions) <= 12
    for name, style in styles_of(curves).items():
        x, y = np.asarray(curves[name].x, float), np.asarray(curves[name].y, float)
        marker: dict[str, Any] = (
            {"marker": style.marker, "markeredgecolor": PAPER, "markeredgewidth": 0.8} if few else {}
        )
        axes.plot(x, y, color=style.colour, linestyle=style.line, **marker)
        low, high = curves[name].low, curves[name].high
        if low is not None and high is not None:
            axes.fill_between(x, np.asarray(low, float), np.asarray(high, float), color=style.colour, alpha=0.15, lw=0)
        known = np.isfinite(y)
        if known.any():
            ends[name] = (y[known][-1], style.colour, style.line)
    if log_x:
        axes.set_xscale("log", base=2)
    if log_y:
        axes.set_yscale("log")
        _plain_logarithmic(axes.yaxis)
    if few:
        every = 2 if len(positions) > 6 and figure.bbox.width / figure.dpi < NARROW else 1
        axes.set_xticks(positions, [f"{x:,.4g}" if at % every == 0 else "" for at, x in enumerate(positions)])
        axes.xaxis.minorticks_off()
    for name, height in _within_reach(references, log_y).items():
        axes.axhline(height, color=MUTED, linestyle=_DASHES, linewidth=1, zorder=1)
        ends[name] = (height, MUTED, _DASHES)
    _mark(axes, _within_reach(marks, log_x))
    _label_ends(axes, ends)


def draw_intervals(
    figure: Figure,
    groups: Mapping[str, Mapping[str, Estimate]],
    *,
    x_label: str,
    references: Mapping[str, float] | None = None,
    log_x: bool = False,
) -> None:
    """Draw a row for each name, with the points and intervals of all series: models by row, K by marker.

    Args:
        figure: an empty figure; its height is fitted to the rows.
        groups: estimates by name of the series (``"K = 1"``), then by name of the row (``"ModGNN-MLP"``), in order
            from the top; a row may lack an estimate.
        x_label: with its unit.
        references: positions of vertical lines by name.
        log_x: a logarithmic axis.
    """
    names = list(dict.fromkeys(name for rows in groups.values() for name in rows))
    styles = styles_of(names)
    axes = figure.add_subplot(xlabel=x_label)
    step = min(0.22, 0.7 / max(len(groups), 1))
    for number, rows in enumerate(groups.values()):
        shift = (number - (len(groups) - 1) / 2) * step
        for name, estimate in rows.items():
            colour, height = styles[name].colour, names.index(name) + shift
            axes.plot([estimate.low, estimate.high], [height, height], color=colour, linewidth=1.6)
            marker = _MARKERS[number % len(_MARKERS)]
            axes.plot(estimate.value, height, marker, color=colour, markersize=6)
    axes.set_yticks(range(len(names)), names, color=INK)
    axes.tick_params("y", length=0)
    axes.set_ylim(max(len(names), 1) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    if log_x:
        axes.set_xscale("log")
        _plain_logarithmic(axes.xaxis)
    if hasattr(figure, "set_figheight"):  # a panel has the height of its figure
        figure.set_figheight(1.1 + len(names) * max(0.3, 0.16 * len(groups)))
    _mark(axes, _within_reach(references, log_x))
    if len(groups) > 1:
        _legend_of_markers(axes, list(groups))


def draw_panels(figure: Figure, titles: Sequence[str]) -> list[Figure]:
    """Divide a figure into panels, each to be drawn into as a figure: two in a row, or one where it is narrow."""
    columns = 1 if figure.get_figwidth() < NARROW else min(2, len(titles))
    rows = -(-len(titles) // columns)
    figure.set_figheight(max(3.0 * rows, figure.get_figheight()))
    panels: list[Figure] = list(figure.subfigures(rows, columns, squeeze=False).flat)[: len(titles)]
    for panel, title in zip(panels, titles, strict=True):
        panel.suptitle(title, fontweight="bold", fontsize="medium", x=0.02, ha="left")
    return panels


def _legend_of_markers(axes: Axes, names: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=INK, marker=_MARKERS[number % len(_MARKERS)], linestyle="") for number in range(len(names))
    ]
    columns = 3 if axes.figure.bbox.width / axes.figure.dpi < NARROW else 6
    axes.figure.legend(
        handles,
        names,
        loc="outside lower left" if axes.figure.get_suptitle() else "outside upper left",
        ncols=columns,
        handletextpad=0.2,
        columnspacing=1.2,
    )


def _within_reach(lines: Mapping[str, float] | None, logarithmic: bool) -> dict[str, float]:
    """The lines that an axis can show: a logarithmic one has no zero."""
    return {name: at for name, at in (lines or {}).items() if np.isfinite(at) and (at > 0 or not logarithmic)}


def _mark(axes: Axes, positions: Mapping[str, float]) -> None:
    """Draw vertical lines, named above the axes, on as many levels as it takes to keep the names apart."""
    texts = []
    for name, x in positions.items():
        axes.axvline(x, color=MUTED, linestyle=_DASHES, linewidth=1, zorder=1)
        at: dict[str, Any] = {
            "xy": (x, 1),
            "xycoords": ("data", "axes fraction"),
            "xytext": (0, 3),
            "textcoords": "offset points",
        }
        texts.append(axes.annotate(name, **at, ha="center", va="bottom", color=MUTED, fontsize=_LABEL))
    axes.figure.canvas.figure.draw_without_rendering()
    taken: list[float] = []  # right end of each level, pixels
    for text in sorted(texts, key=lambda text: text.xy[0]):
        box = text.get_window_extent()
        level = next((level for level, end in enumerate(taken) if end + 4 < box.x0), len(taken))
        taken[level : level + 1] = [box.x1]
        text.xyann = (0, 3 + level * _LABEL * _LINE_HEIGHT)


def _label_ends(axes: Axes, ends: Mapping[str, tuple[float, str, Any]]) -> None:
    """Write names right of the axes, each tied to the height where its line ends and moved no more than it must."""
    texts = {}
    for name, (_, colour, line) in ends.items():
        ink = MUTED if colour == MUTED else INK
        at: dict[str, Any] = {
            "xy": (1, 0.5),
            "xycoords": "axes fraction",
            "xytext": (12, 0),
            "textcoords": "offset points",
        }
        tie = {"arrowstyle": "-", "color": colour, "linestyle": line, "shrinkA": 0, "shrinkB": 0, "relpos": (0, 0.5)}
        texts[name] = axes.annotate(name, **at, va="center", color=ink, fontsize=_LABEL, arrowprops=tie)
    axes.figure.canvas.figure.draw_without_rendering()  # sets the limits, and leaves room for the names
    height = axes.get_window_extent().height / axes.figure.dpi * 72  # points
    to_points = axes.transData + axes.transAxes.inverted()
    heights = {name: height * float(np.clip(to_points.transform((1, y))[1], 0, 1)) for name, (y, *_) in ends.items()}
    for name, moved in zip(heights, _kept_apart(list(heights.values()), _LABEL * _LINE_HEIGHT, height), strict=True):
        texts[name].xy = (1, heights[name] / height)
        texts[name].xyann = (12, moved - heights[name])


def _kept_apart(heights: Sequence[float], size: float, top: float) -> list[float]:
    """Heights from 0 to `top` in the same order, at least `size` apart where there is room for that."""
    count = len(heights)
    size = min(size, top / max(count - 1, 1))
    order = np.argsort(heights, kind="stable")
    steps = size * np.arange(count)
    gaps = np.asarray(heights, float)[order] - steps  # apart means that these do not fall
    upwards, downwards = np.maximum.accumulate(gaps), np.minimum.accumulate(gaps[::-1])[::-1]
    moved = np.empty(count)
    moved[order] = np.clip((upwards + downwards) / 2, 0, top - size * max(count - 1, 0)) + steps
    return moved.tolist()


def _plain_logarithmic(axis: Axis) -> None:
    """Plain numbers on a logarithmic axis: 0.1, 0.2, 0.5, 1."""
    from matplotlib.ticker import LogLocator, NullLocator

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 200 * low else (1,)))
    axis.set_major_formatter(lambda value, _: f"{value:,.4g}")
    axis.set_minor_locator(NullLocator())
