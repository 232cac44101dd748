# SPDX-License-Identifier: MIT
"""A scene of one's own: a plugin to start from, with its test."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import keyword
import re
import sys
from pathlib import Path

import yaml

from sononerf import storage
from sononerf.errors import SettingsError
from sononerf.settings import plugins

# Both together are a complete scene in twenty lines; {name} stands for its name in all of them.
PROJECT = """\
build-system = {{ requires = ["setuptools>=77"], build-backend = "setuptools.build_meta" }}
[project]
name = "{distribution}"
version = "0.1"
[project.entry-points."sononerf.scenes"]
{name} = "{name}:make"
[tool.setuptools]
py-modules = ["{name}"]
"""
MODULE = '''\
from typing import Annotated

import trimesh
from pydantic import Field
from sononerf.scene import Scene

Metres = Annotated[float, Field(gt=0, le=1)]


def make(length: Metres = 0.05, radius: Metres = 0.01) -> Scene:
    """Build an upright rod with round ends: length of the straight part and radius (m)."""
    return Scene(trimesh.creation.capsule(height=length, radius=radius))
'''
TEST = """\
import pytest
from sononerf.errors import SettingsError
from sononerf.scene import load_scene


def test_it_is_as_large_as_it_should_be():
    assert load_scene("{name}").mesh.extents == pytest.approx([0.02, 0.02, 0.07], rel=0.02)


def test_its_options_change_it():
    larger = load_scene("{name}", {{"length": 0.1, "radius": 0.02}}).mesh
    assert larger.extents == pytest.approx([0.04, 0.04, 0.14], rel=0.02)


def test_it_is_closed():
    assert load_scene("{name}").mesh.is_watertight


@pytest.mark.parametrize("options", [{{"radius": 0}}, {{"radius": "thick"}}, {{"radios": 0.01}}])
def test_a_wrong_option_is_refused(options):
    with pytest.raises(SettingsError, match="scene.options"):
        load_scene("{name}", options)
"""


def new_scene(name: str, folder: Path | None = None) -> list[Path]:
    """Write a plugin with one scene: two files that install, and their test.

    Args:
        name: Of distribution, module and scene; in the last two, ``-`` becomes ``_``.
        folder: Where to; ``name`` in the working directory by default.

    Returns:
        written: All at once, or none.

    Raises:
        SettingsError: If the name is no name, or taken, or the folder is not free.
        StorageError: If the files cannot be written.
    """
    module = name.replace("-", "_")
    _check_name(name, module)
    folder = Path(name) if folder is None else folder
    _check_folder(folder)
    files = {
        "pyproject.toml": PROJECT.format(distribution=name, name=module),
        f"{module}.py": MODULE,
        f"test_{module}.py": TEST.format(name=module),
    }
    storage.commit_folder(folder, files)
    return [folder / file for file in files]


def _check_name(name: str, module: str) -> None:
    if not re.fullmatch(r"[A-Za-z]([A-Za-z0-9_-]*[A-Za-z0-9])?", name):
        raise SettingsError(
            f"NAME: found {name!r}; give letters, digits, _ and -, a letter first and no _ or - "
            "last, e.g. my_bar"
        )
    if keyword.iskeyword(module) or module == "setup":  # setup.py is run by who installs it
        raise SettingsError(f"NAME: {name!r} is a word of Python; choose another, e.g. my_{module}")
    if yaml.safe_load(module) != module:
        raise SettingsError(
            f"NAME: {name!r} means something else in a settings file; choose another, "
            f"e.g. my_{module}"
        )
    for plugin in plugins.registered(plugins.SCENES):
        if plugin.name == module:
            raise SettingsError(
                f"NAME: scene {module!r} is there already, of {plugin.distribution} "
                f"{plugin.version}; choose another, e.g. my_{module}"
            )
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        version = None
    if version is not None:  # pip would put ours in its place
        raise SettingsError(
            f"NAME: {name!r} is installed already, as {name} {version}; choose another, "
            f"e.g. my_{module}"
        )
    if module in sys.stdlib_module_names or _is_importable(module):
        raise SettingsError(
            f"NAME: a module {module!r} is there already; choose another, e.g. my_{module}"
        )


def _is_importable(module: str) -> bool:
    try:
        found = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return True  # there, if odd
    return found is not None and found.origin is not None  # else a mere folder of that name


def _check_folder(folder: Path) -> None:
    try:
        if not folder.exists():
            return
        if not folder.is_dir():
            raise SettingsError(f"{folder}: is a file; choose another folder with --output")
        if any(folder.iterdir()):
            raise SettingsError(f"{folder}: is not empty; choose another folder with --output")
        if folder.samefile(Path.cwd()):  # it is replaced as a whole, under its user's feet
            raise SettingsError(f"{folder}: is the working directory; give --output a new folder")
    except OSError as error:
        raise storage.storage_error("cannot be looked into", folder, error) from error
