# SPDX-License-Identifier: MIT
"""The list of scenes: a broken one says so and hurts no other."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import pytest
from PIL import Image

from sononerf.errors import SettingsError, StorageError
from sononerf.run import scenes as scenes_module
from sononerf.run.scenes import (
    describe_scene,
    describe_scenes,
    draw_scenes,
    new_plugin,
    option_table,
    scene_table,
)


@pytest.fixture
def few(monkeypatch):
    """Leave but a few of the scenes that are installed: building all takes seconds."""
    real = scenes_module.list_scenes
    wanted = {"sphere", "mesh", "fixture_bar", "broken", "failing", "choosy", "loud"}

    def listed():
        return [plugin for plugin in real() if plugin.name in wanted]

    monkeypatch.setattr(scenes_module, "list_scenes", listed)


def test_one_scene_tells_its_options():
    lines = option_table(describe_scene("mesh"))
    assert lines[0] == "Load a surface from a file."
    assert not any("Returns" in line or "Raises" in line for line in lines)
    rows = {
        line.split()[0]: line.split(maxsplit=2)[1:] for line in lines[lines.index("") :] if line
    }
    assert rows["path"] == ["needed", "text"]
    assert rows["scale"] == ["1.0", "a number above 0"]
    assert rows["centre"] == ["true", "true or false"]
    assert rows["unit"] == ["none", "m, cm, mm or none"]


def test_every_scene_says_where_it_is_from_and_what_it_takes(plugin, few):
    rows = {row["name"]: row for row in describe_scenes()}
    assert rows.keys() == {"sphere", "mesh", "fixture_bar"}
    assert rows["sphere"]["distribution"] == "sononerf"
    assert rows["sphere"]["summary"].startswith("Build a sphere")
    assert rows["sphere"]["options"] == ["radius", "material"]
    assert (rows["fixture_bar"]["distribution"], rows["fixture_bar"]["version"]) == (
        "sononerf-fixture",
        "1.0",
    )
    assert rows["fixture_bar"]["options"] == ["length", "radius"]
    assert not any(row["broken"] for row in rows.values())
    assert rows["fixture_bar"]["size_m"] == pytest.approx([0.02, 0.02, 0.12], rel=0.02)
    assert rows["fixture_bar"]["triangles"] > 100
    assert rows["fixture_bar"]["needs"] == []
    mesh = rows["mesh"]
    assert (mesh["needs"], mesh["size_m"], mesh["triangles"]) == (["path"], None, None)


FAULTY = """
import warnings
from sononerf.scene.scene import Scene
def failing():
    \"\"\"Raise.\"\"\"
    raise RuntimeError("no\\nluck")
def choosy(size: float):
    \"\"\"Build what needs an option.\"\"\"
def loud():
    \"\"\"Talk, and make an open mesh.\"\"\"
    import trimesh
    print("hello")
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    return Scene(trimesh.Trimesh(box.vertices, box.faces[:-1]))
"""


@pytest.fixture
def broken(tmp_path, monkeypatch):
    info = tmp_path / "broken-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 2.0\n")
    names = ["failing", "choosy", "loud"]
    lines = ["broken = no_such_module:make", *(f"{name} = faulty_scenes:{name}" for name in names)]
    (info / "entry_points.txt").write_text("\n".join(["[sononerf.scenes]", *lines]) + "\n")
    (tmp_path / "faulty_scenes.py").write_text(FAULTY)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("faulty_scenes", None)


def test_a_broken_scene_hurts_only_its_own_row(broken, few, capsys, caplog):
    rows = {row["name"]: row for row in describe_scenes()}
    assert {name for name, row in rows.items() if row["broken"]} == {"broken", "failing"}
    assert "no_such_module" in rows["broken"]["summary"]
    assert rows["failing"]["summary"].endswith("failed: RuntimeError: no luck")
    assert rows["failing"]["size_m"] is None
    assert rows["choosy"]["needs"] == ["size"]
    assert rows["loud"]["size_m"] == pytest.approx([0.1, 0.1, 0.1])
    assert capsys.readouterr().out == ""  # of `--json`, standard output is ours alone
    assert caplog.records == []


def test_the_table_is_aligned():
    row = {"distribution": "d", "version": "1", "needs": [], "size_m": None, "triangles": None}
    rows = [
        {**row, "name": "a", "size_m": [0.03, 0.0305, 1.0], "triangles": 12, "summary": "Build a."},
        {**row, "name": "longer", "needs": ["path"], "summary": "Load."},
        {**row, "name": "b", "broken": True, "summary": "broken: why"},
    ]
    assert scene_table(rows) == [
        "name    from  size (mm)         triangles",
        "a       d 1   30 x 30.5 x 1000         12  Build a.",
        "longer  d 1   needs path                -  Load.",
        "b       d 1   -                         -  broken: why",
    ]


def size_of(path):
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        image.load()
        return image.size


def test_scenes_are_drawn_but_those_that_cannot_be(broken, few, tmp_path):
    written, skipped = draw_scenes(tmp_path / "pictures")
    assert [path.name for path in written] == ["loud.png", "sphere.png"]
    assert min(size_of(written[0])) > 100
    reasons = dict(line.split(": ", 1) for line in skipped)
    assert reasons["mesh"] == "needs scene.options.path"
    assert reasons["choosy"] == "needs scene.options.size"
    assert "no_such_module" in reasons["broken"]
    assert reasons["failing"].endswith("no luck")


def lines(path):
    return len(path.read_text(encoding="utf-8").splitlines())


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_three_files_and_twenty_lines(home):
    written = new_plugin("scene", "tin-drum")
    assert [str(path) for path in written] == [
        "tin-drum/pyproject.toml",
        "tin-drum/tin_drum.py",
        "tin-drum/test_tin_drum.py",
    ]
    assert sorted((home / "tin-drum").iterdir()) == sorted(home / path for path in written)
    assert lines(written[0]) + lines(written[1]) <= 20


def test_it_goes_where_it_is_told_to(home):
    (home / "empty").mkdir()
    assert new_plugin("scene", "tin-drum", home / "empty")[1] == home / "empty" / "tin_drum.py"
    assert new_plugin("scene", "tin-drum", home / "a" / "b")[1].is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "passed"),
    [
        ("scene", 6),
        pytest.param("field", 1, marks=pytest.mark.slow),
        pytest.param("renderer", 1, marks=pytest.mark.slow),
    ],
)
def test_what_is_written_installs_and_passes_its_own_test(tmp_path, kind, passed):
    source, target = tmp_path / "tin-drum", tmp_path / "installed"
    new_plugin(kind, "tin-drum", source)
    flags = ["--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    environment = {**os.environ, "PIP_CONFIG_FILE": os.devnull}
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "-q", *flags, "--target", target, source],
        check=True,
        env=environment,
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", source],
        env={**environment, "PYTHONPATH": str(target), "PYTHONSAFEPATH": "1"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    good = (done.returncode, f"{passed} passed" in done.stdout)
    assert good == (0, True), done.stdout + done.stderr


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("", "found ''"),
        ("3d", "found '3d'"),
        ("_bar", "found '_bar'"),
        ("bar-", "found 'bar-'"),
        ("../bar", r"found '\.\./bar'"),
        ("bar\n", "found"),
        ("sphere", "there is a scene 'sphere'"),
        ("three-spheres", "there is a scene 'three_spheres'"),
    ],
)
def test_names_that_are_none_or_taken(home, name, words):
    with pytest.raises(SettingsError, match=words) as caught:
        new_plugin("scene", name)
    assert "\n" not in str(caught.value)
    assert list(home.iterdir()) == []


def test_a_folder_that_is_not_empty_is_refused(home):
    (home / "full").mkdir()
    (home / "full" / "mine").write_text("x")
    with pytest.raises(SettingsError, match="is not empty"):
        new_plugin("scene", "tin-drum", home / "full")
    with pytest.raises(StorageError, match="a part of the path is a file"):
        new_plugin("scene", "tin-drum", home / "full" / "mine" / "bar")
    assert [path.name for path in (home / "full").iterdir()] == ["mine"]
