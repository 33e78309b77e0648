"""The report of a grid of latencies: its numbers, its marks, its figures, its front."""

import csv
import io
import shutil
import subprocess
from types import SimpleNamespace

import cv2
import fake_latency
import fake_rows
import numpy as np
import pytest
from matplotlib.figure import Figure

from mtl_bench.core import style
from mtl_bench.core.recipe import Recipe
from mtl_bench.report import latency, latency_plots, plots, readme
from mtl_bench.report import table as formats
from mtl_bench.report.columns import headlines
from mtl_bench.report.latency import notes, tabulate, without_numbers

GRID = SimpleNamespace(
    name="latency",
    question="How fast & how good?",
    recipe="paper",
    skips=[SimpleNamespace(why="plain has no bf16 on cpu")] * 3,
)
COMMAND = "mtl-bench ablate --grid latency --set passes=50"


def quality_rows():
    """Two seeds of each backbone, trained at 64x128."""
    trained = {"resnet18": (36.0, 8.3), "tiny_one": (31.0, 8.0)}
    rows = []
    for backbone, (pq, rmse) in trained.items():
        for seed in range(2):
            metric = {"panoptic.pq": pq + seed, "depth_median.rmse": rmse}
            row = fake_rows.make_row(backbone, seed, metric=metric)
            rows.append({**row, "tasks": row["cell"]["tasks"]})
    return rows


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    page = latency.build(GRID, fake_latency.grid_rows(), out, quality_rows(), COMMAND)
    text = {path.name: path.read_text() for path in out.iterdir() if path.suffix != ".png"}
    return SimpleNamespace(out=out, html=page.read_text(), text=text)


def by_label(rows, quality=()):
    return {line.label: line for line in tabulate(rows, quality).lines}


# --- numbers --------------------------------------------------------------------------------------


def test_speed_up_is_over_plain_of_the_same_network_tasks_and_size():
    rows = [
        fake_latency.make_row("plain", mean_ms=100.0),
        fake_latency.make_row("eager", mean_ms=80.0),
        fake_latency.make_row("openvino", precision="bf16", mean_ms=25.0),
        fake_latency.make_row("plain", tasks=("panoptic",), mean_ms=60.0),
        fake_latency.make_row("eager", tasks=("panoptic",), mean_ms=30.0),
        fake_latency.make_row("eager", size="64x128", mean_ms=1.0),
        fake_latency.make_row("eager", passes=50, mean_ms=50.0),
    ]
    found = [line.values["speedup"] for line in tabulate(rows).lines]
    assert found[:5] == pytest.approx([1, 1.25, 4, 1, 2])
    assert np.isnan(found[5:]).all()  # no plain at that size, or of as many passes


def test_without_a_plain_line_there_is_no_speed_up_column():
    table = tabulate([fake_latency.make_row("eager")])
    assert "speedup" not in [column.name for column in table.columns()]
    assert not any("Speed-up" in note for note in notes(table))


def test_the_table_says_what_was_measured(built):
    lines = list(csv.DictReader(io.StringIO(built.text["table.csv"])))
    line = next(li for li in lines if (li["engine"], li["size"]) == ("openvino", "1024x2048"))
    expected = {
        "backbone": "resnet18",
        "tasks": "panoptic, depth",
        "precision": "fp32",
        "status": "done",
        "mean_ms": "800",
        "p50_ms": "792",
        "p95_ms": "840",
        "p99_ms": "960",
        "fps": "1.25",
        "speedup": "2.5",
        "transfer_ms": "8",
        "network_ms": "744",
        "postprocess_ms": "48",
        "throughput_fps": "1.375",
        "throughput_batch": "4",
        "panoptic_equal": "99.975",
        "depth_rel": "3e-07",
        "logits_max": "2e-05",
        "passes": "500",
        "weights": "random",
        "noisy": "False",
        "threads": "2",
    }
    assert {key: line[key].removesuffix(".0") for key in expected} == expected
    assert float(line["roofline"]) == pytest.approx(100 * 160 / 0.744 / 300, abs=0.01)


def test_markdown_page_and_tex_have_a_table_for_each_size(built):
    row = "| resnet18 | panoptic, depth | openvino | fp32 | 800.0 | 792.0 | 840.0 | 960.0 | 1.25 |"
    assert row in built.text["table.md"]
    assert "| 99.975 | 3e-07 | 2e-05 | 72 | 500 |" in built.text["table.md"]
    assert built.text["table.md"].index("**384x1280**") < built.text["table.md"].index(row)
    assert built.html.count('<table class="results">') == 2
    assert built.text["table.tex"].count(r"\begin{tabular}") == 4  # what has no numbers is one
    assert "How fast &amp; how good?" in built.html
    assert COMMAND in built.html
    assert "3 timings left out: plain has no bf16 on cpu." in built.html


def test_readme_has_the_largest_size_and_all_tasks_only(built, tmp_path):
    text = built.text["readme.md"]
    assert text.startswith("1024x2048, panoptic, depth, batch 1; plain and the fastest engine")
    assert "| resnet18 | panoptic |" not in text
    assert "- Unavailable: tensorrt (tensorrt is not installed: pip install" in text
    path = tmp_path / "README.md"
    path.write_text("<!-- results:latency -->\n<!-- /results -->\n")
    assert readme.update(path, "latency", built.out)
    assert "pq_fps.png" in path.read_text()
    assert "rmse_fps.png" in path.read_text()


def test_readme_has_plain_and_the_fastest_engine_of_each_precision():
    rows = [
        fake_latency.make_row(engine, precision=precision, backbone=backbone, mean_ms=ms)
        for backbone in ("resnet18", "tiny_one")
        for engine, precision, ms in (
            ("plain", "fp32", 100.0),
            ("eager", "fp32", 80.0),
            ("openvino", "fp32", 60.0 if backbone == "tiny_one" else 90.0),
            ("eager", "bf16", 30.0),
            ("openvino", "bf16", 25.0),
        )
    ]
    lines = formats.markdown(latency.readme(tabulate(rows))).splitlines()
    shown = [line.split(" | ") for line in lines if line.startswith(("| resnet18", "| tiny_one"))]
    assert [(line[2], line[3]) for line in shown] == [
        *(("plain", "fp32"), ("eager", "fp32"), ("openvino", "bf16")),
        *(("plain", "fp32"), ("openvino", "fp32"), ("openvino", "bf16")),
    ]


def test_readme_names_what_is_wrong_in_one_sentence():
    wrong = [
        fake_latency.make_row(engine, precision=precision, status="wrong", why=f"by {engine}")
        for engine, precision in (("eager", "bf16"), ("openvino", "fp16"))
    ]
    rows = [fake_latency.make_row("plain"), *wrong]
    rows += [fake_latency.make_row("eager", size="64x128", status="wrong", why="elsewhere")]
    text = formats.markdown(latency.readme(tabulate(rows)))
    assert text.count("Wrong") == 1
    assert "- Wrong: resnet18 eager bf16, resnet18 openvino fp16 (not timed, as" in text


# --- what has no numbers --------------------------------------------------------------------------


def test_an_unavailable_engine_is_marked_with_how_to_install_it(built):
    assert "tensorrt (unavailable) | fp32 | - |" in built.text["table.md"]
    assert (
        "| unavailable | tensorrt | 8 timings | tensorrt is not installed: pip install"
        in (built.text["table.md"])
    )
    assert fake_latency.INSTALL in built.html
    assert 'tensorrt <span class="mark">unavailable</span>' in built.html


def test_failed_wrong_and_missing_lines_say_why():
    found = {status: (which, why) for status, engine, which, why in without_numbers(
        tabulate(fake_latency.grid_rows())) if engine == "compile"}  # fmt: skip
    assert found == {
        "wrong": (
            "resnet18 panoptic, depth compile fp32 384x1280",
            "equal panoptic pixels 0.91 < 0.999",
        ),
        "failed": (
            "resnet18 panoptic, depth compile fp32 1024x2048",
            "killed by SIGKILL (out of memory?)",
        ),
        "not run": (
            "resnet18 panoptic, depth compile bf16 1024x2048",
            "mtl-bench ablate takes it",
        ),
    }


def test_a_wrong_line_shows_how_wrong_and_no_time_even_if_it_has_one():
    row = {**fake_latency.make_row("eager"), "status": "wrong"}
    (line,) = tabulate([fake_latency.make_row("plain"), row]).lines[1:]
    numbers = {name for name, value in line.values.items() if not np.isnan(value)}
    assert numbers == {"panoptic_equal", "depth_rel", "logits_max"}
    assert line.mark == "wrong"


def test_marks():
    rows = [
        fake_latency.make_row("plain", metric={"latency.noisy": True}),
        fake_latency.make_row("eager", status="stale", why="harness changed"),
        fake_latency.make_row("openvino", smoke=True),
        fake_latency.make_row("compile"),
    ]
    table = tabulate(rows)
    marks = [line.mark for line in table.lines]
    assert marks == ["noisy", "stale", "smoke: not a result", ""]
    text = " ".join(notes(table))
    for words in ("Noisy:", "Stale: code changed after the time was taken (harness changed)"):
        assert words in text
    assert "Smoke:" in text


def test_notes_are_said_where_they_apply_only():
    text = " ".join(notes(tabulate([fake_latency.make_row("plain", weights="trained")])))
    for words in ("Noisy", "Stale", "Smoke", "Random", "Several devices", "passes, where"):
        assert words not in text
    assert "Measured on A CPU, 2 threads" in text
    few = [fake_latency.make_row("plain", passes=50)]
    assert "As few as 50 passes, where the paper has 500" in " ".join(notes(tabulate(few)))
    other = fake_latency.make_row("eager", metric={"latency.device": "A GPU"})
    several = [fake_latency.make_row("plain"), other]
    assert "Several devices" in " ".join(notes(tabulate(several)))


def test_a_report_without_any_number_is_written(tmp_path):
    rows = [fake_latency.make_row("plain", status="missing")]
    page = latency.build(GRID, rows, tmp_path)
    assert "not run" in page.read_text()
    assert not list(tmp_path.glob("*.png"))


# --- published ------------------------------------------------------------------------------------


def test_published_runtimes_are_marked_with_their_gpu_and_apart(built):
    lines = list(csv.DictReader(io.StringIO(built.text["table.csv"])))
    published = [line for line in lines if line["kind"] == "published"]
    assert {line["mark"] for line in published} == {"published (RTX 2080 Ti)"}
    assert {line["gpu"] for line in published} == {"RTX 2080 Ti"}
    found = {
        (li["backbone"], li["tasks"], li["size"]): (li["mean_ms"], li["fps"]) for li in published
    }
    assert found["ResNet18", "panoptic", "1024x2048"] == ("44.4", "")
    assert found["ResNet18", "panoptic, depth", "1024x2048"] == ("", "30")
    assert found["ResNet18", "panoptic, depth", "384x1280"] == ("", "82")
    for name in ("table.md", "table.tex", "index.html"):
        measured, _, rest = built.text[name].partition("44.4")
        assert rest, name
        assert "RTX 2080 Ti" in measured, name
    html = built.html
    assert html.index('<table class="results">') < html.index("Published (RTX 2080 Ti)")
    body = html[html.rindex('<table class="results">') :].partition("</table>")[0]
    assert "2080" not in body


# --- figures --------------------------------------------------------------------------------------


OTHERS = [column.name for column in headlines() if column.task not in Recipe.tasks]


@pytest.mark.parametrize(
    "stem", [s for s in latency.figures() if s.removesuffix("_fps") not in OTHERS]
)
def test_every_figure_is_drawn_with_its_names(built, stem):
    drawing = built.text[f"{stem}.svg"]
    for word in ("384x1280", "1024x2048", "resnet18", "tiny_one", "openvino"):
        assert word in drawing, word
    assert cv2.imread(str(built.out / f"{stem}.png")).std() > 5
    assert latency.figures()[stem] in built.html


def test_the_caption_says_whose_quality_and_whose_speed_it_is(built):
    (caption,) = {line for line in built.html.splitlines() if "<figcaption>PQ over frames" in line}
    assert "Quality is measured at the training recipe's size" in caption.replace("&#39;", "'")
    assert "recipe small (64x128 images, decoders of 128 channels), n = 2" in caption
    assert "with the network of recipe paper" in caption
    assert "<td>36.5</td><td>8.30</td><td>2</td>" in built.html


def test_no_quality_no_plot_of_it(tmp_path):
    table = tabulate([fake_latency.make_row("plain")])
    assert latency_plots.against_quality(table, "pq", tmp_path) is None
    alone = tabulate([fake_latency.make_row("plain", tasks=("panoptic",))], quality_rows())
    assert latency_plots.against_quality(alone, "pq", tmp_path) is None  # of another network
    assert latency_plots.stages(alone, tmp_path) is not None


def test_the_page_says_where_quality_would_come_from(tmp_path, built):
    grid = SimpleNamespace(**vars(GRID), quality={"grid": "backbones"})
    html = latency.build(grid, [fake_latency.make_row("plain")], tmp_path).read_text()
    assert "no cell of grid <b>backbones</b> is done (mtl-bench ablate --grid backbones)" in html
    assert "No plot of quality" not in built.html


def test_roofline_needs_its_numbers(tmp_path):
    rows = [fake_latency.make_row("plain", metric={"roofline.peak_gbs": None})]
    assert latency_plots.roofline(tabulate(rows), tmp_path) is None
    caption = latency_plots.roofline(tabulate([fake_latency.make_row("eager")]), tmp_path)
    assert "160.0 GFLOP and 900 MB a frame allow at 300 GFLOP/s and 20.0 GB/s" in caption
    assert "36 % of what" in caption


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ((165, 3400), ["200", "500", "1000", "2000"]),  # fp32 and AMX: one power of ten in it
        ((5, 2700), ["10", "100", "1000"]),  # 2 and 5 would run into each other
        ((0.7, 6), ["1", "2", "5"]),
    ],
)
@pytest.mark.parametrize("name", ["x", "y"])
def test_logarithmic_axes_have_plain_numbers(values, shown, name):
    axes = Figure().subplots()
    axes.plot(values, values)
    plots.plain_log(axes, name)
    axis = axes.xaxis if name == "x" else axes.yaxis
    low, high = axis.get_view_interval()
    ticks = zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
    assert [label.get_text() for place, label in ticks if low <= place <= high] == shown
    assert not any(label.get_text() for label in axis.get_ticklabels(minor=True))


def test_a_roof_is_the_highest_of_all_timings_of_a_precision():
    def line(precision, gflops, gbs):
        metric = {"roofline.peak_gflops": gflops, "roofline.peak_gbs": gbs}
        return SimpleNamespace(names=("", "", "", precision), row={"metric": metric})

    lines = [line("fp32", 400, 25), line("int8", 3000, 20), line("fp32", 350, 26)]
    roofs = latency_plots._roofs([*lines, line("fp16", 400, 26)])
    assert list(roofs.items()) == [((3000, 20), "int8"), ((400, 26), "fp32, fp16")]


def test_the_same_rows_give_the_same_bytes(built, tmp_path):
    latency.build(GRID, fake_latency.grid_rows(), tmp_path, quality_rows(), COMMAND)
    for path in built.out.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_the_table_goes_through_latex(built, tmp_path):
    head = r"\documentclass{article}\usepackage{booktabs,graphicx}\begin{document}"
    (tmp_path / "x.tex").write_text(head + built.text["table.tex"] + r"\end{document}")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "x.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]


# --- the Pareto front -----------------------------------------------------------------------------


def slow_front(points, better):
    """By its definition, one pair after another."""
    kept = []
    for i, (x, y) in enumerate(points):
        beaten = False
        for a, b in points:
            dx, dy = better[0] * (a - x), better[1] * (b - y)
            beaten |= dx >= 0 and dy >= 0 and (dx > 0 or dy > 0)
        if not beaten:
            kept.append(i)
    return set(kept)


@pytest.mark.parametrize(
    ("points", "better", "expected"),
    [
        ([(1, 3), (2, 2), (3, 1), (1, 1), (2, 1)], (1, 1), [0, 1, 2]),
        ([(1, 3), (2, 2), (3, 1), (1, 1), (2, 1)], (1, -1), [2]),
        ([(3, 1), (1, 1), (2, 0)], (1, -1), [2, 0]),
        ([(3, 1), (1, 3), (2, 2)], (-1, 1), [1]),
        ([(5, 5), (5, 5), (4, 5)], (1, 1), [0, 1]),  # equal points stand together
        ([(5, 5)], (1, 1), [0]),
        ([(1, 2), (2, 2), (3, 2)], (1, 1), [2]),
        ([(2, 1), (2, 3), (2, 2)], (1, 1), [1]),
        ([(1, 10), (2, 4), (3, 3.9)], (1, 1), [0, 1, 2]),  # below the hull's line, and kept
    ],
)
def test_front(points, better, expected):
    assert plots.front(points, better) == expected


@pytest.mark.parametrize("better", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_front_is_what_the_definition_says(better):
    rng = np.random.default_rng(0)
    for size in (1, 2, 7, 40):
        points = [tuple(map(float, p)) for p in rng.integers(0, 8, (size, 2))]
        found = plots.front(points, better)
        assert set(found) == slow_front(points, better)
        assert [points[i] for i in found] == sorted(points[i] for i in found)


@pytest.mark.parametrize(("better", "heights"), [(1, [3, 2, 1, 0]), (-1, [0.5, 0.5, 0.5, 9])])
def test_stairs_have_the_best_that_can_be_had_at_a_speed(better, heights):
    points = [(1, 3.0), (2, 2.0), (4, 1.0), (4, 0.5), (1.5, 1.0)]
    if better > 0:
        points.remove((4, 0.5))
    with style.styled():
        axes = style.Figure().add_subplot()
        axes.plot(*zip(*points, strict=True), "o")
        axes.set_xlim(0, 5)
        axes.set_ylim(0, 9)
        plots.draw_front(axes, points, (+1, better))
    line = axes.lines[-1]
    xs, ys = line.get_data()
    assert line.get_drawstyle() == "steps-pre"
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, 5), (0, 9))
    at = [ys[np.searchsorted(xs[1:], speed) + 1] for speed in (0.5, 1.7, 3.0)]
    assert [*at, ys[-1]] == heights  # a step has the height of its right end


def test_stairs_of_what_is_less_the_better_go_from_the_right_edge():
    points = [(1, 3.0), (2, 2.0), (4, 1.0), (3, 2.5)]
    with style.styled():
        axes = style.Figure().add_subplot()
        axes.plot(*zip(*points, strict=True), "o")
        axes.set_xlim(0, 5)
        axes.set_ylim(0, 9)
        plots.draw_front(axes, points, (-1, -1))
    assert axes.lines[-1].get_xydata().tolist() == [[5, 1], [4, 1], [2, 2], [1, 3], [1, 9]]


def test_files_have_no_more_than_the_grid_needs(built):
    assert sum(path.stat().st_size for path in built.out.iterdir()) < 1e6
