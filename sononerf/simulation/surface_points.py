# SPDX-License-Identifier: MIT
"""Points of a surface, the same for all poses, over which the first bounce is summed."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from sononerf.geometry.meshes import bodies
from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Bools, Floats, Ints
from sononerf.simulation.footprint import Footprint, emit_bundles, land
from sononerf.simulation.paths import Bounce

LARGEST_CELL = 0.5
"""Greatest side of a cell, wavelengths at ``RESOLVED_FREQUENCY``. With one wavelength a rough plate
is 7 % too quiet at 90 kHz, with half of it 2 %."""
SMALLEST_CELL = 1.0 / 16.0
"""Least side of a cell, wavelengths: what is more curved than that asks for sends little."""
BEND = 1.0
"""Bend of the path over a cell by the curvature of the surface, rad; with 0.25 three
spheres change by 0.03 dB over active cells."""
MOST_CELLS = 200_000
"""Number of cells above which all of them are larger, so that a room fits into memory."""
PIECES = 2
"""Pieces of a triangle along a side of a cell. Each goes to one cell as a whole."""


class SurfacePoints:
    r"""Cells of a surface, each with a point that stands for it.

    Triangles are cut into pieces, and those of one body that face to one side are joined by a cubic
    grid. The sides of its cells are such that the path by a cell bends by one radian, by halves
    from half a wavelength down. The area :math:`dA` at the distance :math:`r` is lit by
    :math:`d\Omega = \cos\vartheta\, dA / r^2`.

    In: wavelength (m), closed (T,).

    Attributes:
        area ((N,), m²): Area of each cell.
    """

    def __init__(
        self, mesh: trimesh.Trimesh, caster: RayCaster, closed: Bools, *, wavelength: float
    ) -> None:
        corners = np.asarray(mesh.triangles, dtype=np.float64)
        body = bodies(mesh)
        # On both sides of an open surface there is air; of a closed one on that which is outside.
        volume = np.einsum("td,td->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        inside_out = np.bincount(body, volume)[body] < 0.0
        self._outside = np.where(closed, np.where(inside_out, -1.0, 1.0), 0.0)
        size: Floats = _cell_sizes(caster.curvature, np.asarray(mesh.area_faces), wavelength)
        longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
        parts = np.maximum(np.ceil(PIECES * longest / size), 1.0).astype(np.int64)
        owner, middle = _divided(corners, parts)
        area = (np.asarray(mesh.area_faces) / np.square(parts))[owner]
        normal = caster.face_normals[owner]
        side = np.abs(normal).argmax(axis=1)
        faces = 2 * side + (np.take_along_axis(normal, side[:, None], axis=1)[:, 0] > 0.0)
        # Counted from the middle: the same for a scene turned by a right angle, or mirrored.
        off = middle - 0.5 * (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1)))
        at = np.floor(off / size[owner, None] + 0.5).astype(np.int64)
        halved = np.round(np.log2(size / wavelength)).astype(np.int64)[owner]
        cell: Ints = np.zeros(len(owner), dtype=np.int64)
        for column in (*at.T, halved, body[owner], faces):
            column = column - column.min()
            cell = np.unique(cell * (column.max() + 1) + column, return_inverse=True)[1]
        whole = np.bincount(cell, area).astype(np.float64)
        weight = np.maximum(whole, 1e-300)
        centre = np.stack([np.bincount(cell, area * part) / weight for part in middle.T], axis=1)
        distance = np.square(middle - centre[cell]).sum(axis=1)
        order = np.lexsort((distance, cell))
        nearest = order[np.flatnonzero(np.diff(cell[order], prepend=-1))]
        kept = np.flatnonzero(whole > 0.0)
        self._hits = caster.on_triangles(centre[kept], owner[nearest[kept]])
        self.area = whole[kept]

    def lit_from(self, emitter: Floats) -> Bounce:
        """Return the first bounce at all points whose outside faces an emitter (3,), m."""
        hits = self._hits
        onward = hits.points - emitter
        sink = np.einsum("nd,nd->n", onward, hits.flat)
        facing = np.flatnonzero(sink * self._outside[hits.triangle] <= 0.0)
        onward, sink = onward.take(facing, axis=0), sink.take(facing)
        length = np.sqrt(np.einsum("nd,nd->n", onward, onward))
        onward /= length[:, None]
        triangle = hits.triangle.take(facing)
        rows, _, flat, mirrored = land(
            emit_bundles(onward, length),
            onward,
            hits.normals.take(facing, axis=0),
            hits.flat.take(facing, axis=0),
            hits.gradients.take(facing, axis=0),
        )
        solid_angle = np.abs(sink) / length**3 * self.area.take(facing)
        return Bounce(
            1, solid_angle, facing, onward, hits.points.take(facing, axis=0), flat, mirrored,
            length, Footprint(rows), triangle[:, None],
        )  # fmt: skip


def _cell_sizes(curvature: Floats, area: Floats, wavelength: float) -> Floats:
    """Return the side of the cells (T,), m, by the curvature (T,), 1/m, of each triangle."""
    bent = np.sqrt(BEND / (4.0 * math.pi / wavelength * np.maximum(curvature, 1e-300)))
    side = np.clip(bent / wavelength, SMALLEST_CELL, LARGEST_CELL)
    size = np.exp2(np.floor(np.log2(side) + 1e-9)) * wavelength
    cells = float((area / np.square(size)).sum())
    while cells > MOST_CELLS:
        size, cells = 2.0 * size, cells / 4.0
    return size


def _divided(corners: Floats, parts: Ints) -> tuple[Ints, Floats]:
    """Cut triangles into ``parts`` squared equal ones; return owner (N,) and middles (N, 3), m."""
    owners, middles = [], []
    for count in np.unique(parts):
        chosen = np.flatnonzero(parts == count)
        i, j = (part.ravel() for part in np.indices((count, count)))
        upright, turned = i + j < count, i + j < count - 1
        second = np.concatenate([i[upright] + 1.0 / 3.0, i[turned] + 2.0 / 3.0]) / count
        third = np.concatenate([j[upright] + 1.0 / 3.0, j[turned] + 2.0 / 3.0]) / count
        weights = np.stack([1.0 - second - third, second, third], axis=1)
        owners.append(np.repeat(chosen, len(weights)))
        middles.append(np.einsum("wc,tcd->twd", weights, corners[chosen]).reshape(-1, 3))
    return np.concatenate(owners), np.concatenate(middles)
