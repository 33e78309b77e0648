"""Every published number is the paper's, digit by digit, and has a source."""

import re
import tomllib
from decimal import Decimal

import pytest
from conftest import SHARED

from mtl_bench.core.columns import FPS
from mtl_bench.report import literature as published
from mtl_bench.report.columns import headlines
from mtl_bench.report.grid import PUBLISHED

PAPER = SHARED / "paper/mgnet.tex"
TABLES = [name for name in published.names() if published.load(name).label]  # the paper's own
LISTS = [
    entry
    for entry in tomllib.loads(PUBLISHED.read_text(), parse_float=Decimal)["published"]
    if "label" in entry
]
needs_paper = pytest.mark.skipif(not PAPER.is_file(), reason="no paper")


def printed(label: str) -> list[list[str]]:
    """The cells of one of the paper's tables, row by row, without LaTeX."""
    source = PAPER.read_text(encoding="utf-8")
    tables = re.findall(r"\\begin\{table\*?\}.*?\\end\{table\*?\}", source, re.DOTALL)
    (table,) = [table for table in tables if f"\\label{{{label}}}" in table]
    body = table[table.index(r"\hline\hline") : table.index(r"\end{tabular}")]
    return [
        [plain(cell) for cell in line.removesuffix(r"\\").split(" & ")]
        for line in map(str.strip, body.splitlines())
        if " & " in line
    ]


def plain(cell: str) -> str:
    for pattern, new in (
        (r"~?\\cite\{[^}]*\}", ""),
        (r"\\textbf\{([^}]*)\}", r"\1"),
        (r"~\\etal", " et al."),
        (r"\\times", "x"),
        (r"\\dag", "\u2020"),
        (r"\$", ""),
    ):
        cell = re.sub(pattern, new, cell)
    return cell.replace("\\", "").strip()


def cited(label: str) -> list[str]:
    """The bibliography's text of what each row cites, in the rows' order; empty where nothing."""
    source = PAPER.read_text(encoding="utf-8")
    entries = dict(
        re.findall(r"\\bibitem\{(\w+)\}(.*?)(?=\\bibitem|\\end\{the)", source, re.DOTALL)
    )
    table = source[: source.index(f"\\label{{{label}}}")].rpartition(r"\hline\hline")[2]
    lines = [line for line in table.splitlines() if " & " in line]
    keys = [re.search(r"\\cite\{([^}]*)\}", line) for line in lines]
    return [re.sub(r"[\s{}~]+", " ", entries[key[1]]) if key else "" for key in keys]


@needs_paper
@pytest.mark.parametrize("name", TABLES)
def test_every_cell_is_as_the_paper_prints_it(name):
    literature = published.load(name)
    names = [n for n in literature.columns if n not in ("protocol", "frames")]
    names = [n for n in names if n not in (("fps", "device") if name == "kitti" else ())]
    if name == "cityscapes":
        assert names == ["method", "backbone", "input", "pq", "device", "runtime_ms"]
    found = [
        [str(row.get("printed_as", row["method"])) + row.get("symbols", "")]
        + [str(row.get(n, "-")) for n in names[1:]]
        for row in literature.row
    ]
    assert found == printed(literature.label)


@needs_paper
@pytest.mark.parametrize("entry", LISTS, ids=lambda entry: entry["label"])
def test_every_number_of_a_list_is_the_papers(entry):
    metrics = [c.name for c in (*headlines(), FPS) if c.name in entry["rows"][0]]
    found = [[row["name"], *(str(row[name]) for name in metrics)] for row in entry["rows"]]
    assert found == printed(entry["label"])


@needs_paper
def test_all_four_tables_are_there():
    labels = re.findall(r"\\label\{(tab:\w+)\}", PAPER.read_text(encoding="utf-8"))
    ours = [published.load(name).label for name in TABLES] + [entry["label"] for entry in LISTS]
    assert sorted(labels) == sorted(ours)
    assert len(labels) == 4


@needs_paper
@pytest.mark.parametrize("name", TABLES)
def test_a_source_is_what_the_paper_cites(name):
    """The authors' family names in their order, the start of the title and the year."""
    literature = published.load(name)
    for row, entry in zip(literature.row, cited(literature.label), strict=True):
        year = row["source"].rpartition(" ")[2]
        assert row["details"].endswith(year)
        if entry:
            authors, title = row["source"].split(": ", 1)
            names = [name.split()[-1] for name in authors.split(", ")]
            assert re.search(".*".join(map(re.escape, names)), entry), names
            assert title.split(",")[0].lower() in entry.lower()
            assert year in entry


@needs_paper
def test_speeds_beside_the_kitti_table_stand_in_the_text():
    text = PAPER.read_text(encoding="utf-8")
    speeds = {row["method"]: row["fps"] for row in published.load("kitti").row if "fps" in row}
    assert speeds == {"PackNet-SfM": Decimal("6.25"), "MGNet": 82}
    assert "reaching only 6.25~FPS on full resolution $1280\\times384$" in text
    assert "our method reaches 82~FPS on full resolution" in text
    assert "state an optimized runtime of 30~FPS" in text


# --- without the paper ----------------------------------------------------------------------------


def test_numbers_keep_the_digits_that_they_are_printed_with():
    runtimes = [str(row.get("runtime_ms", "-")) for row in published.load("cityscapes").row]
    assert " ".join(runtimes) == "396.5 - - 175 166 - 114 99 82 63.05 63 44.4"
    assert str(published.load("kitti").row[2]["rmse"]) == "5.240"


@pytest.mark.parametrize("name", TABLES)
def test_every_row_has_a_source_and_known_keys(name):
    literature = published.load(name)
    known = {*published.TEXTS, *literature.numbers}
    assert {*literature.columns} <= known
    known |= {"details", "source", "symbols", "note", "printed_as"}
    assert {*literature.narrow} <= {*literature.columns}
    assert literature.sort in literature.columns
    for row in literature.row:
        assert set(row) <= known
        assert re.search(r"\w+.*: .+ 20\d\d$", row["source"])
        assert set(row.get("symbols", "")) <= set(literature.symbols)


def test_mixed_protocols_are_said():
    notes = " ".join(published.compare(published.load("kitti"), []).notes)
    assert "Published rows mix protocols." in notes
    assert "GeoNet: delta1 is as printed" in notes
    notes = " ".join(published.compare(published.load("cityscapes"), []).notes)
    assert "the runtime that of the panoptic part alone" in notes


def test_an_unknown_table_is_told():
    with pytest.raises(ValueError, match=r"no table called 'kity' \(did you mean 'kitti'\?\)"):
        published.load("kity")
