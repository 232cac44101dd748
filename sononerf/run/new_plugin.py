# SPDX-License-Identifier: MIT
"""A scene, field or renderer of one's own: a plugin to start from, with its test."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import keyword
import re
import sys
from pathlib import Path
from typing import Literal

import yaml

from sononerf import storage
from sononerf.errors import SettingsError
from sononerf.settings import plugins

Kind = Literal["scene", "field", "renderer"]

# {name} stands for the plugin's name in all of them.
PROJECT = """\
build-system = {{ requires = ["setuptools>=77"], build-backend = "setuptools.build_meta" }}
[project]
name = "{distribution}"
version = "0.1"
[project.entry-points."sononerf.{kind}s"]
{name} = "{name}:make"
[tool.setuptools]
py-modules = ["{name}"]
"""
SCENE = '''\
from typing import Annotated

import trimesh
from pydantic import Field
from sononerf.scene import Scene

Metres = Annotated[float, Field(gt=0, le=1)]


def make(length: Metres = 0.05, radius: Metres = 0.01) -> Scene:
    """Build an upright rod with round ends: length of the straight part and radius (m)."""
    return Scene(trimesh.creation.capsule(height=length, radius=radius))
'''
SCENE_TEST = """\
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
FIELD = '''\
from itertools import pairwise
from typing import Annotated

import torch
from pydantic import Field as Option
from sononerf import Field
from torch import Tensor, nn


class Siren(Field):
    """A network whose non-linearities are sines (SIREN).

    Args:
        region ((2, 3), m): Lower and upper corner of the box.
        frequency ((F,), Hz): Frequencies of the answer.
        width, depth: Width and depth of the hidden layers.
        omega: Factor of the sines' arguments.
    """

    learning_rate = 1e-3
    costly = True

    def __init__(
        self,
        region: Tensor,
        frequency: Tensor,
        *,
        width: Annotated[int, Option(ge=8)] = 128,
        depth: Annotated[int, Option(ge=1)] = 3,
        omega: Annotated[float, Option(gt=0)] = 10.0,
    ) -> None:
        super().__init__(region, frequency)
        self.omega = omega
        sizes = [6] + [width] * depth
        self.layers = nn.ModuleList(nn.Linear(one, two) for one, two in pairwise(sizes))
        self.out = nn.Linear(width, len(frequency))
        for number, layer in enumerate(self.layers):
            bound = 1 / 6 if number == 0 else (6 / width) ** 0.5 / omega
            nn.init.uniform_(layer.weight, -bound, bound)

    @property
    def resolution(self) -> float:
        return float((self.region[1] - self.region[0]).max()) / 64

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        positions, directions = torch.broadcast_tensors(positions, directions)
        inside = self.inside(positions)
        size = (self.region[1] - self.region[0]).max() / 2
        place = (positions[inside] - self.region.mean(dim=0)) / size
        x = torch.cat((place, directions[inside]), dim=-1)
        for layer in self.layers:
            x = torch.sin(self.omega * layer(x))
        answer = self.out(x)
        silent = answer.new_zeros(*inside.shape, answer.shape[-1])
        return silent.index_put((inside,), answer)


make = Siren
'''
FIELD_TEST = """\
from sononerf import testing


def test_it_holds_what_fields_promise():
    testing.check_field("{name}", width=16)
"""
RENDERER = '''\
from typing import Annotated

import torch
from pydantic import Field as Option
from sononerf import Field, Head, Renderer
from sononerf.field.field import lattice_over
from sononerf.field.renderer import look_up
from torch import Tensor


class LatticeRenderer(Renderer):
    """Adds the power of places on a lattice in the range slice that each lies in.

    Args:
        region ((2, 3), m): Lower and upper corner of the box that holds the field.
        head: The head that heard the spectra.
        spacing (m): Spacing of the lattice.
    """

    lattice: Tensor

    def __init__(
        self,
        region: Tensor,
        head: Head,
        *,
        spacing: Annotated[float, Option(gt=0, le=0.1)] = 0.004,
    ) -> None:
        super().__init__(region, head)
        self.register_buffer("lattice", lattice_over(region, spacing), persistent=False)

    def forward(
        self,
        field: Field,
        position: Tensor,
        rotation: Tensor,
        rows: Tensor,
        bins: Tensor | None = None,
    ) -> Tensor:
        if bins is None:
            bins = torch.arange(len(self.frequency), device=rows.device)
        poses = []
        for place, turn, some in zip(position, rotation, rows, strict=True):
            way = self.lattice - (place + turn @ self.emitter)
            distance = way.norm(dim=-1)
            unit = way / distance[:, None]
            power = field.select(self.lattice, -unit, bins).abs().square()
            power = power / distance[:, None] ** 4
            power = power * look_up(self.beam[bins], unit @ turn) ** 2
            step = self.range[1] - self.range[0]
            row = ((distance - self.range[0]) / step).round().long()
            heard = (row >= 0) & (row < len(self.range))
            ears = []
            for table in self.ears:
                sound = power * look_up(table[bins], unit @ turn) ** 2
                silent = sound.new_zeros(len(self.range), len(bins))
                ears.append(silent.index_add(0, row[heard], sound[heard])[some])
            poses.append(torch.stack(ears))
        return self.log_gain.exp() * (torch.stack(poses) + 1e-24).sqrt()


make = LatticeRenderer
'''
RENDERER_TEST = """\
from sononerf import testing


def test_it_holds_what_renderers_promise():
    testing.check_renderer("{name}")
"""
TEMPLATES: dict[Kind, tuple[str, str]] = {
    "scene": (SCENE, SCENE_TEST),
    "field": (FIELD, FIELD_TEST),
    "renderer": (RENDERER, RENDERER_TEST),
}


def new_plugin(kind: Kind, name: str, folder: Path | None = None) -> list[Path]:
    """Write a plugin with one scene, field or renderer: two files that install, and their test.

    Args:
        kind: Kind of plugin.
        name: Name of distribution, module and plugin; in the last two, ``-`` becomes ``_``.
        folder: Folder of the package; ``name`` in the working directory by default.

    Returns:
        written: All at once, or none.

    Raises:
        SettingsError: If the name is no name, or taken, or the folder is not free.
        StorageError: If the files cannot be written.
    """
    module = name.replace("-", "_")
    _check_name(kind, name, module)
    content, test = TEMPLATES[kind]
    folder = Path(name) if folder is None else folder
    _check_folder(folder)
    files = {
        "pyproject.toml": PROJECT.format(distribution=name, name=module, kind=kind),
        f"{module}.py": content,
        f"test_{module}.py": test.format(name=module),
    }
    storage.commit_folder(folder, files)
    return [folder / file for file in files]


def _check_name(kind: Kind, name: str, module: str) -> None:
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
    for plugin in plugins.registered(f"sononerf.{kind}s"):
        if plugin.name == module:
            raise SettingsError(
                f"NAME: {kind} {module!r} is there already, of {plugin.distribution} "
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
