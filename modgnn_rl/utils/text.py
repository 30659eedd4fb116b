"""Text tables, aligned for a terminal or as Markdown, and numbers in their cells."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["aligned", "format_duration", "format_value", "markdown", "printable"]


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """A table with columns separated by two spaces; the first row is the header."""
    return "\n".join("  ".join(cells).rstrip() for cells in _padded(rows))


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first row is the header."""
    lines = [f"| {' | '.join(cells)} |" for cells in _padded([[c.replace("|", "\\|") for c in row] for row in rows])]
    lines.insert(1, "".join("|" if letter == "|" else "-" for letter in lines[0].replace("\\|", "--")))
    return "\n".join(lines)


def format_value(value: float | None) -> str:
    """A number with three significant digits, or ``-`` for None."""
    return "-" if value is None else f"{value:.3g}"


def format_duration(seconds: float | None) -> str:
    """A duration (s) in a suitable unit, or ``-`` for None."""
    if seconds is None:
        return "-"
    for unit, length, most in (("s", 1, 100), ("min", 60, 100), ("h", 3600, 48)):
        if seconds < most * length:
            return f"{seconds / length:.2g} {unit}"
    return f"{seconds / 86400:.2g} d"


def printable(text: str) -> str:
    """Text with control characters, which move the cursor of a terminal, replaced by ``?``."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _padded(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Printable cells, padded to the width of their columns."""
    clean = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*clean, strict=True)]
    return [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in clean]
