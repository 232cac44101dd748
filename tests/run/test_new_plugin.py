# SPDX-License-Identifier: MIT
"""A scene of one's own: what is written installs, passes its own test, and is twenty lines."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from sononerf import storage
from sononerf.errors import SettingsError, StorageError
from sononerf.run.new_plugin import new_plugin


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


@pytest.mark.thorough
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
        ("a b", "found 'a b'"),
        ("a.b", "found 'a.b'"),
        ("../bar", r"found '\.\./bar'"),
        ("bär", "found 'bär'"),
        ("bar\n", "found"),
        ("lambda", "'lambda' is a word of Python"),
        ("null", "'null' means something else in a settings file"),
        ("yes", "'yes' means something else in a settings file"),
        ("sphere", "scene 'sphere' is there already, of sononerf "),
        ("three-spheres", "scene 'three_spheres' is there already"),
        ("scikit-image", "installed already, as scikit-image "),
        ("json", "a module 'json' is there already"),
        ("yaml", "a module 'yaml' is there already"),
        ("setup", "'setup'"),
    ],
)
def test_names_that_are_none_or_taken(home, name, words):
    with pytest.raises(SettingsError, match=words) as caught:
        new_plugin("scene", name)
    assert "\n" not in str(caught.value)
    assert list(home.iterdir()) == []


def test_folders_that_are_not_free(home, monkeypatch):
    (home / "file").write_text("x")
    (home / "full").mkdir()
    (home / "full" / "mine").write_text("x")
    (home / "empty").mkdir()
    before = sorted(home.rglob("*"))
    for folder, words in (("file", "is a file"), ("full", "is not empty")):
        with pytest.raises(SettingsError, match=words):
            new_plugin("scene", "tin-drum", home / folder)
    with pytest.raises(StorageError, match="a part of the path is a file"):
        new_plugin("scene", "tin-drum", home / "file" / "bar")
    monkeypatch.chdir(home / "empty")
    with pytest.raises(SettingsError, match="is the working directory"):
        new_plugin("scene", "tin-drum", home / "empty")
    assert sorted(home.rglob("*")) == before


def test_a_disk_that_fails_half_way_leaves_nothing(home, monkeypatch):
    real, calls = storage.os.fsync, []

    def fsync(descriptor):
        calls.append(descriptor)
        if len(calls) == 2:  # of the second file
            raise OSError(28, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(storage.os, "fsync", fsync)
    with pytest.raises(StorageError, match="tin-drum: cannot be written: the disk is full"):
        new_plugin("scene", "tin-drum")
    assert list(home.iterdir()) == []
