"""A table of results, and its three written forms: Markdown, CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

__all__ = ["Table", "as_csv", "as_latex", "as_markdown"]

Cell = str | float


@dataclass(frozen=True)
class Table:
    """A table whose first column names the rows.

    Attributes:
        title: what the table shows.
        header: name of each column.
        rows: one cell for each column; text, or a number that is shown with three decimals; NaN reads as "-".
        caption: units, number of flights, how to read it.
        best: columns whose best cells are marked, by position, and which end is better. A cell of text counts with
            the first number in it; rows without one never win.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    best: Mapping[int, Literal["low", "high"]] = field(default_factory=dict)


def as_markdown(table: Table) -> str:
    """The table in Markdown, best cells in bold, the caption below it."""
    raise NotImplementedError


def as_csv(table: Table) -> str:
    """The table as CSV (RFC 4180), numbers with all their digits, nothing marked."""
    raise NotImplementedError


def as_latex(table: Table) -> str:
    r"""The table for LaTeX, with the rules of the package booktabs and the best cells in ``\textbf``."""
    raise NotImplementedError
