# SPDX-License-Identifier: MIT
"""Source distribution and wheel: each runs from an environment that holds nothing else of ours."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHORT = (
    *("poses.count=20", "fit.epochs=1", "fit.steps_per_epoch=20"),
    *("reconstruction.method=levels", "reconstruction.refine=false"),  # needs the network's weights
)


@pytest.mark.slow  # a minute each
@pytest.mark.parametrize("kind", ["sdist", "wheel"])
def test_a_distribution_runs_from_an_empty_environment(kind, tmp_path):
    drop = shutil.ignore_patterns(".*", "runs", "data", "_build", "__pycache__", "*.egg-info")
    shutil.copytree(ROOT, tmp_path / "project", ignore=drop)
    build = f"from setuptools import build_meta; build_meta.build_{kind}('../dist')"
    subprocess.run([sys.executable, "-c", build], cwd=tmp_path / "project", check=True)
    venv.create(tmp_path / "env", with_pip=True)
    binaries, (site,) = tmp_path / "env" / "bin", (tmp_path / "env").glob("lib/python*/*-packages")
    # Packages of others are those of the tests; an editable install of ours is not followed.
    (site / "others.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    (built,) = (tmp_path / "dist").iterdir()
    wheel = ("wheel", "--no-deps", "--no-index", "--no-build-isolation", "-w", "wheels", str(built))
    subprocess.run([sys.executable, "-m", "pip", *wheel], cwd=tmp_path, check=True)
    (built,) = (tmp_path / "wheels").iterdir()
    install = [binaries / "python", "-m", "pip", "install", "--no-deps", "--no-index", str(built)]
    subprocess.run(install, cwd=tmp_path, check=True)
    fit = [binaries / "sononerf", "fit", "three_spheres", *SHORT, "--output", "run"]
    subprocess.run(fit, cwd=tmp_path, check=True)
    assert (tmp_path / "run" / "reconstruction" / "mesh.ply").is_file()
    where = [binaries / "python", "-c", "import sononerf; print(sononerf.__file__)"]
    done = subprocess.run(where, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(str(site))
