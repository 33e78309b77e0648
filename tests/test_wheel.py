"""The wheel works from an empty directory, with its own copy of the plug-ins."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


def call(*arguments, **options) -> str:
    words = [str(argument) for argument in arguments]
    done = subprocess.run(words, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A fresh environment with the wheel; third-party packages are borrowed from this one."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder]
    call(*build, REPOSITORY)
    environment = folder / "environment"
    call(sys.executable, "-m", "venv", "--without-pip", environment)
    python = environment / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    pip = [sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check"]
    call(*pip, "install", "--quiet", "--no-deps", "--no-index", wheel)
    site = Path(
        call(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    )
    # A path that a .pth file names is not searched for .pth files: the editable install stays out.
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return environment


def test_the_wheel_lists_its_own_plugins_from_anywhere(installed, tmp_path):
    clean = {key: value for key, value in os.environ.items() if not key.startswith("MTL_BENCH")}
    text = call(installed / "bin" / "mtl-bench", "list", cwd=tmp_path, env=clean)
    for name in ("fixed_uncertainty", "efficientnet_lite0", "small", "backbones"):
        assert name in text
    where = "import mtl_bench.core.plugins as p; print(p.path_of('methods', 'fixed'))"
    path = call(installed / "bin" / "python", "-c", where, cwd=tmp_path, env=clean).strip()
    assert path.startswith(str(installed))
    assert "_shipped" in path


def test_nothing_called_methods_lands_in_site_packages(installed):
    (site,) = installed.glob("lib/python*/site-packages")
    assert not (site / "methods").exists()
    assert not (site / "backbones").exists()
    assert (site / "mtl_bench" / "bench" / "recipes" / "small.toml").is_file()
    assert (site / "mtl_bench" / "report" / "page.html.j2").is_file()
    assert (site / "mtl_bench" / "figures" / "cloud.html.j2").is_file()
