"""Every file in methods/, backbones/ and engines/ passes the checks that come with being there."""

import pytest

from mtl_bench.bench.check import check
from mtl_bench.core import plugins

SLOW = [("engines", "compile")]  # a compiler's run for every precision
PLUGINS = [
    pytest.param(kind, name, id=f"{kind}-{name}", marks=[pytest.mark.slow] * ((kind, name) in SLOW))
    for kind in plugins.KINDS
    for name in plugins.files(kind)
]


@pytest.mark.parametrize(("kind", "name"), PLUGINS)
def test_plugin(kind, name):
    failed = [f"{result.name}: {result.detail}" for result in check(kind, name) if not result.ok]
    assert failed == []


BROKEN = '''"""A method that is wrong.

Source: nobody.
"""
import torch
from mtl_bench.core.method import LossMethod


class Broken(LossMethod):
    def __init__(self, terms, seed=0):
        super().__init__(terms, seed)
        self.count = 0

    def total(self, step):
        loss_K = step.loss_K
        self.count += 1
        {line}
'''

BROKEN_GRADIENT = '''"""A gradient method that is wrong.

Source: nobody.
"""
import torch
from mtl_bench.core.method import GradientMethod


class Broken(GradientMethod):
    def weights(self, G_KK, step):
        loss_K = step.loss_K
        {line}
'''


def failed_checks(tmp_path, monkeypatch, text):
    (tmp_path / "broken_one.py").write_text(text)
    monkeypatch.setenv("MTL_BENCH_PLUGINS", str(tmp_path))
    return [result.name for result in check("methods", "broken_one") if not result.ok]


@pytest.mark.parametrize(
    ("line", "caught"),
    [
        ("return -loss_K.sum()", "learns"),
        ("return (loss_K / (loss_K - loss_K[0])).sum()", "finite on hard inputs"),
        ("return loss_K.sum() * self.count", "state round trip"),
        ("return (loss_K * torch.rand(len(loss_K))).sum()", "same seed, same update"),
        ("return 9 * loss_K[0] + loss_K.sum()", "order of losses"),
        ("return (self.fixed_T * loss_K).sum()", "missing labels"),
    ],
)
def test_a_wrong_method_is_caught(tmp_path, monkeypatch, line, caught):
    assert caught in failed_checks(tmp_path, monkeypatch, BROKEN.format(line=line))


@pytest.mark.parametrize(
    ("line", "caught"),
    [
        ("return -torch.ones_like(loss_K)", "one loss is plain training"),
        ("return -torch.ones_like(loss_K)", "learns"),
        ("return 1 / G_KK.diagonal()", "finite on hard inputs"),
        ("return torch.rand_like(loss_K)", "same seed, same update"),
        ("return torch.arange(len(loss_K)) + 1.0", "order of losses"),
        ("return self.fixed_T.double()", "missing labels"),
        ("G_KK.zero_(); return torch.ones_like(loss_K)", "finite on hard inputs"),
    ],
)
def test_a_wrong_gradient_method_is_caught(tmp_path, monkeypatch, line, caught):
    assert caught in failed_checks(tmp_path, monkeypatch, BROKEN_GRADIENT.format(line=line))


def test_a_space_of_what_the_constructor_does_not_take_is_caught(tmp_path, monkeypatch):
    text = BROKEN.replace("(LossMethod):", "(LossMethod):\n    space = {space}")
    text = text.replace("seed=0):", "seed=0, pace=1.0):")
    spaces = (("pace", False), ("rate", True), ("seed", True))  # a seed is not for trials to choose
    for key, caught in spaces:
        space = f"{{'{key}': [1, 2]}}"
        failed = failed_checks(
            tmp_path, monkeypatch, text.format(space=space, line="return loss_K.sum()")
        )
        assert ("space of hyper-parameters" in failed) == caught
