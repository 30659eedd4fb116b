"""Tables as text: what is best in them, and that each written form can be read back."""

from __future__ import annotations

import csv
import io
import math
import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from modgnn_rl.errors import InputError
from modgnn_rl.reporting.table import Table, as_csv, as_latex, as_markdown, first_number, latex_escape, numeric_columns

ROWS: list[list[str | float]] = [
    ["expert", "-", 0.0, "3.55 ± 3.96"],
    ["modgnn_mlp", 1, 0.19712, "3.9 ± 2.1 [3.7, 4.1]"],
    ["gcn|final", 2, 0.1971, "-"],
    ["diverged", 3, math.nan, "1,024 ± 7"],
]
TABLE = Table("Error & 100 % of f_pre", ["model", "K", "error", "distance"], ROWS, "In m^2/s^2.", {2: "low", 3: "high"})


def test_the_best_of_a_column_is_the_best_that_is_shown():
    assert TABLE.winners() == {(0, 2), (3, 3)}
    compared = Table(TABLE.title, TABLE.header, ROWS, best=TABLE.best, references=["expert"])
    assert compared.winners() == {(1, 2), (2, 2), (3, 3)}  # 0.197 twice, for the eye
    nobody = Table("none", ["model", "error"], [["gcn", math.nan], ["central", "-"]], best={1: "low"})
    assert nobody.winners() == set()


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("0.197 ± 0.1", 0.197),
        ("-3", -3),
        ("\u22122.5 m", -2.5),
        ("1,024 m", 1024),
        ("12,5", 12),
        (".5", 0.5),
        ("1e-5", 1e-5),
        ("34 %", 34),
        ("below 7", 7),
    ],
)
def test_first_number(text, number):
    assert first_number(text) == number


def test_texts_without_a_number():
    assert all(math.isnan(first_number(text)) for text in ("-", "", "n/a", "expert", "nan"))


def test_markdown_marks_the_best_and_keeps_its_columns():
    lines = as_markdown(TABLE).splitlines()
    assert lines[0] == "### Error & 100 % of f_pre"
    grid = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines if line.startswith("|")]
    assert {len(row) for row in grid} == {4}
    assert [cell.strip() for cell in grid[0]] == ["model", "K", "error ↓", "distance ↑"]
    assert [cell.strip() for cell in grid[2]] == ["expert", "-", "**0.000**", "3.55 ± 3.96"]
    assert lines[-1] == "In m^2/s^2."


@example([("a\rb", 0.1), ('"\n,', 1e300)])
@given(st.lists(st.tuples(st.text(), st.floats(allow_nan=False))))
def test_csv_reads_back_with_all_digits(rows):
    written = as_csv(Table("any", ["name", "value"], rows, best={1: "low"}))
    found = list(csv.reader(io.StringIO(written, newline="")))
    assert found[0] == ["name", "value"]
    assert [(name, float(value)) for name, value in found[1:]] == [
        (name.replace("\r", " "), value) for name, value in rows
    ]


def test_latex_marks_the_best_and_escapes_the_rest():
    text = as_latex(TABLE)
    assert r"\caption{Error \& 100 \% of f\_pre. In m\textasciicircum{}2/s\textasciicircum{}2.}" in text
    assert r"expert & -- & \textbf{0.000} & 3.55 $\pm$ 3.96 \\" in text
    assert r"diverged & 3 & -- & \textbf{1,024 $\pm$ 7} \\" in text
    assert r"error $\downarrow$ & distance $\uparrow$ \\" in text
    assert r"\begin{tabular}{lrrr}" in text
    assert [text.index(rf"\{rule}rule") for rule in ("top", "mid", "bottom")] == sorted(
        text.index(rf"\{rule}rule") for rule in ("top", "mid", "bottom")
    )


@given(st.text(alphabet="\\{}$&#%_^~<>|-1a "))
def test_no_special_character_of_latex_is_left(text):
    escaped = latex_escape(text)
    for command in (r"\textbackslash{}", r"\textasciicircum{}", r"\textasciitilde{}", "$<$", "$>$", "$|$", "$-$"):
        escaped = escaped.replace(command, "")
    assert not re.search(r"(?<!\\)[{}$&#%_^~<>|]", escaped)
    assert not re.search(r"\\(?![{}$&#%_])", escaped)


def test_a_row_cannot_be_taken_for_an_option_of_the_line_above():
    assert "    {}[0, 1] & 2 \\\\" in as_latex(Table("intervals", ["interval", "n"], [["[0, 1]", 2]]))


def test_tables_without_rows_are_written():
    empty = Table("nothing", ["model", "error"], [], best={1: "low"})
    assert "model" in as_markdown(empty)
    assert r"\begin{tabular}{ll}" in as_latex(empty)
    assert as_csv(empty) == "model,error\n"
    assert numeric_columns(empty) == set()


def test_rows_and_marks_must_fit_the_header():
    with pytest.raises(InputError, match="row 2 of the table 'own' has 1 cells; give 2"):
        Table("own", ["model", "error"], [["gcn", 1.0], ["gcn"]])
    with pytest.raises(InputError, match="no column 2; name one of 0 to 1"):
        Table("own", ["model", "error"], [], best={2: "low"})
