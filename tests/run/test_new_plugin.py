# SPDX-License-Identifier: MIT
"""A scene of one's own: what is written installs, passes its own test, and is twenty lines."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from sononerf.errors import SettingsError, StorageError
from sononerf.run.scenes import new_plugin


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
