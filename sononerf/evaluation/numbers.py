# SPDX-License-Identifier: MIT
"""A surface beside the true one: registration, scores, baselines, and comparison of predictions."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.registration import procrustes

from sononerf.display import NotebookRepr
from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError, NumericalError
from sononerf.evaluation.baseline import BASELINES, best_level_surface, volume_of
from sononerf.evaluation.metrics import Solid, geometry_metrics, target_metrics
from sononerf.evaluation.prediction import Prediction, prediction_numbers
from sononerf.geometry.lattice import Volume
from sononerf.geometry.poses import Poses
from sononerf.numerics import Floats
from sononerf.progress import Progress
from sononerf.resources import computed
from sononerf.scene.scene import Scene
from sononerf.start.surface import Surface

MIN_POSES_FOR_PROCESS = 64
"""Number of training poses from which a separate process saves time."""

RegistrationKind = Literal["none", "rigid", "similarity"]

COARSE_SAMPLES = 500
"""Samples of each surface while all starts are compared."""
FINE_SAMPLES = 10_000
"""Samples of each surface for the best starts."""
REFINED_STARTS = 3
"""Number of starts that are refined with all samples."""
MAX_ITERATIONS = 100
"""Most iterations from one start; most end after 20 to 50."""
CONVERGED = 1e-5
"""Relative change of the mean distance at which the iteration ends."""


@dataclass(frozen=True, eq=False)
class Registration:
    """A rigid motion or similarity."""

    matrix: Floats  # (4, 4): From the reconstruction's frame to the true one, lengths in m
    scale: float  # Scale of lengths; 1 for a rigid motion

    def inverse(self) -> Registration:
        """Return the motion from the true frame to that of the reconstruction."""
        return Registration(
            np.asarray(np.linalg.inv(self.matrix), dtype=np.float64), 1.0 / self.scale
        )

    def of(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """Return a moved copy of a mesh."""
        moved = mesh.copy()
        moved.apply_transform(self.matrix)
        return moved


def register(
    reconstructed: trimesh.Trimesh, truth: trimesh.Trimesh, kind: RegistrationKind, *, seed: int = 0
) -> Registration:
    """Find the motion that aligns one surface with another, by iterated closest points [1]_.

    Distances count in both directions, so that a whole surface is not aligned with a part of the
    other. Starts are the given position and all proper alignments of the principal axes; the best
    result is returned. Reflections are excluded.

    References:
        .. [1] P. J. Besl and N. D. McKay, "A method for registration of 3-D shapes", IEEE PAMI
           14(2), 1992.
    """
    if kind == "none":
        return Registration(np.eye(4), 1.0)
    scaled = kind == "similarity"
    points, target = (
        np.asarray(trimesh.sample.sample_surface(mesh, FINE_SAMPLES, seed=seed)[0])
        for mesh in (reconstructed, truth)
    )
    tried = [
        _closest(points[:COARSE_SAMPLES], target[:COARSE_SAMPLES], start, scaled)
        for start in _starts(points, target, scaled)
    ]
    tried.sort(key=lambda pair: pair[0])
    best = min(
        (_closest(points, target, start, scaled) for _, start in tried[:REFINED_STARTS]),
        key=lambda pair: pair[0],
    )
    return Registration(best[1], float(np.cbrt(np.linalg.det(best[1][:3, :3]))))


def _starts(points: Floats, target: Floats, scaled: bool) -> list[Floats]:
    """Return the initial guesses (4, 4): identity, equal centres, and aligned axes."""
    middles = points.mean(axis=0), target.mean(axis=0)
    spread = [
        np.sqrt(((p - m) ** 2).sum(axis=1).mean())
        for p, m in zip((points, target), middles, strict=True)
    ]
    scale = spread[1] / spread[0] if scaled else 1.0
    axes = [np.linalg.svd(p - m, full_matrices=False)[2] for p, m in
            zip((points, target), middles, strict=True)]  # fmt: skip
    turns = [np.eye(3)]
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            rotation = axes[1].T @ (np.array(signs)[:, None] * axes[0][list(order)])
            if np.linalg.det(rotation) > 0:
                turns.append(rotation)
    starts = [] if scaled else [np.eye(4)]
    for rotation in turns:
        start = np.eye(4)
        start[:3, :3] = scale * rotation
        start[:3, 3] = middles[1] - scale * rotation @ middles[0]
        starts.append(start)
    return starts


def _closest(points: Floats, target: Floats, start: Floats, scaled: bool) -> tuple[float, Floats]:
    """Iterate from a start; return the mean distance, m, and the motion."""
    tree, motion, before = cKDTree(target), start, np.inf
    for _ in range(MAX_ITERATIONS):
        moved = trimesh.transform_points(points, motion)
        out, near = tree.query(moved)
        back, origin = cKDTree(moved).query(target)
        error = 0.5 * float(out.mean() + back.mean())
        if error > (1.0 - CONVERGED) * before:
            break
        before = error
        pairs = np.concatenate([points, points[origin]]), np.concatenate([target[near], target])
        motion = procrustes(*pairs, reflection=False, scale=scaled, return_cost=False)
    return before, np.asarray(motion)


MOST_TIMES = 30.0
"""Largest ratio of the sizes of truth and reconstruction, no unit: mistaking inches for metres
gives 39."""


def check_truth(
    reconstructed: trimesh.Trimesh, true: trimesh.Trimesh, kind: RegistrationKind, name: str
) -> None:
    """Refuse a true surface of another size or at another place, before anything is computed."""
    sizes = [float(np.linalg.norm(mesh.extents)) for mesh in (reconstructed, true)]
    times = max(sizes) / max(min(sizes), 1e-12)
    if kind != "similarity" and times > MOST_TIMES:
        raise InputError(
            f"{name}: {sizes[1]:.3g} m across, and the reconstruction {sizes[0]:.3g} m; give the "
            "unit of its numbers (--unit mm, or evaluation.unit), or --registration similarity"
        )
    apart = np.maximum(
        true.bounds[0] - reconstructed.bounds[1], reconstructed.bounds[0] - true.bounds[1]
    )
    if kind == "none" and (apart > 0).any():
        raise InputError(
            f"{name}: lies {np.linalg.norm(apart.clip(0)):.3g} m away from the reconstruction; "
            "move it there, or give --registration rigid"
        )


def signed_error(mesh: trimesh.Trimesh, true: trimesh.Trimesh) -> Floats:
    """Return the signed distance (V,), m, of each vertex from the true surface: positive outside.

    An open true surface has no inside; all values are then positive.
    """
    solid = Solid(true)
    points = np.asarray(mesh.vertices, dtype=np.float64)
    distance = solid.nearest.distance(points)
    return np.where(solid.contains(points), -distance, distance) if solid.closed else distance


BASELINE_VOXELS = 64
"""Number of voxels of a baseline along the region's longest side: finer than the analysis window in
all shipped scenes."""

BASELINE_SAMPLES = 20_000
"""Number of samples of a baseline's surface: the F-score then errs by 0.004, and it is stated to
0.01."""


class Truth:
    """A true surface, laid over a reconstruction."""

    def __init__(
        self, true: trimesh.Trimesh, mesh: trimesh.Trimesh, kind: RegistrationKind
    ) -> None:
        self.surface = Solid(true)
        self.kind: RegistrationKind = kind
        self.motion: Registration = register(mesh, true, kind)
        self.mesh = self.motion.of(mesh)
        # The truth in the frame of the reconstruction, in which levels of baselines are chosen.
        self._near = self.surface if kind == "none" else Solid(self.motion.inverse().of(true))

    def of_reconstruction(self, scene: Scene | None = None) -> dict[str, Any]:
        """Return the metrics of the reconstruction; of a scene with a target, also of that alone.

        The README's table names them.
        """
        metrics = geometry_metrics(self.mesh, self.surface)
        if self.kind != "none":
            metrics["registration"] = {
                "kind": self.kind,
                "scale": self.motion.scale,
                "matrix": self.motion.matrix.tolist(),
            }
        surroundings = None if scene is None else scene.surface(background=True)
        target = None if scene is None else scene.surface(background=False)
        if surroundings is not None and target is not None:
            metrics["target"] = target_metrics(self.mesh, target, surroundings)
        return metrics

    def of_volume(self, volume: Volume) -> dict[str, Any] | None:
        """Return the metrics of a baseline at its best level; None where it has no surface."""
        try:
            mesh, level = best_level_surface(volume, self._near)
        except NumericalError:
            return None
        moved = self.motion.of(mesh)
        found = geometry_metrics(moved, self.surface, samples=BASELINE_SAMPLES)
        return {**found, "level": level}


def baseline_volume(name: str, echoes: Echoes, lower: Floats, upper: Floats) -> Volume:
    """Compute a baseline: backprojection or a voxel fit of the training poses.

    In: lower, upper ((3,), m).
    """
    train = echoes.store.indices("train")
    spacing = float((upper - lower).max()) / BASELINE_VOXELS
    poses = Poses(echoes.positions[train], echoes.rotations[train])
    task = name, train, poses, echoes.head, lower, upper, spacing
    if len(train) < MIN_POSES_FOR_PROCESS:
        return volume_of(echoes.store, *task)
    ((_, volume),) = computed(volume_of, echoes.store, {0: task}, 1, what="baseline")
    assert isinstance(volume, Volume)
    return volume


SAME_CENTROID = 1e-6
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
        poses: Number of poses at which both were rendered.
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
    # If no value is positive, the place of the maximum means nothing.
    strongest = difference.origin + difference.spacing * np.array(index) if score > 0 else None
    return Comparison(one, other, difference, strongest, score)


def added_part(mesh: trimesh.Trimesh, without: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """Return the parts of a true surface that another one lacks; None if there are none."""
    if not len(without.faces):
        return mesh
    distance, _ = cKDTree(without.triangles_center).query(mesh.triangles_center)
    added = np.flatnonzero(distance > SAME_CENTROID)
    return mesh.submesh([added], append=True) if len(added) else None


UNITS = {"m": (1e3, "mm"), "db": (1.0, "dB"), "s": (1.0, "s")}
"""Factor and unit in which a number is shown, by a later part of its name."""


class Evaluation(dict[str, Any], NotebookRepr):
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
    registration: RegistrationKind = "none",
    progress: Progress | None = None,
) -> Evaluation:
    """Compare a surface with the true one, and with the baselines.

    Args:
        surface: Reconstructed, m.
        truth: The true surface, m; of a scene with a background, the target alone is compared too.
        echoes: Give the baselines backprojection and voxel fit; left out by default.
        registration: Motion that lays the reconstruction over the truth first: ``none``, ``rigid``
            or ``similarity``.
        progress: Display of progress; on stderr by default.

    Returns:
        evaluation: ``chamfer_m``, ``fscore`` and the others of
            :func:`sononerf.evaluation.metrics.geometry_metrics`; ``baseline`` where echoes are
            given.

    Raises:
        InputError: If an argument is no surface.
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
