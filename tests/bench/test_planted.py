"""End to end on `scales`: a planted method is found better, copies of equal weights are not."""

import pytest
from typer.testing import CliRunner

from mtl_bench.cli.app import app

COPIES = 20
COPY = '''"""Equal weights, moved at random by a tenth at every step."""

import torch

from mtl_bench.core.method import LossMethod


class Copy(LossMethod):
    def __init__(self, terms, seed=0):
        super().__init__(terms, seed + 1000 * NUMBER)

    def total(self, step):
        jitter_T = 1 + 0.1 * torch.randn(len(self.terms), generator=self.generator)
        return (jitter_T[step.present] * step.loss_K).sum()
'''
PLANTED = '''"""The losses' square roots: a real gain where scales differ."""

from mtl_bench.core.method import LossMethod


class Planted(LossMethod):
    def total(self, step):
        return (step.loss_K + 1e-8).sqrt().sum()
'''
GRID = """question = "Is what was planted found, and nothing else?"
recipe = "scales"

[axes]
backbone = ["mlp"]
method = [{methods}]
granularity = ["tasks"]
seed = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]

[baseline]
method = "fixed"
single_task = true

[tune]
trials = 2
seeds = [100]

[report]
rows = "method"
control = "fixed"
"""


@pytest.mark.slow
def test_a_planted_gain_is_found_and_copies_of_equal_weights_are_not(tmp_path, monkeypatch):
    monkeypatch.setenv("MTL_BENCH_PLUGINS", "")
    folder = tmp_path / "plugins" / "methods"
    folder.mkdir(parents=True)
    names = [f"copy_{chr(97 + number)}" for number in range(COPIES)]
    for number, name in enumerate(names):
        (folder / f"{name}.py").write_text(COPY.replace("NUMBER", str(number + 1)))
    (folder / "planted.py").write_text(PLANTED)
    methods = ", ".join(f'"{name}"' for name in ["fixed", "planted", *names])
    file = tmp_path / "planted.toml"
    file.write_text(GRID.format(methods=methods))
    told = ["--plugins", str(tmp_path / "plugins"), "--runs", str(tmp_path / "runs"), "--quiet"]
    # a tenth of the steps, so that it takes minutes: 286 runs and 120 of the baseline's
    told += ["--reports", str(tmp_path / "reports"), "--set", "recipe.optim.steps=60"]
    told += ["--set", "recipe.latency.passes=0"]
    result = CliRunner().invoke(app, ["ablate", "--grid", str(file), *told])
    assert result.exit_code == 0, result.output
    table = (tmp_path / "reports" / "planted" / "table.md").read_text()
    section = table[table.index("**Against fixed**") :].split("\n\n")[1]
    said = {line.split("|")[1].strip(): line for line in section.splitlines()}
    assert "| better |" in said["planted"].replace("**", "")
    assert not [name for name in names if "| better |" in said[name]]
