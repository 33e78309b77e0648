"""A helper beside a plug-in counts as the plug-in's code, however it is imported."""

import pytest

from mtl_bench.core import plugins, provenance
from mtl_bench.core.config import Cell, Recipe

METHOD = '''"""Mine: for a test."""
from mtl_bench.core.method import LossMethod
{top}

def run(module, step):
    return module.f(step)


class Mine(LossMethod):
    def total(self, step):
        {inside}
        return {use}
'''
HELPER = "def f(step):\n    return {} * step.loss_K.sum()\n"


@pytest.mark.parametrize(
    ("top", "inside", "use"),
    [
        ("from . import _h", "", "_h.f(step)"),
        ("from . import _h as other", "", "other.f(step)"),
        ("from . import _h", "", "run(_h, step)"),
        ("from ._h import f", "", "f(step)"),
        ("from ._h import *", "", "f(step)"),
        ("", "from ._h import f", "f(step)"),
        ("", "from . import _h", "_h.f(step)"),
    ],
)
def test_an_edited_helper_makes_rows_stale_and_is_loaded_anew(
    tmp_path, monkeypatch, top, inside, use
):
    monkeypatch.setenv(plugins.VARIABLE, str(tmp_path))
    folder = tmp_path / "methods"
    folder.mkdir()
    (folder / "mine.py").write_text(METHOD.format(top=top, inside=inside, use=use))
    cell, seen = Cell(Recipe(), "tiny", "mine"), []
    for factor in (1, 22):
        (folder / "_h.py").write_text(HELPER.format(factor))
        row = provenance.code(cell)["train"]["method"]
        seen.append((row, plugins.fingerprint("methods", "mine")))
    assert seen[0][0] != seen[1][0]
    assert seen[0][1] != seen[1][1]
