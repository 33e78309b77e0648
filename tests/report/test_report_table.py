"""One table in its spellings: what is escaped, marked, bold, missing or on the page alone."""

import math

from mtl_bench.core.columns import Column
from mtl_bench.report import table
from mtl_bench.report.page import Page, render
from mtl_bench.report.statistics import Entry
from mtl_bench.report.table import Cell, Head, Section, Table, TableRow

SPEED = Column("speed", "speed", "speed", +1, 1, "m/s", "in a wind")
ERROR = Column("error", "error", "error", -1, 0, scientific=True)
NOTHING = Column("passes", "passes", "passes", 0, 0)
HEADS = (*Head.words("name"), *map(Head.of, (SPEED, ERROR)), Head("folder", page_only=True))
ROW = TableRow.of(
    Cell.marked("a|b*", "stale"),
    Cell.of(Entry(3.14, 0.25, 2, bold=True), SPEED, 3),
    Cell.of(Entry(3e-7, count=1), ERROR),
    "here",
    css="stale",
)
SECTION = Section("First", HEADS, (ROW,), caption="A_caption.")


def test_markdown():
    text = table.markdown(Table((SECTION,), ("3 +- 1 *",), banner="Careful."))
    assert text == (
        "**Careful.**\n\n**First**\n\n"
        "| name | speed\u00a0\u2191<br>m/s, in a wind | error\u00a0\u2193 |\n"
        "| --- | ---: | ---: |\n"
        r"| a\|b\* (stale) | **3.1 " + "\u00b1 0.2 (n=2)** | 3e-07 |\n\n"
        "- 3 \u00b1 1 " + r"\*" + "\n"
    )


def test_latex_of_one_float_has_the_headings_in_it_and_the_notes_below():
    both = Table((SECTION, SECTION), ("100 %",), title="T", joined=True, letters={"a": "so_so"})
    text = table.latex(both)
    assert text.count(r"\begin{table}") == 1
    assert text.count(r"\emph{First}") == 2
    assert r"\scriptsize $^{a}$ so\_so. 100 \%" in text
    assert r"\textbf{3.1}{\scriptsize\,$\pm$ 0.2 (n=2)}" in text
    apart = table.latex(Table((SECTION, SECTION), ()))
    assert apart.count(r"\caption{A\_caption.}") == 2


def test_page(tmp_path):
    text = render(Page("grid", "T", "T", "x < y", ""), Table((SECTION,), ()), tmp_path)
    assert 'a|b* <span class="mark">stale</span></th>' in text
    assert (
        '<td data-value="3.14"><b>3.1</b> <span class="spread">\u00b1 0.2 (n=2)</span></td>' in text
    )
    assert "<td>here</td>" in text
    assert "x &lt; y" in text


def test_numbers():
    assert Head.of(NOTHING).title == "passes"
    assert table.number(math.nan, SPEED) == "-"
    assert table.number(0.0, ERROR) == "0"
    assert table.number(-0.04, SPEED) == "0.0"
    assert table.halves(Entry(2.0, 0.0, 3), SPEED, 3) == ("2.0", "")
