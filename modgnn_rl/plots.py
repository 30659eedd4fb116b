"""What the studies draw: curves with bands and points with intervals, with references as labelled lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Curve", "Estimate", "draw_curves", "draw_intervals", "draw_panels"]


@dataclass(frozen=True)
class Curve:
    """A line with its band, all of one length ``[P]``.

    Attributes:
        x: positions; a NaN in `y` breaks the line.
        y: the mean over seeds or flights.
        low: lower end of the interval; None draws no band.
        high: upper end of the interval.
    """

    x: ArrayLike
    y: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None


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
    log_x: bool = False,
    log_y: bool = False,
) -> None:
    """Draw curves, each named at its end in its colour.

    Args:
        figure: an empty figure.
        curves: by name; a name always has the same colour, see `colour_of`.
        x_label: with its unit.
        y_label: with its unit.
        references: heights of horizontal lines by name, such as ``{"expert": 0.0}``.
        log_x: powers of two on the axis.
        log_y: a logarithmic axis.
    """
    raise NotImplementedError


def draw_intervals(
    figure: Figure,
    groups: Mapping[str, Mapping[str, Estimate]],
    *,
    x_label: str,
    references: Mapping[str, float] | None = None,
    log_x: bool = False,
) -> None:
    """Draw a row for each name, with its points and intervals side by side: models by row, K by colour.

    Args:
        figure: an empty figure.
        groups: estimates by name of the series (``"K = 1"``), then by name of the row (``"ModGNN-MLP"``); a single
            series colours its rows by name.
        x_label: with its unit.
        references: positions of vertical lines by name.
        log_x: a logarithmic axis.
    """
    raise NotImplementedError


def draw_panels(figure: Figure, titles: Sequence[str]) -> list[Figure]:
    """Divide a figure into panels side by side, each to be drawn into as a figure of its own."""
    raise NotImplementedError
