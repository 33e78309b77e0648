"""The program as a person runs it wrongly: one line, an exit code, and nothing lost."""

import pytest
from support.program import MINE, mtl_bench, user_folder


def test_failed_cell_costs_its_row_only(tmp_path, smoke_root):
    place = user_folder(tmp_path)
    (place / "fails").mkdir()
    (place / "fails" / "mine.py").write_text(MINE.replace(".sum()", ".sum() * float('nan')"))
    words = ["ablate", "--grid", "grid.toml", "--plugins", "fails", "--data", smoke_root]
    done = mtl_bench(*words, "--runs", "half", "--reports", "reports-half", cwd=place)
    assert done.returncode == 1, done.stdout + done.stderr
    (failed,) = (place / "half").glob("*/failed.json")
    assert failed.parent.name.startswith("mine-")
    (done_row,) = (place / "half").glob("*/row.json")
    assert done_row.parent.name.startswith("fixed-")
    (report,) = (place / "reports-half").iterdir()
    assert "failed" in (report / "table.md").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "--backbone", "tinny", "--method", "fixed"], "did you mean 'tiny'"),
        (["train", "--backbone", "tiny", "--method", "fixd"], "did you mean 'fixed'"),
        (["train", "--backbone", "tiny", "--method", "fixed", "--recipe", "smal"], "'small'"),
        (["ablate", "--grid", "backbone"], "did you mean 'backbones'"),
        (["ablate", "--grid", "backbones", "--data", "nowhere"], "nowhere"),
        (["data", "check", "nowhere"], "nowhere"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(words, message, tmp_path):
    done = mtl_bench(*words, cwd=tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.glob("runs/*/row.json"))
