# SPDX-License-Identifier: MIT
"""When sound can arrive at the earliest, and that nothing is heard before."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.scene.scene import Scene
from sononerf.simulation.impulse_response import NODE_SPACING

FINE = 0.05
"""Distance between points at which the first arrival is sought, in radii of a sphere around the
scene. The path is then at most 0.1 % of that radius too long."""
SILENT = 0.21 / NODE_SPACING
"""Time before the first arrival up to which the echo is zero, s (26 us). With half an analysis
window of 32 us nothing is heard more than 10 mm before the nearest point."""


class Arrival:
    """The shortest ways from an emitter over the surface of a scene to an ear.

    Parameters
    ----------
    scene : Scene
        What is ensonified.

    Attributes
    ----------
    radius : float, m
        Of a sphere around the scene.
    """

    def __init__(self, scene: Scene) -> None:
        corners = np.asarray(scene.mesh.vertices, dtype=np.float64)[np.asarray(scene.mesh.faces)]
        corners = corners.reshape(-1, 3)
        self._middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
        self.radius = float(np.linalg.norm(corners - self._middle, axis=1).max())
        vertices, faces = trimesh.remesh.subdivide_to_size(
            scene.mesh.vertices, scene.mesh.faces, FINE * self.radius, max_iter=20
        )
        used = np.asarray(vertices, dtype=np.float64)[np.unique(faces)]
        self._points: NDArray[np.float64] = np.unique(used, axis=0) - self._middle

    def shortest(
        self, emitters: NDArray[np.float64], ears: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the shortest way (P, E), m.

        Parameters
        ----------
        emitters : (P, 3) float64, m
            World frame.
        ears : (P, E, 3) float64, m
            World frame.
        """
        found = np.zeros(ears.shape[:2])
        square = np.einsum("nd,nd->n", self._points, self._points)
        for pose, heads in enumerate(np.concatenate([emitters[:, None], ears], axis=1)):
            heads = heads - self._middle
            # Products suffice: coordinates count from the middle of the scene.
            way = square - 2.0 * heads @ self._points.T
            way += np.einsum("hd,hd->h", heads, heads)[:, None]
            np.sqrt(np.maximum(way, 0.0, out=way), out=way)
            found[pose] = (way[:1] + way[1:]).min(axis=1)
        return found


def silence_before(
    echo: NDArray[np.float64], first: NDArray[np.float64], *, sampling_rate: float
) -> NDArray[np.float64]:
    """Cut off what comes before sound can arrive.

    Beam and ears are real gains, so their responses are even in time: half of them comes before
    the echo. Everything that is more than 26 us earlier than the first possible arrival is set to
    zero. Onsets and free space are then found from sound that has arrived.

    Parameters
    ----------
    echo : (E, S) float64
        Pressure from the emission on.
    first : (E,) float64, s
        First possible arrival at each ear.
    sampling_rate : float, Hz
        Of the echo.

    Returns
    -------
    echo : (E, S) float64
        Zero up to 26 us before the first arrival, whole from there on.
    """
    before = first[:, None] - np.arange(echo.shape[1]) / sampling_rate
    return np.where(before < SILENT, echo, 0.0)
