# SPDX-License-Identifier: MIT
"""The script and the notebooks of the manual run from an empty folder; a user's script is typed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL)


def run(script, folder):
    done = subprocess.run(
        [sys.executable, script], cwd=folder, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_page_names_what_there_is():
    import sononerf

    for block in BLOCKS:
        compile(block, "docs/python.md", "exec")
    named = set(re.findall(r"\bsn\.(\w+)", "".join(BLOCKS)))
    assert len(named) > 10
    assert named - set(sononerf.__all__) == set()


@pytest.mark.slow
def test_the_script_of_the_page_runs(tmp_path):
    trimesh.creation.icosphere(subdivisions=4, radius=25.0).export(tmp_path / "mug.stl")
    script = BLOCKS[0].replace("sphere(400", "sphere(60").replace("max_epochs=20", "max_epochs=8")
    (tmp_path / "script.py").write_text(script)
    numbers = run("script.py", tmp_path)
    chamfer = re.search(r"chamfer_m +([\d.]+) mm", numbers)
    assert float(chamfer[1]) < 0.5
    assert (tmp_path / "mesh.ply").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook, tmp_path):
    shutil.copy(notebook, tmp_path)
    assert "mae_db" in run(notebook.name, tmp_path)


@pytest.mark.slow
@pytest.mark.thorough
def test_a_users_script_is_typed():
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "tests/typed_script.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout


def test_a_users_script_has_every_public_name():
    import sononerf

    script = (ROOT / "tests" / "typed_script.py").read_text()
    assert [name for name in sononerf.__all__ if f"sn.{name}" not in script] == []
