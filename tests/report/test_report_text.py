"""Names and messages as anybody may write them: line breaks, HTML, letters, signs of LaTeX."""

import warnings

import pytest
from fake_rows import GRID, failed_row, grid_rows, make_row

from mtl_bench.core import cards
from mtl_bench.core.plugins import Description
from mtl_bench.core.style import save, styled
from mtl_bench.report import grid as report
from mtl_bench.report import table

HOSTILE = "<img src=x onerror=alert(1)>\n\n# Cr\u00e8me | `a` $\\foo$ *b* \x1b[31m &lt; \u8f66"


def named_rows():
    """Done rows of a hostile name, of one that differs in n, and a cell that failed."""
    rows = [*grid_rows(), make_row("fewer", 0), make_row("fewer", 1), failed_row()]
    for row in rows[:3]:
        row["cell"] |= {"name": HOSTILE}
    for row in rows[3:]:
        row["cell"] |= {"name": row["backbone"]}
    return rows


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    root = tmp_path_factory.mktemp("text")
    rows = named_rows()
    grid = type(GRID)(**{**vars(GRID), "report": {"rows": "name"}})
    report.build(grid, rows, root / "out")
    return root / "out"


def test_markdown_has_no_html_and_no_markup_of_a_name(built):
    for name in ("table.md", "readme.md"):
        text = (built / name).read_text(encoding="utf-8")
        assert "<img" not in text
        line = next(line for line in text.splitlines() if "onerror" in line)
        assert line.startswith(
            "| &lt;img src=x onerror=alert(1)> # Cr\u00e8me \\| \\`a\\` \\$\\\\foo\\$ \\*b\\* "
        )
        assert "\x1b" not in text
        columns = {line.replace("\\|", "").count("|") for line in text.splitlines() if "|" in line}
        assert len(columns) <= 4  # one count a table


def test_page_has_no_html_of_a_name(built):
    text = (built / "index.html").read_text(encoding="utf-8")
    assert "<img src=x" not in text
    assert "&lt;img src=x onerror=alert(1)&gt; # Cr" in text
    assert "\x1b" not in text


def test_latex_keeps_letters_and_lines(built):
    text = (built / "table.tex").read_text(encoding="utf-8")
    assert "Cr\u00e8me" in text
    assert "\u8f66" in text
    assert "?" not in text
    line = next(line for line in text.splitlines() if "onerror" in line)
    assert line.endswith(r"\\")
    assert table.tex("a\nb --rerun") == "a b -{}-rerun"


def test_latex_lists_what_has_no_numbers(built):
    text = (built / "table.tex").read_text(encoding="utf-8")
    assert r"\caption{Cells without numbers.}" in text
    line = r"tiny\_one, seed 9 & failed & ValueError: loss 'center' is nan\_at 50 \% \& more \\"
    assert line in text  # without the folder, which is the page's own


@pytest.mark.parametrize("name", ["table.md", "table.tex", "readme.md", "index.html"])
def test_fewer_seeds_are_marked(built, name):
    text = (built / name).read_text(encoding="utf-8")
    assert ("2\u2020" if name != "table.tex" else r"2$\dagger$") in text
    assert "Fewer seeds than another line" in text


def test_equal_seeds_have_no_mark():
    assert "\u2020" not in table.markdown(report.fill(report.tabulate(grid_rows())))


def test_a_failed_report_leaves_the_old_one(tmp_path, monkeypatch):
    grid = type(GRID)(**{**vars(GRID), "report": {"only": "cost"}})  # which has no figures
    report.build(grid, grid_rows(), tmp_path)
    (tmp_path / "pq_fps.png").write_bytes(b"drawn before")
    (tmp_path / "mine.txt").write_text("kept")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(report, "render", full)
        with pytest.raises(OSError, match="No space"):
            report.build(grid, grid_rows()[:3], tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    report.build(grid, grid_rows()[:3], tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*before} - {"pq_fps.png"}


def test_missing_letters_are_told_in_one_line(tmp_path, capsys):
    from matplotlib.figure import Figure

    for name in ("first", "second"):
        with styled():
            figure = Figure(layout="constrained")
            figure.add_subplot().set_title("\u7b2c\u4e00 $\\foo$")
            save(figure, tmp_path, name)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["PNG files show boxes for letters that DejaVu Sans lacks: \u4e00 \u7b2c"]
    assert "\\foo" in (tmp_path / "first.svg").read_text(encoding="utf-8")


def test_other_warnings_of_figures_are_not_lost():
    with pytest.warns(UserWarning, match="something else"), styled():
        warnings.warn("something else", stacklevel=1)


def test_a_methods_docstring_is_no_markup(tmp_path):
    (tmp_path / "wild.py").write_text(
        '"""A <script>alert(1)</script> | *b*.\n\nSource: none.\n"""\n'
        "from mtl_bench.core.method import LossMethod\n\n\n"
        "class Wild(LossMethod):\n"
        '    """L\n\n    ```\n    <script>\n    """\n\n'
        '    def __init__(self, terms, *, mark="`<b>`"):\n        pass\n'
    )
    doc = "A <script>alert(1)</script> | *b*."
    about = Description("wild", doc, tmp_path / "wild.py", None, doc)
    card = cards._card(about)
    text = cards.page([card], tmp_path)
    row = next(line for line in text.splitlines() if line.startswith("| [wild]"))
    assert "A &lt;script>alert(1)&lt;/script> \\| \\*b\\*." in row
    fence = next(line for line in text.splitlines() if line.endswith("text"))
    assert fence == "````text"
    assert "``mark='`<b>`'``" in text
