# SPDX-License-Identifier: MIT
"""Footprints: the area that the bundle around a ray lights, and the paths over it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sononerf.numerics import Floats, Ints, Singles, compiled


@dataclass(frozen=True, eq=False)
class Footprint:
    """Footprints of rays that hit a surface, by ray differentials [1]_.

    Directions at the emitter are turned by u and v (rad) about two axes square to the ray.

    In: rows ((H, 19) float32).

    Attributes:
        shift ((2, 3, H) float32, m/rad): Derivative of the hit point by u and by v.
        square ((3, H) float32, m²/rad²): Products of the shifts: of the first with itself, the
            second with itself, of both.
        bend ((3, H) float32, m/rad²): Second derivatives of the path to the hit, by u twice, v
            twice, u and v, on a flat surface.
        curving ((3, H) float32, m/rad²): Second derivatives of the surface's distance from its
            tangent plane, likewise.
        onward ((2, H) float32, m/rad): Shifts along the mirrored ray.
        sink ((H,) float32): Cosine between the ray and the outward normal, below zero.
        tube ((H,) float32, m²/sr): Cross-section of the bundle.

    References:
        .. [1] H. Igehy, "Tracing ray differentials", SIGGRAPH 1999.
    """

    rows: Singles

    @property
    def shift(self) -> Singles:  # noqa: D102 - see the class
        return self.rows[:, :6].T.reshape(2, 3, -1)

    @property
    def square(self) -> Singles:  # noqa: D102
        return self.rows[:, 6:9].T

    @property
    def bend(self) -> Singles:  # noqa: D102
        return self.rows[:, 9:12].T

    @property
    def curving(self) -> Singles:  # noqa: D102
        return self.rows[:, 12:15].T

    @property
    def onward(self) -> Singles:  # noqa: D102
        return self.rows[:, 15:17].T

    @property
    def sink(self) -> Singles:  # noqa: D102
        return self.rows[:, 17]

    @property
    def tube(self) -> Singles:  # noqa: D102
        return self.rows[:, 18]


@dataclass(frozen=True, eq=False)
class MirrorPaths:
    r"""Ways from hits to a listener, compared with those by a mirror point nearby.

    To second order, the path's length over u and v has the slope :math:`g` and the Hessian
    :math:`H`; the path by the mirror point is shorter (or longer) by
    :math:`g^T |H|^{-1} g / 2`.
    """

    distance: Floats  # (H,), m: From the hits to the listener
    # (H,): Cosines of the angle between the mirrored ray and the way to the listener
    cosine: Floats
    rise: Singles  # (H,) float32: Cosine between that way and the outward normal
    # (H,) float32, m: Excess of the path over that by the mirror point; zero or more
    detour: Singles
    spread: Singles  # (H,) float32, m: Standard deviation of the path's length over the cell
    stiffness: Singles  # (H,) float32, m/rad²: The greater eigenvalue of :math:`|H|`
    softness: Singles  # (H,) float32, m/rad²: The smaller one


@compiled
def _derivatives(
    row: Singles, point: Floats, flat: Floats, mirrored: Floats, listener: Floats
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return distance, cosine, rise, slopes by u and v, and second derivatives of one path."""
    x, y, z = listener[0] - point[0], listener[1] - point[1], listener[2] - point[2]
    far = math.sqrt(x * x + y * y + z * z)
    near = 1.0 / far
    x, y, z = x * near, y * near, z * near
    rise = x * flat[0] + y * flat[1] + z * flat[2]
    cosine = x * mirrored[0] + y * mirrored[1] + z * mirrored[2]
    off1 = row[0] * x + row[1] * y + row[2] * z
    off2 = row[3] * x + row[4] * y + row[5] * z
    # From the mirror direction and not from the incoming one: the same on the smooth surface
    # that the triangles stand for, without their facets.
    g1, g2 = row[15] - off1, row[16] - off2
    lean = rise - row[17]
    h11 = row[9] + lean * row[12] + (row[6] - off1 * off1) * near
    h22 = row[10] + lean * row[13] + (row[7] - off2 * off2) * near
    h12 = row[11] + lean * row[14] + (row[8] - off1 * off2) * near
    return far, cosine, rise, g1, g2, h11, h22, h12


@compiled
def expand_paths(
    rows: Singles, points: Floats, flat: Floats, mirrored: Floats, listeners: Floats, which: Ints
) -> Floats:
    """Expand paths to second order about their rays, as :func:`paths_to`, over u and v.

    In: rows ((H, 19) float32), points, flat, mirrored (H, 3), listeners ((L, 3), m), which (H,).
    Out: values (8, H): step to the mirror point by u and v (rad), an upper bound of the difference
    to the path by it (m), by how much that is longer (m), root of the determinant of the Hessian,
    its number of negative eigenvalues, and their magnitudes, the smaller and the greater (m/rad²).
    """
    values = np.zeros((8, len(rows)))
    for i in range(len(rows)):
        _, _, _, g1, g2, h11, h22, h12 = _derivatives(
            rows[i], points[i], flat[i], mirrored[i], listeners[which[i]]
        )
        middle, apart = 0.5 * (h11 + h22), 0.5 * (h11 - h22)
        half = math.sqrt(apart * apart + h12 * h12)
        one, other = middle + half, middle - half
        determinant = h11 * h22 - h12 * h12
        safe = determinant if abs(determinant) > 1e-300 else 1e-300
        u, v = (h12 * g2 - h22 * g1) / safe, (h12 * g1 - h11 * g2) / safe
        greatest = max(abs(one), abs(other))
        values[0, i], values[1, i] = u, v
        values[2, i] = 0.5 * (u * u + v * v) * greatest
        values[3, i] = 0.5 * (g1 * u + g2 * v)
        values[4, i] = math.sqrt(abs(determinant))
        values[5, i] = (1.0 if one < 0.0 else 0.0) + (1.0 if other < 0.0 else 0.0)
        values[6, i], values[7, i] = min(abs(one), abs(other)), greatest
    return values


@compiled
def paths_to(
    rows: Singles,
    points: Floats,
    flat: Floats,
    mirrored: Floats,
    listener: Floats,
    solid_angle: Floats,
) -> tuple[Floats, Floats, Singles]:
    """Return the attributes of :class:`Ways`: distance, cosine, and the rest as (5, H).

    In: rows ((H, 19) float32), points, flat, mirrored (H, 3), listener ((3,), m), solid_angle ((H,)
    or (1,), sr).
    """
    count = len(rows)
    distance, cosine = np.zeros(count), np.zeros(count)
    sizes = np.zeros((5, count), np.float32)
    for i in range(count):
        far, along, rise, g1, g2, h11, h22, h12 = _derivatives(
            rows[i], points[i], flat[i], mirrored[i], listener
        )
        middle, apart = 0.5 * (h11 + h22), 0.5 * (h11 - h22)
        half = math.sqrt(apart * apart + h12 * h12)
        # |H|^-1 is a I + b H, with a and b such that both eigenvalues fit.
        high, low = abs(middle + half), abs(middle - half)
        stiffness = max(high, low)
        tiny = 1e-6 * stiffness + 1e-12
        f_high, f_low = 1.0 / max(high, tiny), 1.0 / max(low, tiny)
        b = (f_high - f_low) / max(2.0 * half, tiny)
        a = f_high - b * (middle + half)
        slope = g1 * g1 + g2 * g2
        detour = 0.5 * (a * slope + b * (h11 * g1 * g1 + h22 * g2 * g2 + 2.0 * h12 * g1 * g2))
        # Over a square of side 1, u has the variance 1/12, u²/2 1/720 and u v 1/144.
        angle = solid_angle[i if len(solid_angle) > 1 else 0]
        variance = slope * (angle / 12.0) + (h11 * h11 + h22 * h22) * (angle * angle / 720.0)
        variance += h12 * h12 * (angle * angle / 144.0)
        distance[i], cosine[i] = far, along
        sizes[0, i] = rise
        sizes[1, i] = max(detour, 0.0)
        sizes[2, i] = math.sqrt(variance)
        sizes[3, i] = stiffness
        sizes[4, i] = min(high, low)
    return distance, cosine, sizes


@compiled
def emit_bundles(directions: Floats, length: Floats) -> Singles:
    """Return bundles (N, 12) that an emitter sends over a way, see :func:`land`.

    They are turned at the emitter, not moved there, about two unit vectors that are square to each
    direction and to each other [1]_.

    In: directions (N, 3), length ((N,), m).

    References:
        .. [1] T. Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    bundles = np.zeros((len(directions), 12), np.float32)
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        sign = 1.0 if z >= 0.0 else -1.0
        a = -1.0 / (sign + z)
        b = x * y * a
        turn = bundles[i, 6:]
        turn[0], turn[1], turn[2] = 1.0 + sign * x * x * a, sign * b, -sign * x
        turn[3], turn[4], turn[5] = b, sign + y * y * a, -y
        for k in range(6):
            bundles[i, k] = length[i] * turn[k]
    return bundles


@compiled
def onto(rows: Singles, bends: Singles, further: Ints, distance: Floats) -> Singles:
    """Return mirrored bundles (N, 12) where they are hit next, see :func:`land`.

    In: further (N,), distance ((N,), m).
    """
    bundles = np.zeros((len(further), 12), np.float32)
    for i in range(len(further)):
        before = further[i]
        for k in range(6):
            # Its component along the ray is lost where the bundle lands.
            bundles[i, k] = rows[before, k] + distance[i] * bends[before, k]
            bundles[i, 6 + k] = bends[before, k]
    return bundles


@compiled
def land(
    bundles: Singles, incoming: Floats, normals: Floats, flat: Floats, gradients: Singles
) -> tuple[Singles, Singles, Floats, Floats]:
    """Return footprints of bundles on the surface, and the mirrored bundles.

    In: bundles ((H, 12) float32), incoming (H, 3), normals, flat (H, 3), gradients ((H, 4, 3)
    float32). Out: rows ((H, 19) float32), bends ((H, 6) float32), flat (H, 3), mirrored (H, 3).
    """
    count = len(bundles)
    rows, bends = np.zeros((count, 19), np.float32), np.zeros((count, 6), np.float32)
    outward, mirrored = np.zeros((count, 3)), np.zeros((count, 3))
    tilts = np.zeros(6)
    for i in range(count):
        x, y, z = incoming[i, 0], incoming[i, 1], incoming[i, 2]
        fx, fy, fz = flat[i, 0], flat[i, 1], flat[i, 2]
        sink = x * fx + y * fy + z * fz
        if sink > 0.0:
            fx, fy, fz, sink = -fx, -fy, -fz, -sink
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        # The smooth normals may point either way.
        side = -1.0 if fx * nx + fy * ny + fz * nz < 0.0 else 1.0
        nx, ny, nz = side * nx, side * ny, side * nz
        sink = min(sink, -1e-6)
        along = x * nx + y * ny + z * nz
        outward[i, 0], outward[i, 1], outward[i, 2] = fx, fy, fz
        mirrored[i, 0] = x - 2.0 * along * nx
        mirrored[i, 1] = y - 2.0 * along * ny
        mirrored[i, 2] = z - 2.0 * along * nz
        shift, turn, row, grads = bundles[i, :6], bundles[i, 6:], rows[i], gradients[i]
        cross = x * (shift[1] * shift[5] - shift[2] * shift[4])
        cross += y * (shift[2] * shift[3] - shift[0] * shift[5])
        cross += z * (shift[0] * shift[4] - shift[1] * shift[3])
        for k in range(2):
            sx, sy, sz = shift[3 * k], shift[3 * k + 1], shift[3 * k + 2]
            tx, ty, tz = turn[3 * k], turn[3 * k + 1], turn[3 * k + 2]
            down = (sx * fx + sy * fy + sz * fz) / sink
            sx, sy, sz = sx - down * x, sy - down * y, sz - down * z
            second = side * (sx * grads[0, 0] + sy * grads[0, 1] + sz * grads[0, 2])
            third = side * (sx * grads[1, 0] + sy * grads[1, 1] + sz * grads[1, 2])
            wx = second * grads[2, 0] + third * grads[3, 0]
            wy = second * grads[2, 1] + third * grads[3, 1]
            wz = second * grads[2, 2] + third * grads[3, 2]
            out = wx * nx + wy * ny + wz * nz
            wx, wy, wz = wx - out * nx, wy - out * ny, wz - out * nz
            change = tx * nx + ty * ny + tz * nz + wx * x + wy * y + wz * z
            bends[i, 3 * k] = tx - 2.0 * (change * nx + along * wx)
            bends[i, 3 * k + 1] = ty - 2.0 * (change * ny + along * wy)
            bends[i, 3 * k + 2] = tz - 2.0 * (change * nz + along * wz)
            row[3 * k], row[3 * k + 1], row[3 * k + 2] = sx, sy, sz
            tilts[3 * k], tilts[3 * k + 1], tilts[3 * k + 2] = wx, wy, wz
            off = sx * nx + sy * ny + sz * nz
            row[15 + k] = sx * x + sy * y + sz * z - 2.0 * along * off
        row[6] = row[0] * row[0] + row[1] * row[1] + row[2] * row[2]
        row[7] = row[3] * row[3] + row[4] * row[4] + row[5] * row[5]
        row[8] = row[0] * row[3] + row[1] * row[4] + row[2] * row[5]
        row[9] = row[0] * turn[0] + row[1] * turn[1] + row[2] * turn[2]
        row[10] = row[3] * turn[3] + row[4] * turn[4] + row[5] * turn[5]
        row[11] = row[0] * turn[3] + row[1] * turn[4] + row[2] * turn[5]
        row[12] = row[0] * tilts[0] + row[1] * tilts[1] + row[2] * tilts[2]
        row[13] = row[3] * tilts[3] + row[4] * tilts[4] + row[5] * tilts[5]
        row[14] = row[0] * tilts[3] + row[1] * tilts[4] + row[2] * tilts[5]
        row[17], row[18] = sink, abs(cross)
    return rows, bends, outward, mirrored
