"""The self-contained report: one HTML page with tables, figures and what is needed to make it again."""

from __future__ import annotations

import importlib.resources
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from modgnn_rl.errors import InputError
from modgnn_rl.reporting.figure import Drawing, can_draw, draw, page_colours
from modgnn_rl.reporting.table import Table, numeric_columns, slug
from modgnn_rl.utils.files import write_atomically
from modgnn_rl.utils.provenance import Provenance, gather_provenance

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

__all__ = ["Details", "Figure", "Provenance", "Section", "Table", "gather_provenance", "write_report"]

_NO_FIGURES = (
    "The figures are left out: <code>pip install 'modgnn-rl[plots]'</code>, then write this report again to draw them."
)
_LONG = 32  # characters; a longer cell may break into lines
_BETTER = {"low": "lower is better", "high": "higher is better"}


@dataclass(frozen=True)
class Figure:
    """A figure, drawn when the report is written.

    Attributes:
        name: name of its files ``figures/<name>.svg`` and ``.png``: letters, digits and ``_ . + -``; used once.
        draw: draws onto an empty matplotlib figure, see `modgnn_rl.reporting.plots`. It is called twice, with a wide
            figure for
            the page and for papers and with a narrow one for phones.
        caption: what is to be seen; screen readers read it in place of the figure.
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

    All is drawn before anything is written, each file is written whole or not at all, and the page last. Without
    matplotlib the page is written without figures and says which extra draws them.

    Args:
        folder: made when missing.
        title: of the page.
        sections: in order.
        provenance: shown at the end of the page; see `gather_provenance`.

    Returns:
        the path of the page.

    Raises:
        InputError: the folder cannot be written, two figures bear one name, or a name cannot name a file.
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
            raise InputError(f"the figure name {name!r} cannot name a file: use letters, digits and _ . + - only")
        if names.count(name) > 1:
            raise InputError(f"two figures are named {name!r}: give each a name of its own")


def _page(title: str, sections: Sequence[Section], provenance: Provenance, drawings: Mapping[str, Drawing]) -> str:
    names = _unique_names()
    headings = [section.title for section in sections] + ["How this was made"]
    anchors = [names(heading) for heading in headings]
    body = [_section(section, anchor, drawings, names) for section, anchor in zip(sections, anchors, strict=False)]
    if not drawings and any(isinstance(part, Figure) for section in sections for part in section.parts):
        body.insert(0, f'<p class="note">{_NO_FIGURES}</p>')
    light, dark = page_colours()
    template = importlib.resources.files("modgnn_rl.reporting").joinpath("report.html").read_text(encoding="utf-8")
    return Template(template).substitute(
        title=escape(title),
        made=escape(_made(provenance)),
        light=light,
        dark=dark,
        contents="\n".join(
            f'<li><a href="#{anchor}">{escape(heading)}</a></li>'
            for anchor, heading in zip(anchors, headings, strict=True)
        ),
        body="\n".join([*body, _origin(provenance, headings[-1], anchors[-1])]),
    )


def _section(section: Section, anchor: str, drawings: Mapping[str, Drawing], names: Callable[[str], str]) -> str:
    parts = [_heading(2, section.title, anchor), _paragraphs(section.text)]
    for part in section.parts:
        if isinstance(part, Table):
            parts.append(_table(part, names(part.title)))
        elif isinstance(part, Details):
            parts.append(_details(part))
        elif part.name in drawings:
            parts.append(_figure(part, drawings[part.name], names(f"figure {part.name}")))
    return f'<section aria-labelledby="{anchor}">\n' + "\n".join(filter(None, parts)) + "\n</section>"


def _table(table: Table, anchor: str) -> str:
    winners, numeric = table.winners(), numeric_columns(table)

    def head(column: int, text: str) -> str:
        hint = f'<span class="unseen"> ({_BETTER[table.best[column]]})</span>' if column in table.best else ""
        kinds = _class("number" if column in numeric else "")
        return f'<th scope="col"{kinds}>{_unbroken(escape(text))}{hint}</th>'

    def cell(row: int, column: int, text: str) -> str:
        best = (row, column) in winners
        kinds = _class(
            "number" if column in numeric else "", "long" if len(text) > _LONG else "", "best" if best else ""
        )
        content = f'<strong>{escape(text)}</strong><span class="unseen"> (best)</span>' if best else escape(text)
        return f'<th scope="row"{kinds}>{content}</th>' if column == 0 else f"<td{kinds}>{content}</td>"

    rows = []
    for number, texts in enumerate(table.text()):
        kinds = _class("reference" if texts[0] in table.references else "")
        rows.append(f"<tr{kinds}>{''.join(cell(number, column, text) for column, text in enumerate(texts))}</tr>")
    lines = [
        _heading(3, table.title, anchor),
        f'<div class="scroll" role="region" aria-labelledby="{anchor}" tabindex="0">',
        f'<table aria-labelledby="{anchor}">',
        f"<thead><tr>{''.join(head(column, text) for column, text in enumerate(table.head()))}</tr></thead>",
        "<tbody>",
        *rows,
        "</tbody>",
        "</table>",
        "</div>",
        f'<p class="caption">{escape(_sentences(table))}</p>' if _sentences(table) else "",
    ]
    return "\n".join(filter(None, lines))


def _class(*names: str) -> str:
    """An attribute with the names that are not empty; nothing without any."""
    given = " ".join(filter(None, names))
    return f' class="{given}"' if given else ""


def _unbroken(text: str) -> str:
    """Text whose last character, an arrow or a unit, stays with the word before it."""
    return re.sub(r" (\S)$", r"&nbsp;\1", text)


def _sentences(table: Table) -> str:
    """The caption, and what the marks in the table mean."""
    marks = "Bold: best of its column." if table.winners() else ""
    return " ".join(text for text in (table.caption.strip(), marks) if text)


def _figure(figure: Figure, drawing: Drawing, anchor: str) -> str:
    alt = escape(figure.caption or figure.name, quote=True)
    pictures = [
        svg.replace("<svg ", f'<svg class="{kind}" role="img" aria-label="{alt}" ', 1)
        for kind, svg in (("wide", drawing.wide), ("narrow", drawing.narrow))
    ]
    caption = f"<figcaption>{escape(figure.caption)}</figcaption>" if figure.caption else ""
    return "\n".join([f'<figure id="{anchor}">', *pictures, caption, "</figure>"])


def _details(details: Details) -> str:
    return f"<details><summary>{escape(details.title)}</summary><pre>{escape(details.text)}</pre></details>"


def _heading(level: int, text: str, anchor: str) -> str:
    link = f'<a class="anchor" href="#{anchor}" aria-label="Link to: {escape(text, quote=True)}">#</a>'
    return f'<h{level} id="{anchor}">{escape(text)}{link}</h{level}>'


def _paragraphs(text: str) -> str:
    return "\n".join(f"<p>{escape(part.strip())}</p>" for part in re.split(r"\n\s*\n", text) if part.strip())


def _made(provenance: Provenance) -> str:
    """One line below the title: when, with what, of which commit."""
    version = provenance.versions.get("modgnn-rl")
    parts = [
        provenance.times.get("finished", ""),
        f"modgnn-rl {version}" if version else "",
        f"commit {provenance.commit[:10]}" if provenance.commit else "",
    ]
    return " · ".join(part for part in parts if part)


def _origin(provenance: Provenance, heading: str, anchor: str) -> str:
    commands = "\n".join(map(escape, provenance.commands))
    lists = {"Times": provenance.times, "Hardware": provenance.hardware, "Versions": provenance.versions}
    if provenance.commit:
        lists["Code"] = {"commit": provenance.commit}
    parts = [_heading(2, heading, anchor), "<h3>Commands</h3>", f"<pre>{commands}</pre>"]
    for name, entries in lists.items():
        items = "".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in entries.items())
        parts += [f"<h3>{name}</h3>", f"<dl>{items}</dl>"] if items else []
    return f'<section aria-labelledby="{anchor}">\n' + "\n".join(parts) + "\n</section>"


def _unique_names() -> Callable[[str], str]:
    """A function that turns titles into anchors, no two alike."""
    taken: dict[str, int] = {}

    def name(text: str) -> str:
        base = slug(text)
        taken[base] = taken.get(base, 0) + 1
        return base if taken[base] == 1 else f"{base}-{taken[base]}"

    return name
