# SPDX-License-Identifier: MIT
"""Metrics of a surface and of a prediction, and differences between two runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from sononerf.display import Shown
from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError, NumericalError
from sononerf.evaluation.baseline import BASELINES
from sononerf.evaluation.geometry import Kind, Truth, baseline_volume
from sononerf.evaluation.prediction import Prediction, prediction_numbers
from sononerf.geometry.lattice import Volume
from sononerf.numerics import Floats
from sononerf.progress import Progress
from sononerf.scene.scene import Scene
from sononerf.surface.surface import Surface

SAME = 1e-6
"""Largest distance between the centroids of two triangles that count as the same, m."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two volumes over their common maximum, and the difference between them.

    Attributes:
        first, second: 0 to 1, on one grid.
        difference: First without second.
        strongest ((3,) or None, m): Place of the greatest difference; None where it is nowhere
            above zero.
        score: Greatest difference, as a fraction of the common maximum.
        poses: At how many poses both were heard.
    """

    first: Volume
    second: Volume
    difference: Volume
    strongest: Floats | None
    score: float
    poses: int = 0


def compare(first: Volume, second: Volume) -> Comparison:
    """Compare two volumes, place by place.

    Args:
        first, second: Loudness of each place, on one grid.

    Raises:
        ValueError: If the grids differ.
        NumericalError: If both are silent.
    """
    alike = first.shape == second.shape and np.allclose(first.origin, second.origin)
    if not alike or first.spacing != second.spacing:
        raise ValueError("the two volumes have different grids")
    most = max(float(first.values.max()), float(second.values.max()))
    if not most > 0:
        raise NumericalError("nothing to compare: both are silent")
    one, other = (volume.with_values(volume.values / most) for volume in (first, second))
    difference = first.with_values(one.values - other.values)
    index = np.unravel_index(int(difference.values.argmax()), difference.shape)
    score = float(difference.values[index])
    # Where nothing is stronger the greatest value lies anywhere, often in a corner.
    strongest = difference.origin + difference.spacing * np.array(index) if score > 0 else None
    return Comparison(one, other, difference, strongest, score)


def added_part(mesh: trimesh.Trimesh, without: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """Return the parts of a true surface that another one lacks; None if there are none."""
    if not len(without.faces):
        return mesh
    distance, _ = cKDTree(without.triangles_center).query(mesh.triangles_center)
    added = np.flatnonzero(distance > SAME)
    return mesh.submesh([added], append=True) if len(added) else None


UNITS = {"m": (1e3, "mm"), "db": (1.0, "dB"), "s": (1.0, "s")}
"""How numbers are shown, by a part of their name after the first: factor and unit."""


class Evaluation(dict[str, Any], Shown):
    """Numbers by name, as the README explains them; ``print`` shows them with their units."""

    def rows(self) -> list[tuple[str, str]]:
        """Return name and value of each number as text; lists and matrices are left out."""
        return [(name, text) for name, value in _flat(self) if (text := _shown(name, value))]

    def __str__(self) -> str:
        rows = self.rows()
        width = max((len(name) for name, _ in rows), default=0)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _flat(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in values.items():
        if isinstance(value, dict):
            rows += _flat(value, f"{prefix}{name} ")
        else:
            rows.append((f"{prefix}{name}", value))
    return rows


def _shown(name: str, value: Any) -> str | None:
    if not isinstance(value, float):
        return str(value) if isinstance(value, (int, str)) else None
    parts = name.split("_")[1:]
    factor, unit = next((UNITS[part] for part in parts if part in UNITS), (1.0, ""))
    return f"{factor * value:.3g} {unit}".rstrip()


def evaluate(
    surface: Surface | trimesh.Trimesh,
    truth: Scene | trimesh.Trimesh,
    echoes: Echoes | None = None,
    *,
    registration: Kind = "none",
    progress: Progress | None = None,
) -> Evaluation:
    """Compare a surface with the true one, and with the baselines.

    Args:
        surface: Reconstructed, m.
        truth: The true surface, m; of a scene with a background also the target alone is compared.
        echoes: Give the baselines backprojection and voxel fit; left out where None.
        registration: Motion that lays the reconstruction over the truth first: ``none``, ``rigid``
            or ``similarity``.
        progress: Display of progress; on stderr where None.

    Returns:
        evaluation: ``chamfer_m``, ``fscore`` and the others of
            :func:`sononerf.evaluation.metrics.geometry_metrics`; ``baseline`` where echoes are
            given.

    Raises:
        InputError: If a surface is none.
        NumericalError: If one is empty or not finite.
    """
    progress = progress or Progress()
    scene = truth if isinstance(truth, Scene) else None
    true = truth.mesh if isinstance(truth, Scene) else truth
    mesh = surface.mesh if isinstance(surface, Surface) else surface
    for found in (true, mesh):
        if not isinstance(found, trimesh.Trimesh):
            raise InputError(
                f"found a {type(found).__name__}, expected a Surface, a Scene or a trimesh.Trimesh"
            )
    laid = Truth(true, mesh, registration)
    numbers = Evaluation(laid.of_reconstruction(scene))
    if echoes is not None:
        lower, upper = np.asarray(echoes.region.box())
        numbers["baseline"] = {}
        with progress.task("baselines", len(BASELINES)) as task:
            for name in BASELINES:
                volume = baseline_volume(name, echoes, lower, upper)
                numbers["baseline"][name] = laid.of_volume(volume)
                task.advance()
    return numbers


def compare_prediction(prediction: Prediction, echoes: Echoes) -> Evaluation:
    """Compare a prediction with the measurement of its poses."""
    numbers = echoes.numbers_of(prediction.poses)
    measured = np.stack([echoes.spectrogram(int(number)) for number in numbers])
    return Evaluation(prediction_numbers(prediction, echoes, measured))
