# SPDX-License-Identifier: MIT
"""The manual builds; its scripts, notebooks and tutorial run from an empty folder."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
import typer

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL)


TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")


def run(script, folder):
    done = subprocess.run(
        [sys.executable, script], cwd=folder, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Pages of the manual as HTML."""
    target = tmp_path_factory.mktemp("manual")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-E"]
    done = subprocess.run(
        [*command, ROOT / "docs", target], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return target


@pytest.mark.slow
def test_the_manual_builds_without_warnings_and_loads_nothing_from_the_network(built):
    pages = sorted(built.rglob("*.html"))
    assert len(pages) > 25
    loaded = (
        r"<(?:script|img|iframe|source)[^>]*src=[\"'](?:https?:)?//|<link[^>]*stylesheet[^>]*//"
    )
    for page in pages:
        assert not re.search(loaded, page.read_text(encoding="utf-8")), page


@pytest.mark.slow
def test_the_manual_states_every_command_setting_and_public_name(built):
    import sononerf
    from sononerf.cli.app import complete
    from sononerf.settings.schema import Settings

    commands = (built / "commands.html").read_text(encoding="utf-8")
    for name in typer.main.get_command(complete()).commands:
        assert f">sononerf {name}<" in re.sub(r"</?(code|span)[^>]*>", "", commands)
    settings = (built / "settings.html").read_text(encoding="utf-8")
    for name in Settings.model_fields:
        assert f'id="{name}"' in settings
    names = (built / "api.html").read_text(encoding="utf-8")
    for name in set(sononerf.__all__) - {"__version__"}:
        assert f'id="sononerf.{name}"' in names


def test_links_of_the_readme_lead_to_files():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert len(links) > 10
    for link in links:
        assert (ROOT / link.partition("#")[0]).exists(), link


@pytest.mark.slow
def test_the_tutorial_runs(tmp_path):
    """Every command of the tutorial, as it stands, in an empty folder."""
    files = re.findall(r"```yaml\n# (\S+)\n(.*?)```", TUTORIAL, re.DOTALL)
    for name, content in files:
        (tmp_path / name).write_text(content, encoding="utf-8")
    lines = "".join(re.findall(r"```sh\n(.*?)```", TUTORIAL, re.DOTALL))
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-e", "-c", lines],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,
    )
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "runs" / "egg" / "metrics.json").read_text())
    assert metrics["geometry"]["fscore"]["0.002"] > 0.95


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
