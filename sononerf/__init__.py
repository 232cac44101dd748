# SPDX-License-Identifier: MIT
"""Three-dimensional hearing: from the echoes of known poses to a reflectivity field and a mesh.

Shape letters used in docstrings and comments: ``P`` poses, ``D`` directions, ``E`` ears
(left, right), ``F`` frequencies, ``R`` range slices, ``S`` time samples, ``N`` points or
rays, ``B`` batch, ``V`` vertices, ``T`` triangles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sononerf.echoes.echoes import Echoes
    from sononerf.field.datamodule import EchoDataModule
    from sononerf.field.field import Field
    from sononerf.field.module import EchoModule
    from sononerf.field.renderer import Renderer
    from sononerf.geometry.poses import Poses
    from sononerf.head.head import Head
    from sononerf.scene.material import Material
    from sononerf.scene.scene import Scene

__version__ = "0.1.0"
__all__ = [
    "EchoDataModule",
    "EchoModule",
    "Echoes",
    "Field",
    "Head",
    "Material",
    "Poses",
    "Renderer",
    "Scene",
    "__version__",
]

_HOMES = {
    "EchoDataModule": "field.datamodule",
    "EchoModule": "field.module",
    "Echoes": "echoes.echoes",
    "Field": "field.field",
    "Head": "head.head",
    "Material": "scene.material",
    "Poses": "geometry.poses",
    "Renderer": "field.renderer",
    "Scene": "scene.scene",
}
"""Where the public names are; each is imported when it is first asked for."""


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"sononerf.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
