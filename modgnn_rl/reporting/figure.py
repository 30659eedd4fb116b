"""How figures look, and how one is drawn: for the page, for a phone, and as files for papers."""

from __future__ import annotations

import importlib.util
import io
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["GRID", "INK", "MUTED", "PAPER", "Drawing", "Style", "can_draw", "draw", "page_colours", "styles_of"]

WIDE, NARROW = (7.2, 3.8), (3.7, 3.9)  # inches: of the page and of papers, and of a phone

INK, MUTED, GRID, PAPER = "#1b1c1e", "#63666b", "#dcdee2", "#fefefe"
# A colour for each model on a light page and on a dark one. A search found them: as far apart as they can be, with
# and without each of the three kinds of colour blindness, at a contrast of at least 4.5 with the page.
_SERIES = {
    "#0848b5": "#4b6fac",
    "#bf720b": "#f6863c",
    "#4d9988": "#9eedb4",
    "#632e1a": "#a26354",
    "#980772": "#e5a1dc",
    "#9570de": "#9776fe",
    "#5e621f": "#eeed36",
    "#491753": "#82b28e",
}
_DARK = {INK: "#e8e9eb", MUTED: "#a2a6ad", GRID: "#3a3d42", PAPER: "#17181a"} | _SERIES
_MARKERS, _LINES = "os^Dv<>p", ("-", "--", ":", "-.")
# Models that share a slot are seldom seen in one figure.
_SLOTS = (
    ("modgnn_mlp", "modgnn"),
    ("no_mid",),
    ("no_pre",),
    ("gcn",),
    ("gcn_final",),
    ("central",),
    ("gat", "moment_force"),
    ("mpnn", "pair_force"),
)
_THEME: Any = {
    "font.size": 9,
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": "medium",
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "savefig.dpi": 200,
}


@dataclass(frozen=True)
class Style:
    """How a series looks: colour, marker, and a line that sets it apart from another of the same colour."""

    colour: str
    marker: str
    line: str


@dataclass(frozen=True)
class Drawing:
    """One figure in its forms."""

    wide: str
    """SVG to stand inside a page, in the colours of the page."""
    narrow: str
    """The same, laid out for a phone."""
    svg: bytes
    """For papers, black on white, letters as outlines."""
    png: bytes
    """For papers, 200 dots an inch."""


def can_draw() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def styles_of(names: Iterable[str]) -> dict[str, Style]:
    """The style of each series of a figure.

    A model has the same colour and marker in every figure: ``ModGNN-MLP``, ``modgnn_mlp`` and ``modgnn_mlp, K = 2``
    are one model, and lines of one model differ in their dashes. Other names take the slots that are left: beside
    models from the last one, whose model is the least often seen.
    """
    names = list(names)
    slots = {name: _slot(name) for name in names}
    free = [slot for slot in range(len(_SLOTS)) if slot not in slots.values()] or list(range(len(_SLOTS)))
    if len(free) < len(_SLOTS):
        free.reverse()
    others = 0
    seen: dict[int, int] = {}
    styles = {}
    for name, slot in slots.items():
        if slot is None:
            slot, others = free[others % len(free)], others + 1
        seen[slot] = seen.get(slot, -1) + 1
        styles[name] = Style(list(_SERIES)[slot], _MARKERS[slot], _LINES[seen[slot] % len(_LINES)])
    return styles


def draw(name: str, onto: Callable[[Figure], None]) -> Drawing:
    """Draw a figure in all its forms.

    Args:
        name: of the figure, different from that of any other in the page.
        onto: draws onto an empty figure; called twice, with a wide one and with a narrow one.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    def drawn(size: tuple[float, float]) -> Figure:
        figure = Figure(figsize=size, layout="constrained", facecolor="none")
        FigureCanvasAgg(figure)
        onto(figure)
        return figure

    with mpl.rc_context():
        mpl.rcdefaults()  # whatever the user's own file of settings says
        mpl.rcParams.update(_THEME | {"svg.hashsalt": name})
        wide, narrow = drawn(WIDE), drawn(NARROW)
        svg, png = (_saved(wide, form, facecolor="white") for form in ("svg", "png"))
        mpl.rcParams["svg.fonttype"] = "none"  # letters stay text, to be searched and read aloud
        page, phone = (_saved(figure, "svg").decode() for figure in (wide, narrow))
    return Drawing(_inline(page, f"{name}-wide"), _inline(phone, f"{name}-narrow"), svg, png)


def page_colours() -> tuple[str, str]:
    """The declarations of CSS that the drawings inside a page take their colours from: light, dark."""
    light = "".join(f"{_variable(colour)}:{colour};" for colour in _DARK)
    dark = "".join(f"{_variable(colour)}:{other};" for colour, other in _DARK.items())
    return light, dark


def _slot(name: str) -> int | None:
    """The slot of the model that a name begins with, the longest that fits."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower())
    found = [
        (len(model), slot)
        for slot, models in enumerate(_SLOTS)
        for model in models
        if re.match(rf"{model}(_|$)", plain)
    ]
    return max(found)[1] if found else None


def _saved(figure: Figure, form: str, **options: Any) -> bytes:
    file = io.BytesIO()
    about = {"Date": None} if form == "svg" else {}
    figure.savefig(file, format=form, metadata=about, **options)
    return file.getvalue()


def _inline(svg: str, name: str) -> str:
    """An SVG file as an element of a page: scaled by the page, coloured by it, with names of its own."""
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    svg = re.sub(r'<svg [^>]*?(viewBox="[^"]*")[^>]*>', r"<svg \1>", svg, count=1)
    svg = re.sub(r'(\sid="|url\(#|href="#)', rf"\g<1>{name}-", svg).replace("xlink:href", "href")
    svg = svg.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")
    for colour in _DARK:
        svg = re.sub(re.escape(colour), f"var({_variable(colour)})", svg, flags=re.IGNORECASE)
    return svg


def _variable(colour: str) -> str:
    return f"--c{colour.removeprefix('#')}"
