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

from modgnn_rl.utils.text import markdown

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "docs" / "results.md", ROOT / "README.md")
RESULTS = ROOT / "results" / "small"
STAGES = {"cloned": "tables", "DAgger": "tables-after-dagger", "MAPPO": "tables-after-mappo"}
SHORT = (
    *("ModGNN-MLP, K = 1", "ModGNN-MLP, K = 2", "ModGNN-MLP, K = 3", "ModGNN-MLP [-f_mid], K = 1"),
    *("ModGNN-MLP [-f_pre], K = 1", "GCN [+f_final], K = 1", "GCN, K = 1", "Central"),
    *("moment_force, K = 1", "pair_force, K = 1", "local expert (1 hop)", "zero action"),
)
Rows = dict[str, dict[str, str]]


def read(stage: str, table: str) -> Rows:
    """The rows of a table of a stage, by their first cell; none where it was not run."""
    file = RESULTS / STAGES[stage] / f"{table}.csv"
    if not file.exists():
        return {}
    with file.open(encoding="utf-8", newline="") as lines:
        return {next(iter(row.values())): row for row in csv.DictReader(lines)}


def shown(rows: Rows, name: str, column: str) -> str:
    """A number with three digits, text as it is, or a dash where there is neither."""
    text = rows.get(name, {}).get(column, "nan")
    try:
        return "-" if text == "nan" else f"{float(text):.3f}"
    except ValueError:
        return text


class Column(NamedTuple):
    """A figure: heading, name of the CSV files, and in them the column of ours and, if any, the paper's."""

    heading: str
    table: str
    ours: str
    paper: str | None = None


def figures(columns: Sequence[Column], only: Sequence[str] = ()) -> str:
    """A row for each model, or for some only: each figure as the paper has it and after all stages that were run."""
    header = ["model"]
    everywhere = dict.fromkeys(name for stage in STAGES for name in read(stage, columns[0].table))
    body = {name: [name] for name in only or everywhere}
    for column in columns:
        stages = {stage: rows for stage in STAGES if (rows := read(stage, column.table))}
        first, *others = [*(["paper"] if column.paper else []), *stages]
        header += [f"{column.heading}: {first}", *others]
        for name, cells in body.items():
            cells += [shown(stages["cloned"], name, column.paper)] if column.paper else []
            cells += [shown(rows, name, column.ours) for rows in stages.values()]
    return markdown([header, *body.values()])


def claims() -> str:
    """A row for each ordering of the paper's: whether it holds, and how many of its comparisons do."""
    stages = {stage: rows for stage in STAGES if (rows := read(stage, "claims"))}
    body = [[name, *(verdict(rows[name]) for rows in stages.values())] for name in stages["cloned"]]
    return markdown([["the paper says", *stages], *body])


def verdict(row: Mapping[str, str]) -> str:
    """The verdict on an ordering, with its comparisons."""
    word = "**holds**" if row["here"] == "holds" else row["here"]
    away = f", {row['reversed']} reversed" if row["reversed"] != "0" else ""
    return f"{word} ({row['comparisons that hold']}{away})"


VALIDATION = Column("validation", "table1", "mean", "paper")
CLOSED_LOOP = Column("closed loop", "table2", "error", "error, paper")
TABLES: dict[str, Callable[[], str]] = {
    "errors": lambda: figures([VALIDATION, CLOSED_LOOP]),
    "sizes": lambda: figures([Column(f"{n} agents", "table3", f"N = {n}", f"N = {n}, paper") for n in (16, 64)]),
    "rewards": lambda: figures(
        [Column("reward", "table2_iqm", "reward"), Column("leader lost", "table2", "leader lost")]
    ),
    "claims": claims,
    "short": lambda: figures([VALIDATION, CLOSED_LOOP], SHORT),
}


def renewed(text: str) -> str:
    """A page with its tables regenerated."""
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
