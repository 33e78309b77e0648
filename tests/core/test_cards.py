"""Cards are read from text, agree with the classes, and are what methods/README.md holds."""

import ast
import inspect
import os
import statistics
import subprocess
import sys
from pathlib import Path

import pytest
from support.terms import TERMS
from typer.testing import CliRunner

from mtl_bench.cli.app import app
from mtl_bench.core import cards, plugins
from mtl_bench.core.declared import GIVEN

FOLDER = Path(__file__).resolve().parents[2] / "methods"
SHIPPED = sorted(FOLDER.glob("[!_]*.py"))


@pytest.fixture(autouse=True)
def isolated(tmp_path, monkeypatch):
    """An empty working directory, and no methods but the shipped ones."""
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.chdir(tmp_path)


def card_of(path, text):
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return next(card for card in cards.cards() if card.about.name == path.stem)


def listed(*words):
    result = CliRunner().invoke(app, ["list", *words])
    assert result.exit_code == 0, result.output
    return result.output


# --- every shipped method -------------------------------------------------------------------------


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_source_and_size(path):
    (card,) = [card for card in cards.cards() if card.about.path == path]
    assert "\n\nSource: " in (ast.get_docstring(ast.parse(path.read_text())) or "")
    assert card.venue, "no venue and year in the paragraph 'Source:', as in 'ICML 2018'"
    assert 1990 < int(card.year) < 2100
    assert len(path.read_text().splitlines()) <= 120


def test_the_median_file_is_short():
    sizes = [len(path.read_text().splitlines()) for path in SHIPPED]
    assert statistics.median(sizes) <= 60


@pytest.mark.parametrize("name", [path.stem for path in SHIPPED])
def test_cards_say_what_the_classes_are(name):
    from mtl_bench.core.method import Composed, GradientMethod, LookAheadMethod, LossMethod

    (card,) = [card for card in cards.cards() if card.about.name == name]
    kind = plugins.load("methods", name)
    method = kind(TERMS)
    assert card.needs == method.needs
    gradient = method.gradient if isinstance(method, Composed) else method
    if isinstance(gradient, GradientMethod):
        assert card.cost.startswith(f"{method.batches}F + ")
        weighted = gradient.weighted_heads or gradient is not method
        assert ("weighted decoders" in card.extras) == weighted
    else:
        assert isinstance(method, LossMethod)
        assert card.cost == ("2F + 1B" if method.reevaluates else "1F + 1B")
    assert ("the losses after the step" in card.extras) == method.reevaluates
    ahead = "the gradients of a second batch ahead"
    assert (ahead in card.extras) == isinstance(method, LookAheadMethod)
    if method.batches > 1 and ahead not in card.extras:
        assert f"{method.batches} batches" in card.extras
    constructor = inspect.signature(type(method).__init__).parameters
    assert list(card.settings) == [key for key in constructor if key not in GIVEN]


def test_the_readme_is_what_the_command_prints():
    """After a change: mtl-bench list methods --markdown > methods/README.md"""
    page = listed("methods", "--markdown")
    assert (FOLDER / "README.md").read_text() == page
    for path in SHIPPED:
        assert f"[{path.stem}]({path.name})" in page
        assert f"### {path.stem}\n" in page


# --- other people's methods -----------------------------------------------------------------------

MINE = '''"""Mine: does it.

Source: Doe, A Paper of 1066 Words,
ICML 2031, arXiv:3101.00001, and not NeurIPS 2032.
"""

from mtl_bench.core import method
from mtl_bench.core.method import CrossMethod, GradientMethod, LossMethod
{imports}

class Mine({base}):
    """w = |a| | b

    more of it

    Args:
        rate: of it.
    """

    {body}

    def __init__(self, terms, seed=0, rate: float = 1e-3, *, kind="x"):
        super().__init__(terms, seed)
'''


def mine(base, body="x = 1", imports=""):
    return MINE.format(base=base, body=body, imports=imports)


def test_source_formula_and_settings(tmp_path):
    card = card_of(tmp_path / "methods" / "mine.py", mine("method.LossMethod"))
    assert (card.venue, card.year) == ("ICML", "2031")
    assert card.url == "https://arxiv.org/abs/3101.00001"
    assert card.formula == "w = |a| | b\n\nmore of it"
    assert card.settings == {"rate": "0.001", "kind": "'x'"}


@pytest.mark.parametrize(
    ("base", "body", "needs", "cost", "extras"),
    [
        ("method.LossMethod", "x = 1", "losses", "1F + 1B", ()),
        ("LossMethod", "reevaluates = True", "losses", "2F + 1B", ("the losses after the step",)),
        ("GradientMethod", "x = 1", "gramian", "1F + K(H + T)", ()),
        ("CrossMethod", "x = 1", "gramian", "3F + 2K(H + T) + KH + 1T", ("3 batches",)),
        ("GradientMethod", "needs = 'representation'", "representation", "1F + KH + 1T", ()),
        (
            "GradientMethod",
            "weighted_heads = True",
            "gramian",
            "1F + K(H + T)",
            ("weighted decoders",),
        ),
        (
            "GradientMethod",
            "needs = 'jacobian'",
            "jacobian",
            "1F + K(H + T)",
            (),
        ),
        (
            "method.LookAheadMethod",
            "x = 1",
            "jacobian",
            "2F + 2K(H + T)",
            ("the gradients of a second batch ahead",),
        ),
    ],
)
def test_needs_and_cost(tmp_path, base, body, needs, cost, extras):
    card = card_of(tmp_path / "methods" / "mine.py", mine(base, body))
    assert (card.needs, card.cost, card.extras) == (needs, cost, extras)


def test_what_a_helper_beside_it_declares_counts(tmp_path):
    (tmp_path / "methods").mkdir()
    helper = "from mtl_bench.core.method import GradientMethod\n"
    helper += "class Base(GradientMethod):\n    batches = 2\n    needs = 'representation'\n"
    (tmp_path / "methods" / "_base.py").write_text(helper)
    text = mine("Base", imports="from ._base import Base\n")
    card = card_of(tmp_path / "methods" / "mine.py", text)
    assert (card.needs, card.cost) == ("representation", "2F + 2KH + 2T")
    text = mine("Base", "batches = 1", "from ._base import Base\n")
    assert card_of(tmp_path / "methods" / "mine.py", text).cost == "1F + KH + 1T"


def test_a_method_without_a_source_has_none(tmp_path):
    text = mine("LossMethod").replace("Source:", "Idea:")
    card = card_of(tmp_path / "methods" / "mine.py", text)
    assert (card.venue, card.year, card.url, card.needs) == ("", "", "", "losses")


@pytest.mark.parametrize(
    ("source", "url"),
    [
        ("see https://example.org/a.pdf, ICML 2031.", "https://example.org/a.pdf"),
        ("ICLR 2031, openreview.net/forum?id=X_y.", "https://openreview.net/forum?id=X_y"),
        ("no address, i.e. nothing w/o it.", ""),
    ],
)
def test_address(tmp_path, source, url):
    text = mine("LossMethod").replace("arXiv:3101.00001", "").replace("Doe", source)
    assert card_of(tmp_path / "methods" / "mine.py", text).url == url


def test_a_class_that_is_no_method_or_is_its_own_base_has_an_empty_card(tmp_path):
    for base in ("nn.Module", "Mine"):
        card = card_of(tmp_path / "methods" / "mine.py", mine(base))
        assert (card.needs, card.cost, card.about.error) == ("", "", None)


# --- the list -------------------------------------------------------------------------------------


def test_the_columns_line_up_and_a_broken_file_stays_a_line(tmp_path):
    card_of(tmp_path / "methods" / "mine.py", mine("LossMethod"))
    (tmp_path / "methods" / "odd.py").write_text("def (:\n")
    lines = listed("methods").splitlines()
    head = lines[0]
    for name in ("mine", *(path.stem for path in SHIPPED)):
        (line,) = [line for line in lines if line.split()[0] == name]
        assert len(line) > head.index("cost")
        for column in ("year", "venue", "needs", "cost"):
            assert line[head.index(column) - 1] == " "
            assert line[head.index(column)] != " "
    (line,) = [line for line in lines if line.split()[0] == "odd"]
    assert "BROKEN: SyntaxError" in line
    assert "| BROKEN: SyntaxError" in listed("methods", "--markdown")
    assert "Mine: does it." in listed("methods")


def test_verbose_has_the_whole_docstring_and_the_file(tmp_path):
    card_of(tmp_path / "methods" / "mine.py", mine("LossMethod", "reevaluates = True"))
    text = listed("methods", "-v")
    for part in (
        f"mine  ({tmp_path / 'methods' / 'mine.py'})",
        "ICML 2031 https://arxiv.org/abs/3101.00001",
        "needs losses, the losses after the step; cost 2F + 1B",
        "rate=0.001, kind='x'",
        "Source: Doe, A Paper of 1066 Words,",
    ):
        assert part in text


def test_a_page_escapes_bars_and_links_to_files_elsewhere(tmp_path):
    text = mine("LossMethod").replace("does it", "|g| counts")
    card_of(tmp_path / "methods" / "mine.py", text)
    page = listed("methods", "--markdown")
    (row,) = [line for line in page.splitlines() if line.startswith("| [mine]")]
    assert r"\|g\| counts" in row
    target = row.partition("](")[2].partition(")")[0]
    assert (FOLDER / target).resolve() == tmp_path / "methods" / "mine.py"


def test_only_methods_have_a_page():
    result = CliRunner().invoke(app, ["list", "backbones", "--markdown"])
    assert result.exit_code == 2
    assert "mtl-bench list methods --markdown" in result.output


# --- the benchmark --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("granularity", ["tasks", "terms"])
def test_the_cost_benchmark_runs(granularity):
    names = ["famo", "uncertainty", "modo", "upgrad", "mgda_ub"]
    done = subprocess.run(
        [
            *(sys.executable, FOLDER.parent / "benchmarks" / "methods_cost.py", "--quick"),
            *("--granularity", granularity, "--device", "cpu", *names),
        ],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    rows = [line.split(" | ") for line in done.stdout.splitlines() if line.startswith("| ")]
    assert [row[0].removeprefix("| ") for row in rows[2:]] == names[:2] + names[2:]
