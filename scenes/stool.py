# SPDX-License-Identifier: MIT
"""A stool: thin legs, quiet under a flat round seat that is loud."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import Delaunay, cKDTree

from sononerf.errors import SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene

from .bodies import SIDE, Degrees, Length, Radius, Wire, placed
from .lathe import lathe

OUT = 0.75
"""Distance of the legs from the middle, in radii of the seat."""
SPACING = 0.8 * SIDE
"""Spacing of points under the seat, m; edges next to rims are up to 1.7 times as long."""
FROM_RIM = 0.72 * SIDE
"""Least distance of these points from the rims, m. Sides of the rims are at most SIDE long: beyond
half the
root of 2 of that, no point lies in the circle over a side, so a triangulation keeps it."""

Legs = Annotated[int, Field(ge=3, le=12)]
Thickness = Annotated[float, Field(ge=5e-4, le=0.05)]
"""In m."""


def stool(
    legs: Legs = 3,
    seat_radius: Radius = 0.05,
    seat_thickness: Thickness = 0.006,
    leg_length: Length = 0.06,
    leg_radius: Wire = 0.003,
    yaw: Degrees = 0.0,
    pitch: Degrees = 0.0,
    roll: Degrees = 0.0,
    material: MaterialName = "rigid",
) -> Scene:
    """Build a stool: number of legs, radius and thickness of the seat, length and radius of a leg.

    Lengths are in m. The stool is turned by yaw, pitch and roll (degrees).
    """
    out = OUT * seat_radius
    limit, why = min(
        (seat_radius - out - SIDE, "the legs would reach the rim"),
        (out * math.sin(math.pi / legs) - SIDE / 2.0, "the legs would touch"),
    )
    if leg_radius > limit:
        raise SettingsError(
            f"scene.options.leg_radius: found {leg_radius:g}; must not exceed {limit:.3g}, "
            f"else {why}"
        )
    seat = lathe([(seat_radius, 0.0), (seat_radius, seat_thickness), (0.0, seat_thickness)])
    leg = lathe([(0.0, -leg_length), (leg_radius, -leg_length), (leg_radius, 0.0)])
    angle = 2.0 * np.pi * np.arange(legs) / legs
    feet = [
        leg.copy().apply_translation((out * math.cos(turn), out * math.sin(turn), 0.0))
        for turn in angle
    ]
    rims = [_circle_at(part, 0.0) for part in (seat, *feet)]
    mesh = _joined([seat, *feet, _underside(rims)])
    return Scene(placed(mesh, yaw, pitch, roll), MATERIALS[material])


def _circle_at(part: trimesh.Trimesh, height: float) -> NDArray[np.float64]:
    """Return the vertices (N, 2) of a part at a height (m)."""
    vertices = np.asarray(part.vertices)
    return vertices[vertices[:, 2] == height, :2]


def _underside(rims: list[NDArray[np.float64]]) -> trimesh.Trimesh:
    """Fill what lies within the first rim and outside the others; it faces down."""
    edge = np.concatenate(rims)
    rise, reach = SPACING * math.sqrt(0.75), float(np.abs(rims[0]).max())
    rows, columns = math.ceil(reach / rise), math.ceil(reach / SPACING) + 1
    row, column = np.mgrid[-rows : rows + 1, -columns : columns + 1]
    lattice = np.stack([(column + 0.5 * (row % 2)) * SPACING, row * rise], axis=-1).reshape(-1, 2)
    distance, _ = cKDTree(edge).query(lattice)
    clear = (distance > FROM_RIM) & (np.linalg.norm(lattice, axis=1) < reach)
    for rim in rims[1:]:
        middle = rim.mean(axis=0)
        clear &= np.linalg.norm(lattice - middle, axis=1) > np.linalg.norm(rim[0] - middle)
    points = np.concatenate([edge, lattice[clear]])
    triangles = Delaunay(points).simplices
    corners = points[triangles]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    upward = a[:, 0] * b[:, 1] > a[:, 1] * b[:, 0]
    triangles[upward] = triangles[upward][:, ::-1]
    # Whose triangles have all three corners on a leg's rim close the leg's hole.
    owner = np.full(len(points), -1)
    owner[len(rims[0]) : len(edge)] = np.repeat(
        np.arange(len(rims) - 1), [len(rim) for rim in rims[1:]]
    )
    of = owner[triangles]
    hole = (of[:, 0] >= 0) & (of[:, 0] == of[:, 1]) & (of[:, 0] == of[:, 2])
    flat = np.pad(points, ((0, 0), (0, 1)))
    return trimesh.Trimesh(flat, triangles[~hole], process=False)


def _joined(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Join parts where they have the very same vertices."""
    whole = trimesh.util.concatenate(parts)
    vertices, index = np.unique(np.asarray(whole.vertices), axis=0, return_inverse=True)
    return trimesh.Trimesh(vertices, index.reshape(-1)[whole.faces], process=False)
