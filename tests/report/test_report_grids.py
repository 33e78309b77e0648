"""What certain grids need of a report: named rows, delta, cost alone, many methods."""

import csv
import io
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest
from fake_rows import BASELINE, GRID, curve, grid_rows, make_row, write_runs
from matplotlib.text import Text

from mtl_bench.core import style
from mtl_bench.core.columns import FPS
from mtl_bench.evaluate.delta import delta_flat, delta_task
from mtl_bench.report import curves, delta, plots, protocol
from mtl_bench.report import grid as report
from mtl_bench.report import table as formats
from mtl_bench.report.columns import column
from mtl_bench.report.footnotes import footnotes
from mtl_bench.report.grid import Layout, fill, tabulate

NAMED = Layout(rows="name")
ABLATION = {
    "Single-Task Baseline": {"single_task": True},
    "Multi-Task Baseline": {},
    "+ Uncertainty": {"method": "learned"},
    "+ Video Sequence": {"method": "learned", "video": True},
}
QUALITY = {
    "panoptic.pq": 40.0,
    "semantic.miou": 60.0,
    "depth_median.abs_rel": 0.2,
    "depth_median.rmse": 8.0,
    "depth_median.delta1": 0.8,
}


def named_rows(names=ABLATION, seeds=(0, 1, 2), **changes):
    return [
        {"name": name, **make_row(seed=seed, **settings, **changes)}
        for seed in seeds
        for name, settings in ABLATION.items()
        if name in names
    ]


def grid(name, **layout):
    return SimpleNamespace(**{**vars(GRID), "name": name, "report": layout})


# --- named rows -----------------------------------------------------------------------------------


def test_named_rows_need_no_further_axes():
    table = tabulate(named_rows(), NAMED)
    assert table.axes == ("name",)
    assert [group.identity for group in table.groups] == [(name,) for name in ABLATION]
    assert [len(group.rows) for group in table.groups] == [3, 3, 3, 3]


def test_what_differs_within_a_name_is_an_axis():
    rows = [*named_rows(backbone="a"), *named_rows(backbone="b")]
    assert tabulate(rows, NAMED).axes == ("name", "backbone")


def test_settings_of_the_video_stage_are_no_settings_of_other_cells():
    rows = [make_row(video=True), make_row()]
    assert tabulate(rows).axes == ("backbone", "video")
    rows += [make_row(video=True), make_row()]
    for row in rows[2:]:
        row["cell"]["recipe"]["pseudo"]["flip"] = False
    table = tabulate(rows)
    assert table.axes == ("backbone", "video", "recipe.pseudo.flip")
    assert [group.identity[1:] for group in table.groups] == [
        ("yes", "yes"),
        ("no", "none"),
        ("yes", "no"),
    ]


def test_how_often_cosines_are_logged_changes_no_number():
    rows = [make_row(seed=0), make_row(seed=1)]
    rows[1]["cell"]["recipe"]["optim"]["cosine_every"] = 50
    (group,) = tabulate(rows).groups
    assert len(group.rows) == 2


def test_order_is_the_grids_whatever_is_done():
    rows = named_rows()
    rows[0]["status"] = "failed"
    assert [group.identity[0] for group in tabulate(rows, NAMED).groups] == list(ABLATION)


def test_an_unfinished_named_cell_has_its_name():
    rows = [{**row, "status": "failed", "error": "no"} for row in named_rows(seeds=(0,))]
    assert tabulate(rows, NAMED).unfinished[2].label == "+ Uncertainty, seed 0"


def test_first_columns_and_unknown_ones():
    table = tabulate(grid_rows(), Layout(first=("rmse", "pq")))
    assert [column.name for column in table.columns()][:3] == ["rmse", "pq", "rmse_dgc"]
    with pytest.raises(ValueError, match=r"no column 'rsme' \(did you mean 'rmse'"):
        Layout.of({"first": ["rsme"]})
    with pytest.raises(ValueError, match=r"'report\.row'"):
        Layout.of({"row": "name"})
    with pytest.raises(ValueError, match="no part 'costs'"):
        Layout.of({"only": "costs"})
    with pytest.raises(ValueError, match="no figure 'pq'"):
        Layout.of({"readme": ["pq"]})


# --- published rows -------------------------------------------------------------------------------


def test_published_ablation_stands_beside_its_names_only(tmp_path):
    report.build(grid("ablation", rows="name"), named_rows(seeds=(0,)), tmp_path)
    markdown = (tmp_path / "table.md").read_text()
    assert "| configuration | PQ ↑ | RMSE (m) ↓ |" in markdown  # and no FPS
    assert "| + Video Sequence | 55.7 | 8.3 |" in markdown
    assert "published (Cityscapes)" in (tmp_path / "index.html").read_text()
    lines = list(csv.DictReader(io.StringIO((tmp_path / "table.csv").read_text())))
    published = [line for line in lines if line["kind"] == "published"]
    assert [line["name"] for line in published] == list(ABLATION)
    assert published[0]["fps"] == ""
    others = [{**row, "name": f"{row['name']}, other"} for row in named_rows()]
    assert tabulate(others, NAMED).published == ()
    assert tabulate([*others, *named_rows(["+ Uncertainty"])], NAMED).published == ()
    two = named_rows(["+ Uncertainty", "+ Video Sequence"])
    assert len(tabulate([*others, *two], NAMED).published) == 1


def test_a_published_list_may_lack_a_value():
    source = {"rows": [{"name": "a", "pq": 1.0}, {"name": "b", "fps": 2.0}]}
    source |= {"mark": "published", "source": "A paper", "note": "a note"}
    section = report._published(source, "name")
    assert [head.title for head in section.heads[1:]] == ["PQ \u2191", "FPS \u2191"]
    assert [cell.text for cell in section.lines[1].cells[1:]] == ["-", "2.0"]


# --- delta ----------------------------------------------------------------------------------------


def rows_with_baseline():
    """A row 10 % better in PQ and worse in RMSE than the baseline of its seed."""
    rows = [make_row(seed=seed, metric=QUALITY) for seed in range(2)]
    base = [make_row(seed=seed, single_task=True, metric=QUALITY) for seed in range(2)]
    for row in rows:
        row["metric"]["panoptic.pq"] = 44.0
        row["metric"]["depth_median.rmse"] = 8.8
    return rows, {row["seed"]: row for row in base}


def test_delta_against_the_row_of_the_same_seed():
    rows, base = rows_with_baseline()
    base[1]["metric"]["panoptic.pq"] = 44.0
    first, second = delta.with_delta(rows, lambda row: base[row["seed"]])
    # flat: mean of -10, 0, 0, 10, 0; by task: mean of (10 + 0) / 2 and (0 - 10 + 0) / 3
    assert first["metric"]["delta.flat"] == pytest.approx(0)
    assert first["metric"]["delta.task"] == pytest.approx((5 - 10 / 3) / 2)
    assert second["metric"]["delta.flat"] == pytest.approx(2)
    assert "delta.flat" not in rows[0]["metric"]  # copies
    for key, function in (("flat", delta_flat), ("task", delta_task)):
        metrics = delta.counted(rows)
        more = ({c.key: c.task for c in metrics},) if key == "task" else ()
        own, other = rows[0]["metric"], base[0]["metric"]
        expected = function(own, other, {c.key: c.better > 0 for c in metrics}, *more)
        assert first["metric"][f"delta.{key}"] == expected


@pytest.mark.parametrize(
    "change",
    [
        lambda row, base: None,
        lambda row, base: row,  # its own baseline
        lambda row, base: {**base, "metric": {**base["metric"], "panoptic.pq": 0.0}},
        lambda row, base: {**base, "metric": {"panoptic.pq": 40.0}},
        lambda row, base: {key: value for key, value in base.items() if key != "metric"},
        lambda row, base: {**base, "status": "stale"},
        lambda row, base: {**base, "smoke": True},
    ],
)
def test_no_delta_without_a_comparable_baseline(change):
    rows, base = rows_with_baseline()
    assert delta.with_delta(rows[:1], lambda row: change(row, base[0])) == rows[:1]


def test_a_row_without_the_metrics_has_no_delta():
    rows, base = rows_with_baseline()
    del rows[0]["metric"]["semantic.miou"]
    del rows[1]["metric"]
    assert delta.with_delta(rows, lambda row: base[row["seed"]]) == rows


def test_delta_stands_in_the_table_with_its_sign_and_baseline():
    rows, base = rows_with_baseline()
    table = tabulate(delta.with_delta([*rows, *base.values()], lambda row: base[row["seed"]]))
    markdown = formats.markdown(fill(table))
    assert "Δ flat\u00a0↓<br>% worse" in markdown
    assert "Δ task\u00a0↑<br>% better" in markdown
    (note,) = [note for note in footnotes(table) if note.startswith("Delta")]
    assert "single-task fixed on resnet18" in note
    assert [g.entries["delta_flat"].count for g in table.groups] == [2, 0]
    assert r"$\Delta$ flat" in formats.latex(fill(table))
    assert not any(note.startswith("Delta") for note in footnotes(tabulate(rows)))


@pytest.mark.parametrize(("low", "bold"), [(-3.0, True), (-0.8, False)])
def test_a_bold_delta_leads_the_baselines_zero_too(low, bold):
    rows = [
        make_row(name, seed, metric={"delta.flat": value + seed})
        for name, value in (("a", low), ("b", 20.0))
        for seed in range(2)
    ]
    assert tabulate(rows).groups[0].entries["delta_flat"].bold == bold


# --- cost -----------------------------------------------------------------------------------------


def cost_rows():
    times = {"plain": (100.0, 102.0), "twice": (210.0, 194.0)}
    return [
        {**make_row(method=method, seed=seed), "time": {"step_ms": ms, "peak_mib": 3 * ms}}
        for method, several in times.items()
        for seed, ms in enumerate(several)
    ]


def test_cost_relative_to_a_line(tmp_path):
    layout = {"rows": "method", "only": "cost", "reference": "plain"}
    rows = cost_rows()
    runs = write_runs(tmp_path / "runs", rows)
    report.build(grid("methods-cost", **layout), rows, tmp_path / "out", runs, BASELINE)
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {
        ".html",
        ".csv",
        ".md",
        ".tex",
    }
    table = tabulate(rows, Layout.of(layout), BASELINE)
    names = ["step_ms", "step_x", "train_peak_mib", "train_peak_x"]
    assert [column.name for column in table.columns()] == names
    assert table.groups[1].entries["step_x"].mean == pytest.approx(2)
    markdown = (tmp_path / "out/table.md").read_text()
    assert "step\u00a0↓<br>x of plain" in markdown
    assert "| twice | 2 | 202.0 ± 11.3 | 2.00 | 606.0 ± 33.9 | 2.00 |" in markdown
    assert "Quality" not in markdown
    assert "trivial" not in markdown
    assert "step_x" in (tmp_path / "out/table.csv").read_text()


def test_a_reference_without_numbers_is_said():
    table = tabulate(cost_rows()[2:], Layout(rows="method", reference="plain"))
    assert "step_x" not in [column.name for column in table.columns()]
    assert any("no such line has numbers" in note for note in footnotes(table))


def test_training_cost_stands_beside_the_speed():
    names = [column.name for column in tabulate(cost_rows(), Layout(rows="method")).columns("cost")]
    assert names == ["fps", "params_m", "step_ms", "train_peak_mib"]


def test_minus_zero_has_no_sign():
    assert formats.number(-0.04, column("delta_flat")) == "0.0"


# --- the page -------------------------------------------------------------------------------------


def test_pseudo_labels_are_protocol_of_the_video_stage_only():
    with_stage = dict(protocol.of_cells(named_rows()))
    assert ("flip", "yes", False) in with_stage["Pseudo labels"]
    assert ("one network a task", "yes | no", True) in with_stage["Cells"]
    without = named_rows(["Multi-Task Baseline"])
    assert "Pseudo labels" not in dict(protocol.of_cells(without))


def test_quality_and_cost_are_two_tables_on_the_page(tmp_path):
    html = report.build(GRID, grid_rows(), tmp_path).read_text()
    assert html.count('<table class="results">') == 2


# --- figures --------------------------------------------------------------------------------------


def methods(count):
    return [make_row(method=f"method_{i}", metric={"panoptic.pq": 20.0 + i}) for i in range(count)]


def test_a_row_of_two_networks_has_no_curve_of_its_own(tmp_path):
    rows = named_rows(seeds=(0, 1))
    write_runs(tmp_path / "runs", rows)
    for row in rows:
        if row["cell"]["single_task"]:
            (tmp_path / "runs" / row["slug"] / "curve.csv").unlink()
    html = report.build(
        grid("x", rows="name"), rows, tmp_path / "out", tmp_path / "runs"
    ).read_text()
    assert "The video stage counts its own steps." in html
    drawing = (tmp_path / "out/weight_curves.svg").read_text()
    assert "+ Video Sequence" in drawing
    assert "Single-Task Baseline" not in drawing


def test_empty_cells_of_a_curve_leave_no_gap(tmp_path):
    rows = methods(1)
    table = tabulate(rows, Layout(rows="method"))
    frame = pd.DataFrame(curve())
    assert frame["cosine.semantic.center"].notna().sum() == 5
    with style.styled():
        axes = style.Figure().add_subplot()
        look = plots.looks_of(table)[0][1]
        line = curves._curve(axes, [frame], "cosine.semantic.center", look, False, False)
    assert list(line.get_xdata()) == [8, 16, 24, 32, 40]
    assert list(line.get_ydata()) == pytest.approx(list(np.sin(line.get_xdata())))


def test_a_loss_that_no_batch_had_is_left_out(tmp_path):
    table = tabulate(methods(1), Layout(rows="method"))
    frame = pd.DataFrame(curve() | {"loss.offset": np.nan})
    assert curves.terms(table, {"method_0": [frame]}, "loss", tmp_path)
    drawing = (tmp_path / "loss_curves.svg").read_text()
    assert "center" in drawing
    assert "offset" not in drawing


def test_diagnostics_show_what_there_is(tmp_path):
    table = tabulate(methods(1), Layout(rows="method"))
    frame = pd.DataFrame(curve())
    caption = curves.diagnostics(table, {"method_0": [frame]}, tmp_path)
    assert caption.startswith("Norm of the parameters' update and cosines between")
    assert "cosine semantic, center" in (tmp_path / "diagnostics.svg").read_text()
    frame["cosine.semantic.center"] = np.nan
    assert "cosine" not in curves.diagnostics(table, {"method_0": [frame]}, tmp_path)
    del frame["update_norm"]
    assert curves.diagnostics(table, {"method_0": [frame]}, tmp_path) is None


def test_diagnostics_of_many_are_a_table_of_means(tmp_path):
    rows = methods(12)
    table = tabulate(rows, Layout(rows="method"))
    frame = pd.DataFrame(curve())
    runs = {group.label: [frame] for group in table.groups}
    assert curves.diagnostics(table, runs, tmp_path).startswith("Means")
    drawing = (tmp_path / "diagnostics.svg").read_text()
    assert drawing.count(f">{frame['cosine.semantic.center'].mean():.2f}</text>") == 12


def test_thirty_lines_look_different():
    found = style.looks(range(30))
    assert len({(look.color, look.dash) for look in found.values()}) == 30
    assert len({(look.color, look.marker) for look in found.values()}) == 30


def test_numbers_of_many_points_do_not_overlap():
    with style.styled():
        figure = style.Figure(figsize=(9.2, 4.8), layout="constrained")
        axes = figure.add_subplot()
        rng = np.random.default_rng(0)
        spots = {i: tuple(rng.normal(0, 0.4, 2)) for i in range(1, 29)}
        spots |= {29: (3.0, 3.0), 30: (-3.0, -3.0)}  # the others are a heap
        axes.plot(*zip(*spots.values(), strict=True), "o")
        plots._number(axes, spots)
        figure.draw_without_rendering()
        boxes = [Text.get_window_extent(text) for text in axes.texts]  # without its line
    overlaps = [(i, j) for i in range(30) for j in range(i) if boxes[i].overlaps(boxes[j])]
    assert [text.get_text() for text in axes.texts] == [str(i) for i in range(1, 31)]
    assert overlaps == []


def test_the_front_of_many_holds_those_out_of_view(tmp_path, monkeypatch):
    fronts = []
    monkeypatch.setattr(plots, "draw_front", lambda axes, points, better: fronts.append(points))
    rows = methods(14)
    far = [row for row in rows if row["method"] == "method_3"]
    for row in far:
        row["metric"] |= {"panoptic.pq": 95.0, "depth_median.rmse": 0.1}
    caption = plots.against(
        tabulate(rows, Layout(rows="method")), column("pq"), column("rmse"), tmp_path
    )
    assert "Further out: method_3 95.0 at 0.1" in caption
    ((x, y),) = [point for point in fronts[0] if point[1] > 90]
    assert (x, y) == pytest.approx((0.1, 95.0))
    assert len(fronts[0]) == 14
    drawing = (tmp_path / "pq_rmse.svg").read_text()
    assert ">14<" in drawing
    assert ">4<" not in drawing  # its number is not beside a point


def test_a_report_of_many_methods_is_small_and_whole(tmp_path):
    rows = methods(30)
    runs = write_runs(tmp_path / "runs", rows)
    html = report.build(grid("methods", rows="method"), rows, tmp_path / "out", runs).read_text()
    assert sum(path.stat().st_size for path in (tmp_path / "out").iterdir()) < 1.2e6
    for stem in ("pq_rmse", "weight_curves", "loss_curves", "diagnostics", "classes"):
        drawing = (tmp_path / f"out/{stem}.svg").read_text()
        assert all(f"method_{i}" in drawing for i in range(30)), stem
        assert cv2.imread(str(tmp_path / f"out/{stem}.png")).std() > 5
    assert "The first 6 of 30" in html


def test_speed_is_not_drawn_where_the_network_is_one(tmp_path):
    layout = Layout(rows="method")
    assert plots.against(tabulate(methods(2), layout), column("pq"), FPS, tmp_path) is None
    assert plots.against(tabulate(methods(2), layout), column("pq"), column("rmse"), tmp_path)
    assert plots.against(tabulate(methods(1), layout), column("pq"), FPS, tmp_path)
    assert plots.against(tabulate(grid_rows()), column("pq"), FPS, tmp_path)
