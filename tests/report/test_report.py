"""Tables, figures and the page, from rows made here."""

import csv
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from fake_rows import BASELINE, GRID, failed_row, grid_rows, make_row, write_runs

from mtl_bench.core import config
from mtl_bench.report import grid as report
from mtl_bench.report import pictures, protocol, readme
from mtl_bench.report import table as formats
from mtl_bench.report.columns import OF_CONTROL, column, figures, headlines
from mtl_bench.report.footnotes import footnotes
from mtl_bench.report.grid import fill, tabulate
from mtl_bench.report.statistics import SMOKE


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A report with everything in it: two done lines, a stale one, a failed cell, a skipped one."""
    root = tmp_path_factory.mktemp("report")
    rows = [*grid_rows(), make_row("old_net", status="stale"), failed_row()]
    rows[-2]["error"] = "harness changed"
    runs = write_runs(root / "runs", rows[:-1])
    cell = config.Cell(config.Recipe(), "huge", "fixed")
    grid = SimpleNamespace(**{**vars(GRID), "skips": (SimpleNamespace(cell=cell, why="too big"),)})
    out = root / "reports" / "backbones"
    report.build(grid, rows, out, runs, BASELINE, "mtl-bench ablate --grid backbones")
    return SimpleNamespace(grid=grid, rows=rows, runs=runs, out=out)


def spelled(entry, column, seeds):
    """A number as Markdown has it."""
    return " ".join(filter(None, formats.halves(entry, column, seeds)))


# --- what is in the table -------------------------------------------------------------------------


def test_mean_and_sample_deviation_over_seeds():
    table = tabulate(grid_rows())
    assert [group.identity for group in table.groups] == [("resnet18",), ("tiny_one",)]
    pq = table.groups[0].entries["pq"]
    assert (pq.mean, pq.std, pq.count) == pytest.approx((37.0, 1.0, 3))
    assert spelled(pq, column("pq"), 3) == "37.0 \u00b1 1.0"


def test_one_seed_has_no_spread_and_nothing_is_bold():
    table = tabulate([make_row(metric={"panoptic.pq": 90.0}), *grid_rows()[3:]])
    pq = table.groups[0].entries["pq"]
    assert spelled(pq, column("pq"), 1) == "90.0"
    assert not any(e.bold for g in table.groups for e in g.entries.values())
    assert any(note.startswith("n = 1:") for note in footnotes(table))


@pytest.mark.parametrize(
    ("first", "second", "bold"),
    [
        ((36, 37, 38), (30, 31, 32), (True, False)),
        ((36, 37, 38), (35.5, 36.5, 37.5), (False, False)),  # ahead by half a spread
        ((36, 37, 38), (30, 35.5, 41), (False, False)),  # the other's spread is the wide one
        ((30, 31, 32), (36, 37, 38), (False, True)),
        ((9, 10, 11), (4, 5, 6), (False, False)),  # behind the trivial predictor's 12
    ],
)
def test_bold_leads_by_more_than_the_spread(first, second, bold):
    rows = [
        make_row(name, seed, metric={"panoptic.pq": float(pq)})
        for name, several in (("a", first), ("b", second))
        for seed, pq in enumerate(several)
    ]
    table = tabulate(rows, baseline={"metric": BASELINE})
    assert tuple(group.entries["pq"].bold for group in table.groups) == bold


def test_lower_is_better_where_it_is():
    rows = [
        make_row(name, seed, metric={"depth_median.rmse": rmse + seed / 10})
        for name, rmse in (("a", 8.0), ("b", 9.0))
        for seed in range(2)
    ]
    first, second = tabulate(rows).groups
    assert (first.entries["rmse"].bold, second.entries["rmse"].bold) == (True, False)


def test_stale_rows_have_a_line_of_their_own_and_do_not_lead():
    rows = grid_rows()
    rows[0] = {**rows[0], "status": "stale", "error": "harness changed"}
    stale, fresh, _ = tabulate(rows).groups
    assert (stale.identity, stale.mark, stale.rows) == (("resnet18",), "stale", (rows[0],))
    assert fresh.entries["pq"].mean == pytest.approx(37.5)
    assert not any(e.bold for e in stale.entries.values())
    assert any("harness changed" in note for note in footnotes(tabulate(rows)))


def test_whatever_differs_becomes_a_column():
    rows = [make_row(method="fixed"), make_row(method="other")]
    assert tabulate(rows).axes == ("backbone", "method")
    rows = [make_row(method_args={"alpha": 0.5}), make_row(method_args={"alpha": 1.5})]
    table = tabulate(rows)
    assert table.axes == ("backbone", "method_args.alpha")
    assert [group.identity for group in table.groups] == [("resnet18", "0.5"), ("resnet18", "1.5")]


def test_a_value_that_some_seeds_lack_says_its_n():
    rows = [make_row(seed=seed) for seed in range(3)]
    del rows[1]["metric"]["depth_dgc.rmse"]
    table = tabulate(rows)
    assert spelled(table.groups[0].entries["rmse_dgc"], column("rmse_dgc"), 3) == ("9.50 (n=2)")
    assert any("its own n" in note for note in footnotes(table))


def test_a_single_task_row_has_dashes():
    rows = [make_row("a"), make_row("b", tasks=("depth",))]
    del rows[1]["metric"]["panoptic.pq"]
    table = tabulate(rows)
    assert table.axes == ("backbone", "tasks")
    assert "| b | depth | 1 | - |" in formats.markdown(fill(table))


# --- files ----------------------------------------------------------------------------------------


def test_published_rows_are_marked_and_apart(built):
    with (built.out / "table.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    kinds = {line["backbone"]: (line["kind"], line["mark"]) for line in lines}
    assert kinds["resnet18"] == ("measured", "")
    assert kinds["old_net"] == ("measured", "stale")
    assert kinds["trivial predictor"][0] == "trivial"
    assert kinds["ResNet18"] == ("published", "published (Cityscapes, 2080 Ti)")
    published = next(line for line in lines if line["backbone"] == "ResNet18")
    assert (published["pq"], published["fps"], published["rmse"]) == ("53.3", "30", "")
    measured, _, rest = (built.out / "table.md").read_text().partition("**published (Cityscapes")
    assert "| ResNet18 | 53.3 | 8.8 | 30.0 |" in rest
    assert "53.3" not in measured
    assert "| trivial predictor | - | 12.0 |" in measured


def test_failed_and_skipped_cells_are_shown_with_their_reason(built):
    markdown = (built.out / "table.md").read_text()
    assert (
        "| tiny_one, seed 9 | failed | ValueError: loss 'center' is nan_at 50 % & more |"
        in markdown
    )
    assert "| huge, seed 0 | skipped | too big |" in markdown
    html = (built.out / "index.html").read_text()
    assert "nan_at 50 % &amp; more" in html
    assert "6 done, 1 stale, 1 failed, 1 skipped" in html


def test_smoke_is_marked_everywhere(tmp_path):
    report.build(GRID, grid_rows(smoke=True), tmp_path)
    for name in ("table.md", "table.tex", "index.html"):
        assert SMOKE in (tmp_path / name).read_text().lower()
    lines = list(csv.DictReader(io.StringIO((tmp_path / "table.csv").read_text())))
    assert all(line["mark"] == SMOKE for line in lines if line["kind"] == "measured")
    table = tabulate(grid_rows(smoke=True))
    assert not any(e.bold for g in table.groups for e in g.entries.values())


def test_latex_escapes_and_compiles(built, tmp_path):
    source = (built.out / "table.tex").read_text(encoding="ascii")
    assert r"tiny\_one" in source
    assert r"\textbf{37.0}{\scriptsize\,$\pm$ 1.0}" in source
    assert formats.tex(r"a_b & 5% \ {x} ~ ^ #1 $") == (
        r"a\_b \& 5\% \textbackslash{} \{x\} \textasciitilde{} \textasciicircum{} \#1 \$"
    )
    if shutil.which("pdflatex"):
        shutil.copy(built.out / "table.tex", tmp_path)
        (tmp_path / "paper.tex").write_text(
            "\\documentclass{article}\\usepackage{booktabs,graphicx}"
            "\\begin{document}\\input{table}\\end{document}"
        )
        words = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-2000:]


def test_the_same_rows_give_the_same_bytes(built, tmp_path):
    report.build(
        built.grid, built.rows, tmp_path, built.runs, BASELINE, "mtl-bench ablate --grid backbones"
    )
    first = {path.name: path.read_bytes() for path in built.out.iterdir()}
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == first


def test_all_files_are_there_and_small(built):
    others = [c.name for c in headlines() if c.task not in config.Recipe.tasks]
    own = [stem for stem in figures() if not any(name in stem for name in others)]
    own = [stem for stem in own if stem not in OF_CONTROL]
    drawn = {f"{stem}.{kind}" for stem in own for kind in ("png", "svg")}
    expected = {"index.html", "table.csv", "table.md", "readme.md", "table.tex", *drawn}
    expected -= {"samples.svg", "extremes.svg", "rmse_classes.svg", "rmse_classes.png"}
    assert {path.name for path in built.out.iterdir()} == expected
    assert sum(path.stat().st_size for path in built.out.iterdir()) < 6e5
    for path in built.out.glob("*.png"):
        assert cv2.imread(str(path)).std() > 5


def test_figures_that_no_longer_apply_are_removed(tmp_path):
    rows = grid_rows()
    report.build(GRID, rows, tmp_path / "out", write_runs(tmp_path / "learned", rows))
    assert (tmp_path / "out/weight_curves.svg").is_file()
    constant = write_runs(tmp_path / "constant", rows, learned=False)
    html = report.build(GRID, rows, tmp_path / "out", constant).read_text()
    assert not (tmp_path / "out/weight_curves.svg").exists()
    assert "Learned weights" not in html
    assert "Training curves" in html


def test_no_rows_still_make_a_page(tmp_path):
    row = {"slug": "x", "backbone": "a", "method": "m", "seed": 0, "status": "missing"}
    html = report.build(GRID, [row], tmp_path).read_text()
    assert "No cell of this grid has numbers yet." in html
    assert "1 missing" in html


# --- the page -------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Checks nesting, and collects ids and everything that a browser would load."""

    VOID = ("meta", "link", "img", "br", "input")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.loaded: list[str] = []
        self.targets: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if tag not in self.VOID:
            self.open.append(tag)
        if "id" in values:
            self.ids.append(values["id"])
        for name in ("src", "srcset", "href", "xlink:href"):
            if name in values:
                (self.targets if tag == "a" else self.loaded).append(values[name])

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_page_is_one_sound_file_that_loads_nothing(built):
    text = (built.out / "index.html").read_text()
    page = Page(text)
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert all(target.startswith(("data:", "#")) for target in page.loaded)
    assert all((built.out / target).is_file() for target in page.targets)
    assert not re.search(r"@import|url\((?!#)|fetch\(|XMLHttpRequest", text)
    inside = {target[1:] for target in page.loaded if target.startswith("#")}
    inside |= set(re.findall(r"url\(#([^)]+)\)", text))
    assert inside
    assert inside <= set(page.ids)
    assert len(text) < 3e6


def test_page_says_how_the_numbers_were_made(built):
    text = (built.out / "index.html").read_text()
    assert "Which backbone &amp; why?" in text
    assert "mtl-bench ablate --grid backbones" in text
    for words in ("depth_range_m", "0.001, 80", "center_threshold", "strides", "A CPU"):
        assert words in text
    sections = dict(
        protocol.of_cells([row for group in tabulate(built.rows).groups for row in group.rows])
    )
    assert ("seed", "0 | 1 | 2", True) in sections["Cells"]
    assert ("split", "val", False) in sections["Evaluation"]
    assert ("strides", "8, 16, 32", False) in sections["Network"]


def test_scaling_failures_are_counted(built):
    section = report.counted_images(tabulate(built.rows))
    counted = {line.cells[0].text: [cell.text for cell in line.cells[1:]] for line in section.lines}
    assert counted["resnet18"] == ["3", "6"]  # 1 and 2 in each of three seeds


# --- pictures -------------------------------------------------------------------------------------


def test_samples_without_a_task(tmp_path):
    rows = [make_row("a")]
    folder = tmp_path / rows[0]["slug"]
    folder.mkdir()
    depth = np.ones((1, 8, 16), np.float16)
    image = np.zeros((1, 8, 16, 3), np.uint8)
    np.savez(folder / "samples.npz", names=["x"], image=image, depth_m=depth, true_depth_m=depth)
    assert pictures.draw(tabulate(rows), tmp_path, tmp_path)
    height = cv2.imread(str(tmp_path / "samples.png")).shape[0]
    assert height < 2 * 96 + 26  # one line, not two


def test_worst_and_best_frames_with_their_quality(tmp_path):
    rows = [make_row("a"), make_row("b")]
    runs = write_runs(tmp_path / "runs", rows)
    former = runs / rows[0]["slug"] / "samples.npz"
    values = {k: v for k, v in np.load(former).items() if not k.startswith("extremes")}
    np.savez(former, **values)
    caption = pictures.extremes(tabulate(rows), runs, tmp_path)
    assert caption.endswith("of the frame alone: b 12.3 and 87.7.")
    picture = cv2.imread(str(tmp_path / "extremes.png"))
    assert picture.shape == (26 + 20 + 96 + 4, 6 * 196, 3)
    truth, predicted = picture[46:-4, 196:388], picture[46:-4, 392:584]
    assert not np.array_equal(truth, predicted)
    assert pictures.extremes(tabulate(rows[:1]), runs, tmp_path) is None
    assert pictures.draw(tabulate(rows), runs, tmp_path).startswith("Input, ground truth")


# --- README ---------------------------------------------------------------------------


def test_readme_takes_the_table_between_its_markers(built, tmp_path):
    path = tmp_path / "README.md"
    reports = tmp_path / "reports" / "backbones"
    shutil.copytree(built.out, reports)
    path.write_text("# A\n<!-- results:backbones -->\nformer table\n<!-- /results -->\nafter\n")
    assert readme.update(path, "backbones", reports)
    text = path.read_text()
    assert (reports / "readme.md").read_text().strip() in text
    assert "(reports/backbones/pq_fps.png)" in text
    assert text.startswith("# A\n")
    assert text.endswith("<!-- /results -->\nafter\n")
    assert "former table" not in text
    assert not readme.update(path, "backbones", reports)
    with pytest.raises(ValueError, match="results:methods"):
        readme.update(path, "methods", reports)
    with pytest.raises(ValueError, match="mtl-bench report"):
        readme.update(path, "backbones", tmp_path / "nowhere")


def test_rows_are_read_back_from_json_as_they_were(tmp_path):
    rows = json.loads(json.dumps(grid_rows()))
    report.build(GRID, rows, tmp_path / "a")
    report.build(GRID, grid_rows(), tmp_path / "b")
    assert (tmp_path / "a/index.html").read_bytes() == (tmp_path / "b/index.html").read_bytes()
