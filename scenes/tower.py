# SPDX-License-Identifier: MIT
"""A stepped tower: flat faces that meet at right angles, outward and inward."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field

from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import SIDE, Degrees, Length, placed

Steps = Annotated[int, Field(ge=2, le=8)]


def tower(
    width: Length = 0.09,
    height: Length = 0.09,
    steps: Steps = 3,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build square storeys, each narrower by the same amount: width and height in all (m).

    It is turned by yaw, pitch and roll (degrees).
    """
    half = width / 2.0 * np.arange(1, steps + 1) / steps
    across = np.concatenate((-half[::-1], half))
    up = height * np.arange(steps + 1) / steps
    # Each block between neighbouring planes belongs to the storeys that reach as far out.
    storey = np.minimum(np.arange(2 * steps - 1), np.arange(2 * steps - 1)[::-1])
    reach = np.minimum(storey[:, None], storey)
    solid = reach[..., None] >= np.arange(steps)
    return Scene(placed(_blocks(across, up, solid), yaw, pitch, roll), MATERIALS[material])


def _blocks(
    across: NDArray[np.float64], up: NDArray[np.float64], solid: NDArray[np.bool_]
) -> trimesh.Trimesh:
    """Return the surface of blocks between planes at places along x and y, and along z (m).

    Args:
        across ((N,), m): Planes along x, and along y.
        up ((M,), m): Planes along z.
        solid (N - 1, N - 1, M - 1): True for blocks of the body; no two of them may share an edge
            alone.
    """
    places = []
    for axis, planes in enumerate((across, across, up)):
        count = np.maximum(1, np.ceil(np.diff(planes) / SIDE)).astype(int)
        solid = np.repeat(solid, count, axis=axis)
        pieces = [
            np.linspace(start, end, number, endpoint=False)
            for start, end, number in zip(planes[:-1], planes[1:], count, strict=True)
        ]
        places.append(np.concatenate([*pieces, planes[-1:]]))
    shape = tuple(len(place) for place in places)
    faces = []
    for axis in range(3):
        padding = [(1, 1) if other == axis else (0, 0) for other in range(3)]
        step = np.diff(np.pad(solid, padding).astype(np.int8), axis=axis)
        for sign in (-1, 1):
            # Solid ends, and faces ahead, where the step is negative.
            corner = np.argwhere(step == sign)
            first, second = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
            around = [np.zeros(3, int), first, first + second, second][::-sign]
            square = np.stack(
                [np.ravel_multi_index((corner + offset).T, shape) for offset in around], axis=1
            )
            faces += [square[:, [0, 1, 2]], square[:, [0, 2, 3]]]
    used, triangles = np.unique(np.concatenate(faces), return_inverse=True)
    indices = np.unravel_index(used, shape)
    vertices = np.stack([place[at] for place, at in zip(places, indices, strict=True)], axis=1)
    return trimesh.Trimesh(vertices, triangles.reshape(-1, 3), process=False)
