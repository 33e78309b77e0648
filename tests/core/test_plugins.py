import itertools
import os
import subprocess
import sys
from dataclasses import replace

import pytest

from mtl_bench.core import plugins, provenance, quality
from mtl_bench.core.config import Cell, Recipe, check_cells, load_recipe
from mtl_bench.core.dataset import dataset_of
from mtl_bench.core.task import tasks_of_cell, terms_of

METHOD = '''"""Doubles everything.

Source: a test.
"""

from mtl_bench.core.method import LossMethod


class Mine(LossMethod):
    def __init__(self, terms, seed=0, factor=2.0):
        super().__init__(terms, seed)
        self.factor = factor

    def total(self, step):
        return self.factor * step.loss_K.sum()
'''


@pytest.fixture(autouse=True)
def isolated(tmp_path, monkeypatch):
    """An empty working directory, and no plug-in folders but the package's own."""
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.chdir(tmp_path)


def put(path, text=METHOD):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def described(name, kind="methods"):
    return next(d for d in plugins.describe(kind) if d.name == name)


def test_the_checkout_is_searched_first_and_not_a_copy_in_site_packages():
    checkout = plugins.PACKAGE.parent
    assert plugins.folders("methods")[0] == checkout / "methods"
    assert plugins.folders("backbones")[0] == checkout / "backbones"
    assert plugins.path_of("methods", "fixed") == checkout / "methods" / "fixed.py"


def test_an_installed_wheel_has_its_own_folders(tmp_path, monkeypatch):
    package = tmp_path / "site-packages" / "mtl_bench"
    put(package / "_shipped" / "methods" / "only.py")
    put(tmp_path / "site-packages" / "methods" / "stranger.py")
    monkeypatch.setattr(plugins, "PACKAGE", package)
    assert list(plugins.files("methods")) == ["only"]


def test_every_file_of_the_checkout_is_described_and_loads():
    for kind in plugins.KINDS:
        found = plugins.describe(kind)
        assert found
        for d in found:
            assert d.error is None, (d.name, d.error)
            assert len(d.summary) > 10
            assert plugins.load(kind, d.name).__module__.endswith(f".{d.name}")


def test_working_directory(tmp_path):
    put(tmp_path / "methods" / "mine.py")
    assert described("mine").summary == "Doubles everything."
    assert plugins.load("methods", "mine").__name__ == "Mine"
    assert plugins.arguments("methods", "mine")["factor"].default == 2.0
    assert "mine" not in plugins.files("backbones")


@pytest.mark.parametrize("place", ["extra/methods/mine.py", "extra/mine.py"])
@pytest.mark.parametrize("given", ["extra", "extra/", "./extra"])
def test_added_folder(tmp_path, place, given):
    put(tmp_path / place)
    plugins.add_folder(given)
    assert plugins.files("methods")["mine"] == tmp_path / place
    assert "mine" not in plugins.files("backbones")
    assert plugins.load("methods", "mine").__name__ == "Mine"


def test_added_file_and_kind_by_import(tmp_path):
    text = "from mtl_bench.core.backbone import Backbone\n\nclass Net(Backbone): ...\n"
    plugins.add_folder(put(tmp_path / "odd" / "net.py", text))
    assert plugins.kinds_of("net") == ["backbones"]
    put(tmp_path / "odd" / "notes.py", "x = 1\n")
    plugins.add_folder(tmp_path / "odd")
    assert plugins.kinds_of("notes") == []


def test_a_folder_reached_twice_counts_once(tmp_path):
    path = put(tmp_path / "methods" / "mine.py")
    plugins.add_folder(tmp_path)
    plugins.add_folder(tmp_path / "methods")
    plugins.add_folder(path)
    (tmp_path / "link").symlink_to(tmp_path / "methods")
    plugins.add_folder(tmp_path / "link")
    assert plugins.path_of("methods", "mine") == path


def test_one_name_in_two_folders_names_both_when_chosen(tmp_path):
    here = put(tmp_path / "methods" / "mine.py")
    there = put(tmp_path / "extra" / "methods" / "mine.py")
    plugins.add_folder("extra")
    assert str(here) in described("mine").error
    with pytest.raises(ValueError, match="two methods are called 'mine'") as caught:
        plugins.load("methods", "mine")
    assert str(here) in str(caught.value)
    assert str(there) in str(caught.value)
    plugins.load("methods", "fixed")  # hurts nobody else


def test_unknown_name():
    with pytest.raises(ValueError, match=r"'fixd' \(did you mean 'fixed'\?\).*methods/fixd.py"):
        plugins.path_of("methods", "fixd")
    with pytest.raises(ValueError, match="no plug-in folder"):
        plugins.add_folder("nowhere")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("def (:\n", "SyntaxError"),
        ("x = 1\n", "defines no class"),
        ("import not_installed_xyz\n\nclass A: ...\n", "needs not_installed_xyz"),
    ],
)
def test_a_broken_file_is_listed_as_broken(tmp_path, text, why):
    put(tmp_path / "methods" / "broken.py", text)
    assert why in described("broken").error
    assert described("fixed").error is None


def test_impossible_name_is_listed_as_broken(tmp_path):
    put(tmp_path / "methods" / "No-name.py")
    assert "is no name" in described("No-name").error


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("def (:\n", "SyntaxError"),
        ("\n1 / 0\n", "line 2: ZeroDivisionError"),
        ("import not_installed_xyz\n", "No module named 'not_installed_xyz'"),
        ("class A: ...\n", "must define one subclass of Method, and defines none"),
        (METHOD + "\n\nclass Two(Mine): ...\n", "one subclass of Method, and defines Mine, Two"),
        ("from mtl_bench.core.method import LossMethod\n", "defines none"),
    ],
)
def test_a_broken_file_says_why_when_chosen(tmp_path, text, why):
    put(tmp_path / "methods" / "broken.py", text)
    with pytest.raises(ValueError, match=why):
        plugins.load("methods", "broken")


def test_helpers_belong_to_their_folder(tmp_path):
    """Two folders may each have a `_common.py`; neither is a plug-in."""
    for folder, value in (("one", 1), ("two", 2)):
        put(tmp_path / folder / "methods" / "_common.py", f"VALUE = {value}\n")
        text = METHOD.replace("class Mine", "from ._common import VALUE\n\n\nclass Mine")
        text = text.replace("    def __init__", "    value = VALUE\n\n    def __init__")
        put(tmp_path / folder / "methods" / f"mine_{folder}.py", text)
        plugins.add_folder(folder)
    assert plugins.load("methods", "mine_one").value == 1
    assert plugins.load("methods", "mine_two").value == 2
    assert "_common" not in plugins.files("methods")


def test_fingerprint_covers_the_file_and_the_helpers_that_it_imports(tmp_path):
    path = put(tmp_path / "methods" / "mine.py")
    helper = put(tmp_path / "methods" / "_common.py", "x = 1\n")
    below = put(tmp_path / "methods" / "_below.py", "y = 1\n")
    before = plugins.fingerprint("methods", "mine")
    assert len(before) == 12
    put(tmp_path / "methods" / "neighbour.py")
    helper.write_text("x = 2\n")
    assert plugins.fingerprint("methods", "mine") == before  # it imports neither
    path.write_text("from ._common import x\n" + METHOD)
    importing = plugins.fingerprint("methods", "mine")
    helper.write_text("from ._below import y\nx = 3\n")
    changed = plugins.fingerprint("methods", "mine")
    below.write_text("y = 2\n")
    assert len({before, importing, changed, plugins.fingerprint("methods", "mine")}) == 4


def test_a_composition_is_both_files(tmp_path):
    assert plugins.part_names("mine") == ["mine"]
    first = put(tmp_path / "methods" / "first.py")
    second = put(tmp_path / "methods" / "second.py")
    prints = [plugins.fingerprint("methods", "first+second")]
    for path in (first, second):
        path.write_text(METHOD + "# a change\n")
        prints.append(plugins.fingerprint("methods", "first+second"))
    assert len(set(prints)) == 3
    cell = Cell(Recipe(), "tiny", "first+second", method_args={"second": {"factor": 1.0}})
    check_cells([cell])
    for values, message in (
        ({"third": {}}, "has no part 'third'"),
        ({"second": {"factr": 1.0}}, "did you mean 'factor'"),
    ):
        with pytest.raises(ValueError, match=message):
            check_cells([replace(cell, method_args=values)])


def test_an_edited_file_is_loaded_anew(tmp_path):
    put(tmp_path / "methods" / "mine.py")
    first = plugins.load("methods", "mine")
    assert plugins.load("methods", "mine") is first
    put(tmp_path / "methods" / "mine.py", METHOD.replace("factor=2.0", "factor=30.0"))
    assert plugins.arguments("methods", "mine")["factor"].default == 30.0


def test_hyper_parameters_are_checked_against_the_constructor(tmp_path):
    put(tmp_path / "methods" / "mine.py")
    good = Cell(Recipe(), "tiny", "mine", method_args={"factor": 3.0})
    check_cells([good])
    with pytest.raises(ValueError, match=r"method 'mine' has no 'facto' \(did you mean 'factor'"):
        check_cells([Cell(Recipe(), "tiny", "mine", method_args={"facto": 3.0})])
    with pytest.raises(ValueError, match="method 'mine' has no 'seed'"):
        check_cells([Cell(Recipe(), "tiny", "mine", method_args={"seed": 3})])
    with pytest.raises(ValueError, match="no backbone called 'tny'"):
        check_cells([Cell(Recipe(), "tny", "mine")])


def test_children_find_added_folders_and_describing_imports_nothing(tmp_path):
    put(tmp_path / "extra" / "methods" / "mine.py")
    plugins.add_folder("extra")
    code = (
        "import sys; from mtl_bench.core import plugins\n"
        "names = [d.name for kind in plugins.KINDS for d in plugins.describe(kind)]\n"
        "assert 'mine' in names and not {'torch', 'timm'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/", env=os.environ)


# --- tasks, which are read as text ----------------------------------------------------------------

TASK = '''"""Where surfaces face.

Source: a test.
"""

from mtl_bench.core.columns import Column
from mtl_bench.core.task import Task
from mtl_bench.core.terms import Term


class Normals(Task):
    terms = (Term("angle", "slopes", "regression", 1.0),)
    after = ("depth",)
    columns = (Column(*("angle", "slopes.angle", "Angle", -1, 1), unit="deg", headline=True),)
'''


def test_a_further_task_changes_no_cell_that_does_not_name_it(tmp_path):
    cells = [Cell(load_recipe(name), "tiny", "fixed") for name in ("smoke", "kitti", "medium")]
    before = [(cell.id, provenance.code(cell), cell.tasks) for cell in cells]
    terms = [term.name for term in terms_of(tasks_of_cell(cells[0]))]
    put(tmp_path / "extra" / "tasks" / "slopes.py", TASK)
    plugins.add_folder("extra")
    assert "slopes" in plugins.files("tasks")
    again = [Cell(load_recipe(name), "tiny", "fixed") for name in ("smoke", "kitti", "medium")]
    assert [(cell.id, provenance.code(cell), cell.tasks) for cell in again] == before
    assert [term.name for term in terms_of(tasks_of_cell(again[0]))] == terms
    three = replace(cells[0], tasks=("slopes", "depth", "panoptic"))
    check_cells([three])
    assert three.id != cells[0].id
    names = [task.name for task in tasks_of_cell(three)]
    assert names == ["panoptic", "depth", "slopes"]
    assert set(provenance.code(three)["train"]) == {
        *("method", "backbone", "harness", "tasks/slopes.py")
    }
    assert dataset_of(three.recipe).name == "synthetic"


def test_tasks_stand_behind_those_whose_results_they_read(tmp_path):
    for name, after in (("aaa", ("zzz", "absent")), ("mmm", ()), ("zzz", ("mmm",))):
        put(tmp_path / "tasks" / f"{name}.py", TASK.replace('("depth",)', repr(after)))
    assert plugins.ordered(["zzz", "aaa", "mmm"]) == ["mmm", "zzz", "aaa"]
    assert plugins.ordered(["aaa", "mmm"]) == ["aaa", "mmm"]  # what is not there is not waited for
    assert plugins.ordered(["depth", "panoptic"]) == ["panoptic", "depth"]
    assert plugins.ordered([]) == []
    with pytest.raises(ValueError, match=r"no task called 'dept' \(did you mean 'depth'\?\)"):
        plugins.ordered(["dept"])
    put(tmp_path / "tasks" / "mmm.py", TASK.replace('("depth",)', "('aaa',)"))
    with pytest.raises(ValueError, match=r"tasks wait for each other: .*mmm"):
        plugins.ordered(["aaa", "mmm", "zzz"])


def test_columns_are_read_without_running_a_task(tmp_path):
    shipped = quality.quality()
    put(tmp_path / "tasks" / "slopes.py", TASK + "\nraise RuntimeError('was run')\n")
    found = quality.quality()
    assert found[: len(shipped)] == shipped
    (angle,) = found[len(shipped) :]
    assert (angle.name, angle.key, angle.better, angle.digits) == ("angle", "slopes.angle", -1, 1)
    assert (angle.task, angle.unit, angle.headline) == ("slopes", "deg", True)
    in_order = [task for task, _ in itertools.groupby(column.task for column in shipped)]
    assert len(in_order) == len(set(in_order))  # each task's stand together
    assert in_order[:2] == ["panoptic", "depth"]
    headlines = [column.name for column in quality.in_brief() if column.headline]
    assert [*headlines[:2], headlines[-1]] == ["pq", "rmse", "angle"]
    put(tmp_path / "tasks" / "broken.py", "def (:")  # hurts nobody else
    assert quality.quality() == found


@pytest.mark.parametrize(
    "columns",
    ["(Column(open('x')),)", "(other(),)", "[Column(*MORE)]", "tuple(Column() for _ in 'ab')"],
)
def test_columns_are_nothing_but_values(tmp_path, columns):
    put(
        tmp_path / "tasks" / "slopes.py",
        TASK.partition("    columns")[0] + f"    columns = {columns}\n",
    )
    with pytest.raises(ValueError, match=r"task 'slopes': columns are plain values and Column"):
        quality.quality()
