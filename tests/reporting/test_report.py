"""The report: safe text, no outside request, and what a reader finds in it."""

from __future__ import annotations

import re
import shutil
import subprocess
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest

from modgnn_rl.errors import InputError
from modgnn_rl.reporting import figure, report
from modgnn_rl.reporting.figure import styles_of
from modgnn_rl.reporting.plots import Curve, Estimate, _kept_apart, draw_curves, draw_intervals, draw_panels
from modgnn_rl.reporting.report import Details, Figure, Provenance, Section, Table, write_report

EVIL = "<script>alert(\"1\")</script> & 'x' $title"
PROVENANCE = Provenance(
    ["python -m modgnn_rl.reproduce 'name=<a & b>'"], {"modgnn-rl": "0.1.0"}, {"cores": "2"}, {"finished": "now"}, "abc"
)
TABLE = Table(
    EVIL, [EVIL, "error", "reward"], [["expert", 0.0, 9.0], [EVIL, 0.25, 3.0], ["gcn", 0.5, 4.0]], EVIL,
    {1: "low", 2: "high"}, ["expert"],
)  # fmt: skip


class Page(HTMLParser):
    """What a page holds, and whether its elements are nested as they should be."""

    VOID = ("meta", "link", "br", "img")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):  # noqa: D102
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):  # noqa: D102
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag):  # noqa: D102
        assert self.open.pop() == tag


def curves(figure):
    lines = {"ModGNN-MLP": Curve([4, 16, 64], [0.2, 0.1, 0.3], [0.1, 0.1, 0.2], [0.3, 0.2, 0.4]), EVIL: Curve([4], [1])}
    draw_curves(figure, lines, x_label="agents", y_label="m²/s²", references={"expert": 0.0}, marks={"here": 16})


def panels(figure):
    rows = {f"K = {hops}": {"gcn": Estimate(1, 0.5, 2), "central": Estimate(2, 1, 3)} for hops in (1, 2)}
    for panel in draw_panels(figure, ["one", "other"]):
        draw_intervals(panel, rows, x_label="m", references={"expert": 1.0, "zero action": 1.01}, log_x=True)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    pytest.importorskip("matplotlib")
    folder = tmp_path_factory.mktemp("report")
    sections = [
        Section(EVIL, f"{EVIL}\n\nnext", [TABLE, Figure("curves", curves, EVIL)]),
        Section(EVIL, "", [Figure("panels", panels), Details(EVIL, EVIL)]),
    ]
    assert write_report(folder / "new", EVIL, sections, PROVENANCE) == folder / "new" / "report.html"
    return folder / "new"


@pytest.fixture(scope="module")
def page(written):
    return (written / "report.html").read_text(encoding="utf-8")


def test_all_text_is_escaped_and_shown(page):
    assert "<script" not in page
    assert not [tag for tag, _ in Page(page).found if tag in ("script", "iframe", "object", "embed")]
    assert page.count("&lt;script&gt;") >= 12  # title twice, contents, headings, text, table, caption, details
    assert "name=&lt;a &amp; b&gt;" in page
    assert "$light" not in page


def test_nothing_is_asked_of_the_network(page):
    for _, attributes in Page(page).found:
        for name in ("src", "href", "xlink:href", "data", "action", "poster", "srcset"):
            assert (attributes.get(name) or "#").startswith(("#", "data:"))
    assert re.findall(r"url\((?!#)[^)]*\)|@import", page) == []
    assert "default-src 'none'" in page


def test_names_are_given_once_and_every_link_leads_somewhere(page):
    found = Page(page).found
    names = [attributes["id"] for _, attributes in found if "id" in attributes]
    assert len(names) == len(set(names))
    links = [href for _, attributes in found if (href := attributes.get("href") or "").startswith("#")]
    links += re.findall(r"url\((#[^)]*)\)", page)
    links += [f"#{name}" for _, attributes in found if (name := attributes.get("aria-labelledby"))]
    assert len(links) > 20
    assert {link[1:] for link in links} <= set(names)


def test_tables_have_headers_and_their_best_is_marked(page):
    found = Page(page).found
    scopes = [attributes.get("scope") for tag, attributes in found if tag == "th"]
    assert scopes == ["col"] * 3 + ["row"] * 3
    assert re.findall(r"<strong>([^<]*)</strong>", page) == ["0.250", "4.000"]
    assert '<tr class="reference"><th scope="row">expert</th>' in page
    assert "lower is better" in page
    assert "higher is better" in page


def test_figures_are_described_and_follow_the_colours_of_the_page(page, written):
    pictures = [attributes for tag, attributes in Page(page).found if tag == "svg"]
    assert [picture["class"] for picture in pictures] == ["wide", "narrow"] * 2
    assert [picture["aria-label"] for picture in pictures] == [EVIL, EVIL, "panels", "panels"]
    drawn = "".join(re.findall(r"<svg.*?</svg>", page, re.DOTALL))
    assert set(re.findall(r"#[0-9a-f]{6}\b", drawn)) == set()
    assert set(re.findall(r"var\((--\w+)\)", drawn)) <= set(re.findall(r"(--\w+):", page))
    assert "ModGNN-MLP" in drawn
    files = sorted(path.name for path in (written / "figures").iterdir())
    assert files == ["curves.png", "curves.svg", "panels.png", "panels.svg"]
    assert (written / "figures" / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert b"var(" not in (written / "figures" / "curves.svg").read_bytes()


def test_without_matplotlib_the_tables_are_written_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "can_draw", lambda: False)
    text = write_report(tmp_path, "t", [Section("s", "", [TABLE, Figure("f", curves)])], PROVENANCE).read_text()
    assert "pip install 'modgnn-rl[plots]'" in text
    assert "<table" in text
    assert "<svg" not in text
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert "[plots]" not in write_report(tmp_path, "t", [Section("s", "", [TABLE])], PROVENANCE).read_text()


def test_a_report_that_cannot_be_made_leaves_the_last_one(tmp_path):
    pytest.importorskip("matplotlib")
    before = write_report(tmp_path, "first", [], PROVENANCE).read_bytes()

    def broken(figure):
        raise RuntimeError("no such model")

    with pytest.raises(RuntimeError):
        write_report(tmp_path, "second", [Section("s", "", [Figure("f", broken)])], PROVENANCE)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [before]


def test_bad_names_and_folders_are_refused(tmp_path):
    def of(*names):
        return [Section("s", "", [Figure(name, curves) for name in names])]

    with pytest.raises(InputError, match="two figures are named 'a'"):
        write_report(tmp_path, "t", of("a", "b", "a"), PROVENANCE)
    with pytest.raises(InputError, match=r"'\.\./a' is not a valid file name"):
        write_report(tmp_path, "t", of("../a"), PROVENANCE)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose a folder you can write to"):
        write_report(tmp_path / "file", "t", [], PROVENANCE)


def test_a_model_looks_the_same_in_every_figure():
    one = styles_of(["modgnn_mlp", "gcn", "gcn_final"])
    other = styles_of(["GCN-final, K = 2", "ModGNN-MLP", "adjacency", "ModGNN-MLP, K = 2"])
    assert other["ModGNN-MLP"] == one["modgnn_mlp"]
    assert other["GCN-final, K = 2"] == one["gcn_final"] != one["gcn"]
    again = other["ModGNN-MLP, K = 2"]
    assert again.colour == one["modgnn_mlp"].colour
    assert again.line != one["modgnn_mlp"].line
    assert len({style.colour for style in styles_of([f"variant {n}" for n in range(8)]).values()}) == 8
    assert len(set(styles_of([f"variant {n}" for n in range(32)]).values())) == 32


def test_colours_stand_out_from_the_page():
    def luminance(colour):
        levels = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
        return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]

    def contrast(one, other):
        low, high = sorted((luminance(one), luminance(other)))
        return (high + 0.05) / (low + 0.05)

    for light, dark in figure._SERIES.items():
        assert min(contrast(light, figure.PAPER), contrast(dark, figure._DARK[figure.PAPER])) >= 3
    for ink in (figure.INK, figure.MUTED):
        assert min(contrast(ink, figure.PAPER), contrast(figure._DARK[ink], figure._DARK[figure.PAPER])) >= 4.5


def test_labels_are_kept_apart_in_order_and_inside():
    rng = np.random.default_rng(0)
    for count in range(9):
        heights = rng.uniform(0, 100, count)
        moved = np.array(_kept_apart(list(heights), 10.0, 100.0))
        assert (np.argsort(moved) == np.argsort(heights)).all()
        assert (np.diff(np.sort(moved)) > 10 - 1e-9).all()
        assert ((moved > -1e-9) & (moved < 100 + 1e-9)).all()
    assert _kept_apart([90.0, 10.0, 50.0], 10.0, 100.0) == [90.0, 10.0, 50.0]
    assert _kept_apart([50.0, 50.0], 10.0, 100.0) == [45.0, 55.0]


def test_curves_over_seeds():
    values = np.random.default_rng(0).normal(size=(5, 4))
    curve = Curve.over_seeds(range(4), values, rng=np.random.default_rng(1))
    assert np.allclose(curve.y, values.mean(0))
    assert ((curve.low < curve.y) & (curve.y < curve.high)).all()
    assert ((values.min(0) <= curve.low) & (curve.high <= values.max(0))).all()
    alone = Curve.over_seeds(range(4), values[:1], rng=np.random.default_rng(1))
    assert np.allclose(alone.low, values[0])
    values[2, 1] = np.nan
    assert np.isnan(Curve.over_seeds(range(4), values, rng=np.random.default_rng(1)).y).tolist() == [0, 1, 0, 0]


@pytest.mark.slow
def test_a_phone_need_not_scroll_sideways(tmp_path):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium here")
    wide = Table("wide", [f"column {n}" for n in range(20)], [["word " * 30, *["0.123 ± 0.456"] * 19]], "x" * 300)
    parts = [wide, Figure("curves", curves), Details("log", "y" * 1000)]
    page = write_report(tmp_path, "z" * 100, [Section("s", "w" * 300, parts)], PROVENANCE).read_text(encoding="utf-8")
    # Windows are never that narrow, frames are.
    (tmp_path / "phone.html").write_text(
        f"""<iframe width="390" height="844" srcdoc="{escape(page)}" onload="
        const root = document.querySelector('iframe').contentDocument.documentElement;
        const table = root.querySelector('.scroll');
        document.title = [root.scrollWidth, root.clientWidth, table.scrollWidth, table.clientWidth].join(' ')
        "></iframe>""",
        encoding="utf-8",
    )
    command = [chromium, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    options = ["--hide-scrollbars", "--dump-dom", (tmp_path / "phone.html").as_uri()]
    answer = subprocess.run([*command, *options], capture_output=True, text=True, timeout=120, check=True)
    found = re.search(r"<title>(\d+) (\d+) (\d+) (\d+)</title>", answer.stdout)
    assert found is not None
    content, screen, table, box = map(int, found.groups())
    assert content == screen == 390
    assert table > 3 * box
