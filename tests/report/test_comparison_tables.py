"""Measured rows among published ones: where a row stands, what it says of itself, every file."""

import csv
import re
import shutil
import subprocess
from dataclasses import replace

import pytest
from test_report import Page
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core import config
from mtl_bench.core.files import write_json
from mtl_bench.report import literature
from mtl_bench.report import table as formats
from mtl_bench.report.statistics import SMOKE

TABLES = [name for name in literature.names() if literature.load(name).sort]
FRAMES = {"cityscapes": 500, "kitti": 652, "synthetic": 100, "synthetic-kitti": 60}
DEPTH = {"abs_rel": 0.1, "rmse": 4.2, "delta1": 0.9, "delta2": 0.97, "delta3": 0.99}


def cell(dataset, seed=0, recipe="mine", smoke=False, **changes):
    data = config.Data(dataset=dataset, height=192, width=640)
    made = config.Recipe(name=recipe, smoke=smoke, data=data)
    values = {"backbone": "tiny_one", "method": "a_method", **changes}
    return config.Cell(made, seed=seed, **values)


def row(dataset="cityscapes", seed=0, metric=None, protocol=None, status="done", **changes):
    """As `row.json` holds it; KITTI's has two protocols, the second of raw laser points."""
    made, kitti = cell(dataset, seed, **changes), "kitti" in dataset
    raw = {"name": "eigen-raw", "split": "test", "frames": 697, "published_frames": 697}
    own = {
        "name": "eigen-improved" if kitti else "full-frame",
        "split": "test" if kitti else "val",
        "frames": FRAMES[dataset],
        "published_frames": 652 if kitti else 500,
        "input": [192, 640],
        "also": {"eigen-raw": raw} if kitti else {},
    }
    values = {"panoptic.pq": 60.0, "latency.mean_ms": 12.34, "latency.fps": 81.0}
    values |= {"latency.height": 192, "latency.width": 640, "latency.threads": 2}
    values |= {"latency.device": "A CPU(R)"}
    for prefix in ("", "eigen-raw.") if kitti else ("",):
        for name, value in DEPTH.items():
            values[f"{prefix}depth_median.{name}"] = value
            values[f"{prefix}depth_dgc.{name}"] = value + 0.001
    return {
        "slug": made.slug,
        "status": status,
        "error": "",
        "seed": seed,
        "smoke": made.recipe.smoke,
        "cell": config.to_dict(made),
        "metric": {**values, **(metric or {})},
        "protocol": {**own, **(protocol or {})},
    }


def compare(name, rows, **options):
    return literature.compare(literature.load(name), rows, **options)


def columns(table):
    """Those behind the method."""
    return table.literature.columns[1:]


def halves(line, name):
    known = {**literature.load("cityscapes").numbers, **literature.load("kitti").numbers}
    cell = literature.cell(line, name, known)
    return cell.text, cell.spread


def measured(table):
    return [(line.place, line.marks) for line in table.measured]


# --- where a row stands ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", TABLES)
def test_published_rows_alone_are_sorted_and_whole(name):
    table = compare(name, [])
    assert len(table.sections) == 1
    assert len(table.lines) == len(table.literature.row)
    values = [line.entries[table.literature.sort].mean for line in table.lines]
    assert values == sorted(values, reverse=name == "cityscapes")
    assert any("No measured row" in note for note in table.notes)


def test_a_row_of_the_data_set_stands_among_the_published_in_its_order():
    rows = [row(seed=seed, metric={"panoptic.pq": pq}) for seed, pq in enumerate((60.0, 61.0))]
    (section,) = compare("cityscapes", rows).sections
    place = [line.kind for line in section.lines].index("measured")
    before, own, after = section.lines[place - 1 : place + 2]
    assert (before.printed["pq"], after.printed["pq"]) == ("61.4", "58.8")
    assert (own.count, own.entries["pq"].mean) == (2, 60.5)
    assert halves(own, "pq") == ("60.5", "\u00b1 0.7")
    assert own.what == "measured"
    assert own.texts["frames"] == "500/500"
    assert own.texts["device"] == "A CPU, 2 threads"
    assert halves(own, "runtime_ms") == ("12.3", "")


@pytest.mark.parametrize(("counts", "said"), [((1, 1), "1 thread"), ((2, 1), "1 or 2 threads")])
def test_the_threads_of_all_seeds_are_said(counts, said):
    rows = [
        row(seed=seed, metric={"panoptic.pq": 60.5, "latency.threads": count})
        for seed, count in enumerate(counts)
    ]
    (section,) = compare("cityscapes", rows).sections
    (own,) = [line for line in section.lines if line.kind == "measured"]
    assert own.texts["device"] == f"A CPU, {said}"


@pytest.mark.parametrize(
    ("name", "made", "expected"),
    [
        ("cityscapes", row("synthetic"), (2, ("built-in data, not Cityscapes",))),
        ("cityscapes", row(protocol={"frames": 5}), (1, ("5 of 500 frames",))),
        ("cityscapes", row(protocol={"split": "train"}), (1, ("split train",))),
        ("cityscapes", row(status="stale"), (0, ("stale",))),
        ("kitti", row("synthetic-kitti"), (2, ("built-in data, not KITTI",))),
        ("kitti", row("kitti", protocol={"frames": 4, "also": {}}), (1, ("4 of 652 frames",))),
        (
            "kitti",
            row("kitti", protocol={"name": "eigen-improved (depth_crop x)", "also": {}}),
            (1, ("protocol eigen-improved (depth_crop x)",)),
        ),
    ],
)
def test_what_is_not_comparable_stands_apart_and_says_why(name, made, expected):
    places = measured(compare(name, [made]))
    assert set(places) == {expected}


def test_every_protocol_and_scaling_of_kitti_has_a_line():
    table = compare("kitti", [row("kitti")])
    lines = {line.texts["protocol"]: line for line in table.measured}
    assert {key: (line.place, line.marks) for key, line in lines.items()} == {
        "eigen-improved, median": (0, ()),
        "eigen-improved, dgc": (0, ()),
        "eigen-raw, median": (1, ("protocol eigen-raw",)),
        "eigen-raw, dgc": (1, ("protocol eigen-raw",)),
    }
    assert lines["eigen-improved, dgc"].entries["abs_rel"].mean == pytest.approx(0.101)
    assert lines["eigen-raw, median"].texts["frames"] == "697/697"
    assert lines["eigen-improved, median"].texts["input"] == "640x192"


def test_a_protocol_without_dgc_has_no_line_of_it():
    made = row("kitti")
    made["metric"] = {
        key: value
        for key, value in made["metric"].items()
        if not key.startswith("eigen-raw.depth_dgc")
    }
    protocols = {line.texts["protocol"] for line in compare("kitti", [made]).measured}
    assert "eigen-raw, dgc" not in protocols
    assert len(protocols) == 3


def test_frames_that_dgc_leaves_out_are_counted():
    rows = [
        row("kitti", seed=s, metric={"eigen-raw.dgc.failed": 3, "dgc.failed": 0}) for s in (0, 1)
    ]
    marks = {line.texts["protocol"]: line.marks for line in compare("kitti", rows).measured}
    assert marks.pop("eigen-raw, dgc") == ("protocol eigen-raw", "no dgc scale in 6 frames")
    assert not any("scale" in mark for several in marks.values() for mark in several)


def test_rows_of_another_data_set_task_or_without_numbers_stay_out():
    other = [row("kitti"), row("cityscapes", status="failed"), row("cityscapes", tasks=("depth",))]
    del other[-1]["metric"]["panoptic.pq"]
    assert compare("cityscapes", other).measured == []
    assert compare("kitti", [row("cityscapes"), row("synthetic")]).measured == []


def test_smoke_rows_are_apart():
    rows = [row("synthetic", smoke=True), row("synthetic", recipe="b"), row(smoke=True)]
    table = compare("cityscapes", rows)
    assert len(table.measured) == 1
    assert any(note.startswith("2 smoke rows are left out") for note in table.notes)
    smoke = measured(compare("cityscapes", rows, smoke=True))
    assert smoke == [(1, (SMOKE,)), (2, ("built-in data, not Cityscapes", SMOKE))]


def test_lines_say_what_the_cells_are():
    rows = [
        row(video=True),
        row(tasks=("panoptic",)),
        row(single_task=True),
        row(method_args={"alpha": 0.5}),
        row(recipe="other", pretrained="timm"),
    ]
    details = {line.details for line in compare("cityscapes", rows).measured}
    assert details == {
        "video stage, recipe mine",
        "panoptic alone, recipe mine",
        "one network a task, recipe mine",
        "recipe mine, alpha 0.5",
        "weights timm, recipe other",
    }
    (line,) = compare("kitti", [row("kitti", protocol={"also": {}})]).measured[:1]
    assert line.details == "tiny_one, recipe mine"


def test_what_a_shipped_recipe_says_is_not_said_again():
    recipe = config.load_recipe("small")
    longer = replace(recipe, optim=replace(recipe.optim, steps=9999))
    rows = [row("synthetic", seed=i) for i in range(2)]
    for made, its in zip(rows, (recipe, longer), strict=True):
        made["cell"] = config.to_dict(config.Cell(its, "tiny_one", "a_method"))
    details = {line.details for line in compare("cityscapes", rows).measured}
    assert details == {"recipe small", "recipe small, optim.steps 9999"}


def test_a_speed_at_another_size_says_so():
    made = row(metric={"latency.height": 1024, "latency.width": 2048})
    assert compare("cityscapes", [made]).measured[0].texts["device"].endswith("at 1024x2048")


# --- files ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Both tables with a row in every section, and one seed more than another has a time for."""
    folder = tmp_path_factory.mktemp("tables")
    rows = [
        *(row(seed=s, metric={"panoptic.pq": 60.0 + s}) for s in range(3)),
        *(row(d, recipe="b_&%", video=True) for d in FRAMES),
        *(row("kitti", seed=s, metric={"depth_dgc.rmse": 4.0 + s}) for s in range(2)),
        row("cityscapes", recipe="few", protocol={"frames": 5}),
    ]
    for name in ("latency.mean_ms", "latency.fps", "latency.device"):
        del rows[0]["metric"][name]
    tables = {name: compare(name, rows) for name in TABLES}
    for name, table in tables.items():
        literature.write(table, folder / name, f"mtl-bench report --table {name}")
    return folder, tables


def shown(table, line):
    """What a line's cells are in every spelling but LaTeX's."""
    names = columns(table)
    return [" ".join(filter(None, halves(line, name))) for name in names]


@pytest.mark.parametrize("name", TABLES)
def test_csv_has_every_number(built, name):
    folder, tables = built
    with (folder / name / "table.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(tables[name].lines)
    for found, line in zip(lines, tables[name].lines, strict=True):
        assert (found["kind"], found["mark"]) == (line.kind, "; ".join(line.marks))
        assert (found["method"], found["n"]) == (line.texts["method"], str(line.count))
        for column in tables[name].literature.numbers.values():
            entry = line.entries.get(column.name)
            value = found[column.name]
            if entry is None or not entry.count:
                assert value == ""
            else:
                assert float(value) == pytest.approx(entry.mean, rel=1e-5)
    assert {line["kind"] for line in lines} == {"published", "measured"}
    assert all(line["source"] for line in lines if line["kind"] == "published")


@pytest.mark.parametrize("name", TABLES)
def test_markdown_has_every_cell(built, name):
    folder, tables = built
    text = (folder / name / "table.md").read_text(encoding="utf-8")
    lines = [re.split(r" (?<!\\)\| ", line[2:-2]) for line in text.splitlines() if line[:2] == "| "]
    body = [line for line in lines if line[0] not in ("Method", "---")]
    for found, line in zip(body, tables[name].lines, strict=True):
        assert found[1] == line.what
        assert found[2:] == [*shown(tables[name], line), line.seeds]
    for section in tables[name].sections:
        assert f"**{section.heading}**" in text
    assert "MGNet: Schoen, Buchholz, Dietmayer" in text


@pytest.mark.parametrize("name", TABLES)
def test_page_is_sound_and_has_every_cell(built, name):
    folder, tables = built
    text = (folder / name / "index.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    assert all((folder / name / target).is_file() for target in page.targets)
    bodies = re.findall(r"<tr class=.*?</tr>", text, re.DOTALL)
    for found, line in zip(bodies, tables[name].lines, strict=True):
        cells = re.findall(r"<td[^>]*>(.*?)</td>", found, re.DOTALL)
        plain = [re.sub(r"<[^>]*>", "", cell) for cell in cells]
        assert plain[1:] == [*shown(tables[name], line), line.seeds]
        assert all(mark in plain[0] for mark in (line.kind, *line.marks))
        assert f'class="{line.kind}' in found
    assert f"mtl-bench report --table {name}" in text


@pytest.mark.parametrize("name", TABLES)
def test_latex_has_every_number_and_compiles(built, name, tmp_path):
    folder, tables = built
    source = (folder / name / "table.tex").read_text(encoding="ascii")
    assert "?" not in source
    body = source[source.index(r"\midrule") : source.index(r"\bottomrule")]
    names = [n for n in columns(tables[name]) if n in tables[name].literature.narrow]
    lines = [line.removesuffix(r" \\") for line in body.splitlines() if " & " in line]
    for found, line in zip(lines, tables[name].lines, strict=True):
        _, origin, *cells, count = re.split(r"(?<!\\) & ", found)
        assert (origin.partition("$")[0], count) == (line.kind, line.seeds)
        for cell, column in zip(cells, names, strict=True):
            mean, spread = halves(line, column)
            assert cell.partition(r"{\scriptsize")[0] == formats.tex(mean)
            assert spread.replace("\u00b1", r"$\pm$") in cell
        letters = re.findall("[a-z]", origin.partition("$")[2])
        explained = [re.findall(rf"\^{{{x}}}\$ (.*?)\.(?= )", source)[0] for x in letters]
        assert {formats.tex(mark) for mark in line.marks} <= set(explained)
    compile_latex(folder / name / "table.tex", tmp_path)


def compile_latex(table, folder):
    if not shutil.which("pdflatex"):
        pytest.skip("no pdflatex")
    shutil.copy(table, folder)
    (needs,) = re.findall(r"^% needs (.*)$", table.read_text(), re.MULTILINE)
    (folder / "paper.tex").write_text(
        f"\\documentclass{{article}}{needs}\\begin{{document}}\\input{{table}}\\end{{document}}"
    )
    words = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]


def test_values_that_are_missing_are_dashes(built):
    _, tables = built
    lines = [line for line in tables["cityscapes"].lines if line.texts["method"] == "Porzi et al."]
    assert halves(lines[0], "runtime_ms") == ("-", "")
    (own,) = [line for line in tables["cityscapes"].measured if line.count == 3]
    assert halves(own, "runtime_ms") == ("12.3", "(n=2)")
    made = row()
    del made["metric"]["latency.mean_ms"], made["metric"]["latency.device"]
    (line,) = compare("cityscapes", [made]).measured
    assert halves(line, "runtime_ms") == ("-", "")
    assert line.texts["device"] == "-"


# --- the command ----------------------------------------------------------------------------------


def run(*words):
    return CliRunner().invoke(app, ["report", *map(str, words)])


@pytest.fixture
def runs(tmp_path):
    """Two finished seeds on the built-in data, a smoke row, and a folder without a row."""
    for made in (
        cell("synthetic", 0, method="fixed", backbone="tiny"),
        cell("synthetic", 1, method="fixed", backbone="tiny"),
        cell("synthetic", 0, method="fixed", backbone="tiny", smoke=True),
    ):
        folder = tmp_path / "runs" / made.slug
        folder.mkdir(parents=True)
        own = row("synthetic", made.seed, method="fixed", backbone="tiny", smoke=made.recipe.smoke)
        write_json(folder / "cell.json", config.to_dict(made))
        write_json(folder / "row.json", own)
    (tmp_path / "runs/begun").mkdir()
    return tmp_path / "runs"


def test_the_command_finds_finished_cells(runs, tmp_path):
    done = run("--table", "cityscapes", "--runs", runs, "--reports", tmp_path)
    assert done.exit_code == 0, done.output
    assert done.output.strip().endswith("tables-cityscapes/index.html")
    text = (tmp_path / "tables-cityscapes/table.md").read_text(encoding="utf-8")
    assert "built-in data, not Cityscapes; stale" in text
    assert "| 60.0 |" in text
    assert text.count("| measured") == 1
    assert "1 smoke row is left out" in text
    smoke = run("--table", "cityscapes", "--runs", runs, "--reports", tmp_path, "--smoke")
    assert smoke.output.strip().endswith("tables-cityscapes-smoke/index.html")
    assert SMOKE in (tmp_path / "tables-cityscapes-smoke/table.md").read_text(encoding="utf-8")


def test_the_command_takes_a_grids_rows(runs, tmp_path):
    options = ["--runs", runs, "--reports", tmp_path]
    done = run("--table", "cityscapes", "--grid", "backbones", *options)
    assert done.exit_code == 0, done.output
    assert "published rows only" in done.output
    text = (tmp_path / "tables-cityscapes/index.html").read_text(encoding="utf-8")
    assert "mtl-bench report --table cityscapes --grid backbones" in text


def test_without_measured_rows_the_published_are_written(tmp_path):
    done = run("--table", "kitti", "--runs", tmp_path / "none", "--reports", tmp_path)
    assert done.exit_code == 0, done.output
    assert "belongs to table 'kitti': published rows only" in done.output
    assert "PackNet-SfM" in (tmp_path / "tables-kitti/table.md").read_text(encoding="utf-8")


def test_wrong_words_are_told():
    wrong = run("--table", "cityscape")
    assert wrong.exit_code == 2
    assert "no table called 'cityscape' (did you mean 'cityscapes'?)" in wrong.output
    assert "say --grid NAME or --table NAME" in run().output
