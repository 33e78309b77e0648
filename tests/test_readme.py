"""The README's examples are run, and its generated parts are the reference report's."""

import re
from pathlib import Path

import pytest

from mtl_bench.check import check

README = Path(__file__).resolve().parents[1] / "README.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)


@pytest.mark.parametrize(
    ("kind", "name", "marker"),
    [("methods", "scale_invariant", "LossMethod"), ("backbones", "resnet34", "TimmBackbone")],
)
def test_example_passes_the_checks(kind, name, marker, tmp_path, monkeypatch):
    (source,) = [example for example in EXAMPLES if marker in example]
    folder = tmp_path / kind
    folder.mkdir()
    (folder / f"{name}.py").write_text(source)
    monkeypatch.setenv("MTL_BENCH_PLUGINS", str(tmp_path))
    failed = [f"{r.name}: {r.detail}" for r in check(kind, name) if not r.ok]
    assert failed == []


def test_every_linked_file_exists():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README.read_text()):
        assert (README.parent / target).exists(), target


def test_the_results_are_the_reference_reports(tmp_path):
    report = README.parent / "reports" / "backbones"
    table = (report / "table.md").read_text(encoding="utf-8").rstrip("\n")
    section = re.search(
        r"<!-- results:backbones -->\n(.*?)<!-- /results -->", README.read_text("utf-8"), re.DOTALL
    )
    assert section is not None
    assert section[1].strip().startswith(table)
