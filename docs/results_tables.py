"""The tables of docs/results.md and of the README, made from the CSV files in results/.

    python docs/results_tables.py

writes them anew, between ``<!-- table NAME -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "docs" / "results.md", ROOT / "README.md")
RESULTS = ROOT / "results" / "small"
STAGES = {"cloned": "tables", "DAgger": "tables-after-dagger", "MAPPO": "tables-after-mappo"}
SHORT = (
    *("ModGNN-MLP, K = 1", "ModGNN-MLP, K = 2", "ModGNN-MLP, K = 3", "ModGNN-MLP [-f_mid], K = 1"),
    *("ModGNN-MLP [-f_pre], K = 1", "GCN [+f_final], K = 1", "GCN, K = 1", "Central"),
    *("LocalReynolds(hops=1)", "zero action"),
)
Rows = dict[str, dict[str, str]]


def read(stage: str, table: str) -> Rows:
    """The rows of a table of a stage, by their first cell; none where it was not run."""
    file = RESULTS / STAGES[stage] / f"{table}.csv"
    if not file.exists():
        return {}
    with file.open(encoding="utf-8", newline="") as lines:
        return {next(iter(row.values())): row for row in csv.DictReader(lines)}


def number(rows: Rows, name: str, column: str) -> str:
    """A figure with three digits, or a dash where there is none."""
    text = rows.get(name, {}).get(column, "nan")
    return "-" if text == "nan" else f"{float(text):.3f}"


class Column(NamedTuple):
    """An error, the paper's and ours: heading, name of the CSV files, columns in them."""

    heading: str
    table: str
    paper: str
    ours: str


def errors(columns: Sequence[Column], only: Sequence[str] = ()) -> str:
    """A row for each model, or for some only: each error as the paper has it and after all stages that were run."""
    header, names = ["model"], dict.fromkeys(only or read("cloned", columns[0].table))
    body = {name: [name] for name in names}
    for column in columns:
        stages = {stage: rows for stage in STAGES if (rows := read(stage, column.table))}
        header += [f"{column.heading}: paper", *stages]
        for name, cells in body.items():
            cells.append(number(stages["cloned"], name, column.paper))
            cells += [number(rows, name, column.ours) for rows in stages.values()]
    return markdown(header, list(body.values()))


def claims() -> str:
    """A row for each ordering of the paper's: whether it holds, and how many of its comparisons do."""
    stages = {stage: rows for stage in STAGES if (rows := read(stage, "claims"))}
    body = [[name, *(verdict(rows[name]) for rows in stages.values())] for name in stages["cloned"]]
    return markdown(["the paper says", *stages], body)


def verdict(row: Mapping[str, str]) -> str:
    """What became of an ordering."""
    word = "**holds**" if row["here"] == "holds" else row["here"]
    away = f", {row['reversed']} reversed" if row["reversed"] != "0" else ""
    return f"{word} ({row['comparisons that hold']}{away})"


def markdown(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [f"| {' | '.join(cells)} |" for cells in (header, *body)]
    return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]])


VALIDATION = Column("validation", "table1", "paper", "mean")
OWN_FLIGHTS = Column("own flights", "table2", "error, paper", "error")
TABLES: dict[str, Callable[[], str]] = {
    "errors": lambda: errors([VALIDATION, OWN_FLIGHTS]),
    "sizes": lambda: errors([Column(f"{n} agents", "table3", f"N = {n}, paper", f"N = {n}") for n in (16, 64)]),
    "claims": claims,
    "short": lambda: errors([VALIDATION, OWN_FLIGHTS], SHORT),
}


def renewed(text: str) -> str:
    """A page with its tables made anew."""
    return re.sub(
        r"(<!-- table (\w+) -->\n).*?(<!-- end -->)",
        lambda found: f"{found[1]}\n{TABLES[found[2]]()}\n\n{found[3]}",
        text,
        flags=re.DOTALL,
    )


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(renewed(page.read_text(encoding="utf-8")), encoding="utf-8")
        print(f"{page} has the tables of {RESULTS}")
