"""The self-contained report: one HTML page with tables, figures and what is needed to make it again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from modgnn_rl.provenance import Provenance, gather_provenance
from modgnn_rl.tabular import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

__all__ = ["Details", "Figure", "Provenance", "Section", "Table", "gather_provenance", "write_report"]


@dataclass(frozen=True)
class Figure:
    """A figure, drawn when the report is written.

    Attributes:
        name: name of its files ``figures/<name>.svg`` and ``.png``: letters, digits and ``_ . + -``; unique in a report.
        draw: draws onto an empty matplotlib figure, see `modgnn_rl.plots`.
        caption: what is to be seen; read aloud instead of the figure.
    """

    name: str
    draw: Callable[[Canvas], None]
    caption: str = ""


@dataclass(frozen=True)
class Details:
    """Preformatted text behind a title that opens it: a configuration, a log."""

    title: str
    text: str


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs (separated by blank lines) and parts below it, in order."""

    title: str
    text: str = ""
    parts: Sequence[Table | Figure | Details] = ()


def write_report(folder: Path, title: str, sections: Sequence[Section], provenance: Provenance) -> Path:
    """Write ``report.html`` into a folder, and its figures into ``figures/`` for papers.

    Without matplotlib the page is written without figures and says which extra draws them.

    Args:
        folder: made when missing.
        title: of the page.
        sections: in order.
        provenance: the last section; see `gather_provenance`.

    Returns:
        the path of the page.

    Raises:
        InputError: the folder cannot be written, or two figures bear one name.
    """
    raise NotImplementedError
