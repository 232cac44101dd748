# SPDX-License-Identifier: MIT
"""Three-dimensional hearing: from the echoes of known poses to a reflectivity field and a mesh.

Shape letters used in docstrings and comments: ``P`` poses, ``D`` directions, ``E`` ears
(left, right), ``F`` frequencies, ``R`` range slices, ``S`` time samples, ``N`` points or
rays, ``B`` batch, ``V`` vertices, ``T`` triangles.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from sononerf.display import show_by

if TYPE_CHECKING:
    from sononerf import testing as testing
    from sononerf.echoes.echoes import Echoes
    from sononerf.evaluation.numbers import Comparison, Evaluation, evaluate
    from sononerf.evaluation.prediction import Prediction, predict
    from sononerf.field.datamodule import EchoDataModule
    from sononerf.field.field import Field
    from sononerf.field.fitting import fit
    from sononerf.field.module import EchoModule
    from sononerf.field.renderer import Renderer
    from sononerf.geometry.poses import Poses
    from sononerf.head.head import Head
    from sononerf.refinement.reconstruction import reconstruct, refine
    from sononerf.refinement.surface_error import next_poses
    from sononerf.run.evaluate import compare
    from sononerf.run.import_recordings import read_recordings
    from sononerf.run.run import Run, open_run
    from sononerf.scene.material import Material
    from sononerf.scene.scene import Scene
    from sononerf.simulation.ensemble import simulate
    from sononerf.start.surface import Surface

__all__ = [
    "Comparison",
    "EchoDataModule",
    "EchoModule",
    "Echoes",
    "Evaluation",
    "Field",
    "Head",
    "Material",
    "Poses",
    "Prediction",
    "Renderer",
    "Run",
    "Scene",
    "Surface",
    "__version__",
    "compare",
    "evaluate",
    "fit",
    "next_poses",
    "open_run",
    "predict",
    "read_recordings",
    "reconstruct",
    "refine",
    "simulate",
]

__version__ = "0.2.0.dev0"

_HOMES = {
    "Comparison": "evaluation.numbers",
    "EchoDataModule": "field.datamodule",
    "EchoModule": "field.module",
    "Echoes": "echoes.echoes",
    "Evaluation": "evaluation.numbers",
    "Field": "field.field",
    "Head": "head.head",
    "Material": "scene.material",
    "Poses": "geometry.poses",
    "Prediction": "evaluation.prediction",
    "Renderer": "field.renderer",
    "Run": "run.run",
    "Scene": "scene.scene",
    "Surface": "start.surface",
    "compare": "run.evaluate",
    "evaluate": "evaluation.numbers",
    "fit": "field.fitting",
    "next_poses": "refinement.surface_error",
    "open_run": "run.run",
    "predict": "evaluation.prediction",
    "read_recordings": "run.import_recordings",
    "reconstruct": "refinement.reconstruction",
    "refine": "refinement.reconstruction",
    "simulate": "simulation.ensemble",
}
"""Modules of the public names; each is imported at its first use."""


def __getattr__(name: str) -> object:
    if name == "testing":
        return importlib.import_module("sononerf.testing")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"sononerf.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__


def _notebook(name: str) -> Any:
    """Return a function of the notebook's module, which imports all kinds of objects, when used."""

    def call(*given: Any, **options: Any) -> Any:
        return getattr(importlib.import_module("sononerf.report.page"), name)(*given, **options)

    return call


show_by(_notebook("html_of"), _notebook("png_of"))
