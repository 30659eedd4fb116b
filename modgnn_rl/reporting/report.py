"""A self-contained report: one HTML page with tables, figures and provenance."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
from markupsafe import Markup

from modgnn_rl.errors import InputError
from modgnn_rl.reporting.figure import Drawing, can_draw, draw, page_colours
from modgnn_rl.reporting.table import Table, numeric_columns, slug
from modgnn_rl.utils.files import write_atomically
from modgnn_rl.utils.provenance import Provenance, gather_provenance

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

__all__ = ["Details", "Figure", "Provenance", "Section", "Table", "gather_provenance", "write_report"]

LONG = 32  # characters; a longer cell may break into lines
BETTER = {"low": "lower is better", "high": "higher is better"}


@dataclass(frozen=True)
class Figure:
    """A figure, drawn when the report is written.

    Attributes:
        name: name of its files ``figures/<name>.svg`` and ``.png``: letters, digits and ``_ . + -``; used once.
        draw: draws onto an empty matplotlib figure, see `modgnn_rl.reporting.plots`. It is called twice, with a wide
            figure for the page and for papers and with a narrow one for phones.
        caption: description of the figure; also its text for screen readers.
    """

    name: str
    draw: Callable[[Canvas], None]
    caption: str = ""


@dataclass(frozen=True)
class Details:
    """Preformatted text, folded under a title: a configuration, a log."""

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

    Everything is drawn before anything is written, each file is written whole or not at all, and the page last. Without
    matplotlib the page is written without figures and says which extra installs it.

    Args:
        folder: created if missing.
        title: of the page.
        sections: in order.
        provenance: shown at the end of the page; see `gather_provenance`.

    Returns:
        the path of the page.

    Raises:
        InputError: the folder cannot be written, two figures have the same name, or a name is not a valid file name.
    """
    figures = [part for section in sections for part in section.parts if isinstance(part, Figure)]
    _check_names([figure.name for figure in figures])
    drawings = {figure.name: draw(figure.name, figure.draw) for figure in figures} if can_draw() else {}
    page = _page(title, sections, provenance, drawings)
    folder = Path(folder)
    try:
        (folder / "figures" if drawings else folder).mkdir(parents=True, exist_ok=True)
        for name, drawing in drawings.items():
            write_atomically(folder / "figures" / f"{name}.svg", drawing.svg)
            write_atomically(folder / "figures" / f"{name}.png", drawing.png)
        write_atomically(folder / "report.html", page)
    except OSError as error:
        raise InputError(
            f"cannot write the report into {folder} ({error.strerror}): choose a folder you can write to"
        ) from error
    return folder / "report.html"


def _check_names(names: Sequence[str]) -> None:
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9][\w.+-]*", name, re.ASCII):
            raise InputError(f"the figure name {name!r} is not a valid file name: use letters, digits and _ . + - only")
        if names.count(name) > 1:
            raise InputError(f"two figures are named {name!r}: give each its own name")


def _page(title: str, sections: Sequence[Section], provenance: Provenance, drawings: Mapping[str, Drawing]) -> str:
    """The page, from the template ``report.html``."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("modgnn_rl.reporting", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    anchor = _unique_anchors()
    headings = [{"title": text, "anchor": anchor(text)} for text in [*(s.title for s in sections), "Provenance"]]
    light, dark = page_colours()
    return environment.get_template("report.html").render(
        title=title,
        subtitle=_subtitle(provenance),
        light=Markup(light),
        dark=Markup(dark),
        headings=headings,
        figures_missing=not drawings and any(isinstance(part, Figure) for s in sections for part in s.parts),
        sections=[
            {
                **heading,
                "paragraphs": [part.strip() for part in re.split(r"\n\s*\n", section.text) if part.strip()],
                "parts": [_part(part, drawings, anchor) for part in section.parts],
            }
            for heading, section in zip(headings, sections, strict=False)
        ],
        provenance=provenance,
    )


def _part(part: Table | Figure | Details, drawings: Mapping[str, Drawing], anchor: Callable[[str], str]) -> Any:
    """What the template shows of a part; None for a figure that could not be drawn."""
    if isinstance(part, Details):
        return {"kind": "details", "title": part.title, "text": part.text}
    if isinstance(part, Table):
        return {"kind": "table", "title": part.title, "anchor": anchor(part.title), **_table(part)}
    if part.name not in drawings:
        return None
    drawing = drawings[part.name]
    svgs = {
        kind: Markup(svg.partition("<svg ")[2]) for kind, svg in (("wide", drawing.wide), ("narrow", drawing.narrow))
    }
    alt = part.caption or part.name
    return {
        "kind": "figure",
        "anchor": anchor(f"figure {part.name}"),
        "alt": alt,
        "svgs": svgs,
        "caption": part.caption,
    }


def _table(table: Table) -> dict[str, Any]:
    """Header and rows of a table with the classes of their cells."""
    winners, numeric = table.winners(), numeric_columns(table)

    def cell(row: int, column: int, text: str) -> dict[str, Any]:
        best = (row, column) in winners
        flags = {"number": column in numeric, "long": len(text) > LONG, "best": best}
        return {"text": text, "best": best, "classes": " ".join(name for name, holds in flags.items() if holds)}

    header = [
        {
            "text": re.sub(r" (\S)$", "\u00a0\\1", text),  # a unit or an arrow stays with the word before it
            "hint": BETTER.get(table.best.get(column, ""), ""),
            "classes": "number" if column in numeric else "",
        }
        for column, text in enumerate(table.head())
    ]
    rows = [
        {
            "reference": texts[0] in table.references,
            "cells": [cell(number, column, text) for column, text in enumerate(texts)],
        }
        for number, texts in enumerate(table.text())
    ]
    marks = "Bold: best of its column." if winners else ""
    return {"header": header, "rows": rows, "caption": " ".join(filter(None, (table.caption.strip(), marks)))}


def _subtitle(provenance: Provenance) -> str:
    """One line below the title: time, version, commit."""
    version = provenance.versions.get("modgnn-rl")
    parts = [
        provenance.times.get("finished", ""),
        f"modgnn-rl {version}" if version else "",
        f"commit {provenance.commit[:10]}" if provenance.commit else "",
    ]
    return " · ".join(part for part in parts if part)


def _unique_anchors() -> Callable[[str], str]:
    """A function that turns titles into anchors, all different."""
    taken: dict[str, int] = {}

    def anchor(text: str) -> str:
        base = slug(text)
        taken[base] = taken.get(base, 0) + 1
        return base if taken[base] == 1 else f"{base}-{taken[base]}"

    return anchor
