# SPDX-License-Identifier: MIT
"""A reconstructed surface, and the baselines that need no learning, beside the true surface."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.echoes.echoes import Echoes
from sononerf.errors import NumericalError
from sononerf.evaluation.baseline import backprojection, best_level_surface
from sononerf.evaluation.metrics import geometry_metrics, target_metrics
from sononerf.evaluation.registration import Kind, Registration, register
from sononerf.evaluation.solid import Solid
from sononerf.evaluation.voxels import voxel_fit
from sononerf.geometry.poses import Poses
from sononerf.scene.scene import Scene
from sononerf.surface.start.volume import Volume

BASELINE_VOXELS = 64
"""Voxels of a baseline along the region's longest side: finer than the window in any scene of
ours."""


class Truth:
    """A true surface, laid over a reconstruction.

    Args:
        true: The true surface, m.
        mesh: The reconstruction, m.
        kind: What lays the reconstruction over the truth; baselines are moved alike.
    """

    def __init__(self, true: trimesh.Trimesh, mesh: trimesh.Trimesh, kind: Kind) -> None:
        self.surface = Solid(true)
        self.kind: Kind = kind
        self.motion: Registration = register(mesh, true, kind)
        self.mesh = self.motion.of(mesh)
        # The truth in the frame of the reconstruction, in which levels of baselines are chosen.
        self._near = self.surface if kind == "none" else Solid(self.motion.inverse().of(true))

    def of_reconstruction(self, scene: Scene | None = None) -> dict[str, Any]:
        """Return the metrics of the reconstruction; of a scene with a target, also of that alone.

        The README's table names them.
        """
        found = geometry_metrics(self.mesh, self.surface)
        if self.kind != "none":
            found["registration"] = {
                "kind": self.kind,
                "scale": self.motion.scale,
                "matrix": self.motion.matrix.tolist(),
            }
        surroundings = None if scene is None else scene.surface(background=True)
        target = None if scene is None else scene.surface(background=False)
        if surroundings is not None and target is not None:
            found["target"] = target_metrics(self.mesh, target, surroundings)
        return found

    def of_volume(self, volume: Volume) -> dict[str, Any] | None:
        """Return the metrics of a baseline at its best level; None where it has no surface."""
        try:
            mesh, level = best_level_surface(volume, self._near)
        except NumericalError:
            return None
        return {**geometry_metrics(self.motion.of(mesh), self.surface), "level": level}


def baselines(
    echoes: Echoes, lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> Iterator[tuple[str, Volume]]:
    """Yield names and volumes of what needs no learning: backprojection and voxel fit.

    Args:
        echoes: Whose training poses are used.
        lower, upper ((3,), m): Corners of the region.
    """
    store = echoes.store
    train = store.indices("train")
    poses = Poses(echoes.positions[train], echoes.rotations[train])
    spacing = float((upper - lower).max()) / BASELINE_VOXELS
    for name, baseline in (("backprojection", backprojection), ("voxels", voxel_fit)):
        heard = (store.read_pose(int(index)) for index in train)
        yield name, baseline(heard, poses, echoes.head, lower, upper, spacing)
