"""A table of results, and its three written forms: Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from modgnn_rl.errors import InputError
from modgnn_rl.utils.text import markdown

__all__ = ["Table", "as_csv", "as_latex", "as_markdown"]

Cell = str | float
ARROWS = {"low": "↓", "high": "↑"}

_NUMBER = re.compile(r"[-+\u2212]?(?:(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE)
_LATEX = {
    **{letter: f"\\{letter}" for letter in "{}$&#%_"},
    **{"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"},
    **{"<": "$<$", ">": "$>$", "|": "$|$", "\u2212": "$-$", "±": r"$\pm$", "\u00d7": r"$\times$", "·": r"$\cdot$"},
    **{"≤": r"$\leq$", "≥": r"$\geq$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "→": r"$\rightarrow$", "²": "$^2$"},
    **{"∞": r"$\infty$", "\N{EN DASH}": "--", "\n": " "},
}


@dataclass(frozen=True)
class Table:
    """A table whose first column names the rows.

    Attributes:
        title: what the table shows.
        header: name of each column.
        rows: one cell for each column: text as it is, a float with three decimals, an int with all digits, NaN as "-".
        caption: units, number of rollouts, how to read it.
        best: columns whose best cells are marked, by position, and which end is better. A cell of text counts with
            the first number in it; cells that show the same number are marked together.
        references: first cells of the rows that stand there for comparison and are never marked, such as the expert.

    Raises:
        InputError: a row, or a column of `best`, does not fit the header.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    best: Mapping[int, Literal["low", "high"]] = field(default_factory=dict)
    references: Collection[str] = ()

    def __post_init__(self) -> None:
        width = len(self.header)
        for number, row in enumerate(self.rows, start=1):
            if len(row) != width:
                raise InputError(
                    f"row {number} of the table {self.title!r} has {len(row)} cells; give {width} as the header has"
                )
        if wrong := [column for column in self.best if not 0 <= column < width]:
            raise InputError(f"the table {self.title!r} has no column {wrong[0]}; name one of 0 to {width - 1} in best")

    def head(self) -> list[str]:
        """The header, with an arrow to the better end where the best cells are marked."""
        return [f"{name} {ARROWS[self.best[at]]}" if at in self.best else name for at, name in enumerate(self.header)]

    def text(self) -> list[list[str]]:
        """The rows as they are shown."""
        return [[_shown(cell) for cell in row] for row in self.rows]

    def winners(self) -> set[tuple[int, int]]:
        """Row and column of the cells to mark."""
        found = set()
        for column, end in self.best.items():
            values = [math.nan if row[0] in self.references else first_number(row[column]) for row in self.text()]
            known = [value for value in values if math.isfinite(value)]
            top = (min if end == "low" else max)(known, default=math.nan)
            found |= {(number, column) for number, value in enumerate(values) if value == top}
        return found


def as_markdown(table: Table) -> str:
    """The table in Markdown: its title as a heading of level 3, the best cells in bold, the caption below."""
    winners = table.winners()
    rows = [
        [f"**{cell}**" if (number, column) in winners else cell for column, cell in enumerate(row)]
        for number, row in enumerate(table.text())
    ]
    parts = [f"### {table.title}", markdown([table.head(), *rows]), table.caption]
    return "\n\n".join(part for part in parts if part) + "\n"


def as_csv(table: Table) -> str:
    """The table as CSV: the header and the rows, numbers with all their digits, nothing marked."""
    file = io.StringIO()
    # The writer quotes a carriage return only where lines end in one.
    rows = [[cell.replace("\r", " ") if isinstance(cell, str) else cell for cell in row] for row in table.rows]
    csv.writer(file, lineterminator="\n").writerows([table.header, *rows])
    return file.getvalue()


def as_latex(table: Table) -> str:
    r"""The table for LaTeX, with the rules of the package booktabs and the best cells in ``\textbf``.

    Its label is ``tab:`` and the title in lower case, words joined by hyphens.
    """
    winners = table.winners()
    texts = table.text()
    columns = "".join("r" if _is_numeric(column) else "l" for column in zip(*texts, strict=True))
    rows = [
        [_bold(cell) if (number, column) in winners else latex_escape(cell) for column, cell in enumerate(row)]
        for number, row in enumerate(texts)
    ]
    caption = ". ".join(text.strip().removesuffix(".") for text in (table.title, table.caption) if text.strip())
    lines = [
        r"\begin{table}",
        r"  \centering",
        rf"  \caption{{{latex_escape(caption)}.}}",
        rf"  \label{{tab:{slug(table.title)}}}",
        rf"  \begin{{tabular}}{{{columns or 'l' * len(table.header)}}}",
        r"    \toprule",
        _latex_row([latex_escape(name) for name in table.head()]),
        r"    \midrule",
        *map(_latex_row, rows),
        r"    \bottomrule",
        r"  \end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def first_number(text: str) -> float:
    """The first number in a text; NaN where there is none. ``1,024`` is one thousand and twenty-four."""
    found = _NUMBER.search(text)
    return float(found[0].replace(",", "").replace("\u2212", "-")) if found else math.nan


def slug(text: str) -> str:
    """Text as a name for an anchor or a label: lower-case letters and digits, joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "part"


def numeric_columns(table: Table) -> set[int]:
    """Columns, but the first, that hold numbers and nothing else: those are aligned to the right."""
    return {at for at, column in enumerate(zip(*table.text(), strict=True)) if at and _is_numeric(column)}


def latex_escape(text: str) -> str:
    """Text that LaTeX shows as it is; a minus before a number is a minus, a lone hyphen a dash."""
    if text == "-":
        return "--"
    text = re.sub(r"(?<![\w-])-(?=\.?\d)", "\u2212", text)
    return "".join(_LATEX.get(letter, letter) for letter in text)


def _bold(cell: str) -> str:
    return rf"\textbf{{{latex_escape(cell)}}}"


def _latex_row(cells: Sequence[str]) -> str:
    first = "{}" if cells[0].startswith(("[", "*")) else ""  # else LaTeX reads it as an option of the line above
    return f"    {first}{' & '.join(cells)} \\\\"


def _is_numeric(column: Sequence[str]) -> bool:
    return all(cell in ("-", "") or _NUMBER.match(cell) for cell in column)


def _shown(cell: Cell) -> str:
    if isinstance(cell, str):
        return cell.strip()
    if not math.isfinite(cell):
        return "-" if math.isnan(cell) else str(cell).replace("inf", "∞")
    if isinstance(cell, int):
        return str(cell)
    return f"{cell:.3f}" if cell == 0 or abs(cell) >= 0.0005 else f"{cell:.1e}"
