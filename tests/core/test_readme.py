"""The README's examples are run, and its generated parts are the reference report's."""

import io
import re
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from mtl_bench.bench.check import check
from mtl_bench.bench.grid import load_grid
from mtl_bench.bench.tuning import trials
from mtl_bench.report import readme

README = Path(__file__).resolve().parents[2] / "README.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)


def write_example(kind, name, marker, tmp_path, monkeypatch):
    (source,) = [example for example in EXAMPLES if marker in example]
    folder = tmp_path / kind
    folder.mkdir()
    (folder / f"{name}.py").write_text(source)
    monkeypatch.setenv("MTL_BENCH_PLUGINS", str(tmp_path))


@pytest.mark.parametrize(
    ("kind", "name", "marker"),
    [("methods", "power_mean", "LossMethod"), ("backbones", "resnet34", "TimmBackbone")],
)
def test_example_passes_the_checks(kind, name, marker, tmp_path, monkeypatch):
    write_example(kind, name, marker, tmp_path, monkeypatch)
    failed = [f"{r.name}: {r.detail}" for r in check(kind, name) if not r.ok]
    assert failed == []


def test_the_example_grids_load(tmp_path, monkeypatch):
    write_example("methods", "power_mean", "LossMethod", tmp_path, monkeypatch)
    plain, tuned = tmp_path / "plain.toml", tmp_path / "tuned.toml"
    sources = re.findall(r"```toml\n(.*?)```", README.read_text(), re.DOTALL)
    for path, source in zip((plain, tuned), sources, strict=True):
        path.write_text(source)
    grid = load_grid(str(plain))
    assert len(grid.cells) == 6
    assert set(grid.names.values()) == {"Fixed", "Uncertainty, longer warm-up"}
    assert {cell.recipe.optim.warmup_steps for cell in grid.cells} == {20, 100}
    grid = load_grid(str(tuned))
    assert {cell.method for cell in grid.cells} >= {"power_mean", "scalarised"}
    assert len(grid.cells) == 3 * 6 * 5
    assert len(trials(grid)) == 3 * 7 * 6


def test_every_linked_file_exists():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README.read_text()):
        assert (README.parent / target).exists(), target


def changed(path):
    """Whether a file or folder is not as it was committed; False where git does not know."""
    words = ["git", "status", "--porcelain", "--", path]
    return bool(subprocess.run(words, cwd=README.parent, capture_output=True).stdout)


@pytest.fixture(scope="module")
def committed(tmp_path_factory):
    """A folder with README and reports of the last commit."""
    words = ["git", "archive", "HEAD", "README.md", "reports"]
    found = subprocess.run(words, cwd=README.parent, capture_output=True, check=True).stdout
    folder = tmp_path_factory.mktemp("committed")
    with tarfile.open(fileobj=io.BytesIO(found)) as archive:
        archive.extractall(folder, filter="data")
    return folder


@pytest.mark.parametrize("name", readme.names(README))
def test_the_results_are_the_reference_reports(name, request):
    folder = README.parent
    if changed(f"reports/{name}") and not changed("README.md"):
        # somebody has run the grid, which is no reason to fail: theirs is no reference report
        folder = request.getfixturevalue("committed")
    text = readme.filled(folder / "README.md", name, folder / "reports" / name)
    assert text == (folder / "README.md").read_text("utf-8"), "make readme"


def test_a_command_fills_in_all_results(tmp_path):
    path = tmp_path / "README.md"
    blocks = "".join(f"<!-- results:{name} -->\nold\n<!-- /results -->\n" for name in "ab")
    path.write_text(f"# Title\n{blocks}end\n")
    command = [
        sys.executable,
        "-m",
        "mtl_bench.report.readme",
        str(path),
        str(tmp_path / "reports"),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("error: no ")
    for name in "ab":
        (tmp_path / "reports" / name).mkdir(parents=True)
        (tmp_path / "reports" / name / "readme.md").write_text(f"table of {name}\n")
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "a: updated\nb: updated\n"
    text = path.read_text()
    assert (
        text.index("table of a") < text.index("(reports/a/index.html)") < text.index("table of b")
    )
    assert "old" not in text
    assert text.endswith("<!-- /results -->\nend\n")
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "a: as it was\nb: as it was\n"


def test_a_grid_chooses_its_pictures(tmp_path, monkeypatch):
    monkeypatch.setattr(readme, "GRIDS", tmp_path)
    (tmp_path / "mine.toml").write_text(
        '[report]\nrows = "name"\nreadme = ["samples", "pq_rmse"]\n'
    )
    report = tmp_path / "reports" / "mine"
    report.mkdir(parents=True)
    for name in ("readme.md", "samples.png", "pq_fps.png"):
        (report / name).touch()
    (tmp_path / "README.md").write_text("<!-- results:mine -->\n<!-- /results -->\n")
    text = readme.filled(tmp_path / "README.md", "mine", report)
    assert re.findall(r"!\[(.*)\]\((.*)\)", text) == [
        ("Sample predictions", "reports/mine/samples.png")
    ]
