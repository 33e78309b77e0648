"""Every file in methods/ and backbones/ passes the checks that come with being there."""

import pytest

from mtl_bench import plugins
from mtl_bench.check import check

PLUGINS = [(kind, name) for kind in plugins.KINDS for name in plugins.files(kind)]


@pytest.mark.parametrize(
    ("kind", "name"), PLUGINS, ids=[f"{kind}-{name}" for kind, name in PLUGINS]
)
def test_plugin(kind, name):
    failed = [f"{result.name}: {result.detail}" for result in check(kind, name) if not result.ok]
    assert failed == []


BROKEN = '''"""A method that is wrong.

Source: nobody.
"""
import torch
from mtl_bench.method import LossMethod


class Broken(LossMethod):
    def __init__(self, terms, seed=0):
        super().__init__(terms, seed)
        self.count = 0

    def total(self, loss_T):
        self.count += 1
        {line}
'''


@pytest.mark.parametrize(
    ("line", "caught"),
    [
        ("return -loss_T.sum()", "learns"),
        ("return (loss_T / (loss_T - loss_T[0])).sum()", "finite on hard inputs"),
        ("return loss_T.sum() * self.count", "state round trip"),
        ("return (loss_T * torch.rand(len(loss_T))).sum()", "same seed, same update"),
    ],
)
def test_a_wrong_method_is_caught(tmp_path, monkeypatch, line, caught):
    (tmp_path / "broken_one.py").write_text(BROKEN.format(line=line))
    monkeypatch.setenv("MTL_BENCH_PLUGINS", str(tmp_path))
    failed = [result.name for result in check("methods", "broken_one") if not result.ok]
    assert caught in failed
