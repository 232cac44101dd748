# SPDX-License-Identifier: MIT
"""What the bundle around a ray lights, and how long the paths over it are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sononerf.array_types import Floats, Ints, Singles


@dataclass(frozen=True, eq=False)
class Footprint:
    """Of rays that hit a surface, by ray differentials [1]_; components first, rays last.

    Directions at the emitter are turned by u and v (rad) about two axes square to the ray.

    Attributes:
        shift ((2, 3, H) float32, m/rad): How the hit moves on the surface over u and over v.
        square ((3, H) float32, m²/rad²): Products of the shifts: of the first with itself, the
            second with itself, of both.
        bend ((3, H) float32, m/rad²): How the path to the hit bends over u twice, v twice, u and v,
            on a flat surface.
        curving ((3, H) float32, m/rad²): How far the surface falls off from the flat one, likewise.
        onward ((2, H) float32, m/rad): Shifts along the mirrored ray.
        sink ((H,) float32): Cosine between the ray and the outward normal, below zero.
        tube ((H,) float32, m²/sr): Cross-section of the bundle.

    References:
        .. [1] H. Igehy, "Tracing ray differentials", SIGGRAPH 1999.
    """

    shift: Singles
    square: Singles
    bend: Singles
    curving: Singles
    onward: Singles
    sink: Singles
    tube: Singles

    def __getitem__(self, chosen: Ints) -> Footprint:
        """Return those of the chosen hits."""
        parts = (
            self.shift, self.square, self.bend, self.curving, self.onward, self.sink, self.tube,
        )  # fmt: skip
        return Footprint(*(part.take(chosen, axis=-1) for part in parts))

    def detour(
        self, towards: Singles, rise: Singles, distance: Singles, solid_angle: float | Floats
    ) -> tuple[Singles, Singles, Singles]:
        r"""How much longer a path is than the mirror's nearby, and how it varies over a ray's cell.

        To second order, the path's length over u and v has the slope :math:`g` and the Hessian
        :math:`H`; the path by which a mirror would send the sound is shorter (or longer) by
        :math:`g^T |H|^{-1} g / 2`.

        Args:
            towards ((3, H) float32): Unit vectors from the hits to the listener.
            rise ((H,) float32): Their cosine to the outward normal.
            distance ((H,) float32, m): From the hits to the listener.
            solid_angle (float or (H,) float64, sr): Of the cell, taken as a square.

        Returns:
            detour ((H,) float32, m): Zero or more.
            spread ((H,) float32, m): Standard deviation of the path's length over the cell.
            stiffness ((H,) float32, m/rad²): The greater eigenvalue of :math:`|H|`.
        """
        off = np.einsum("kdn,dn->kn", self.shift, towards)
        # From the mirror direction and not from the incoming one: the same on the smooth surface
        # that the triangles stand for, without their facets.
        g1, g2 = self.onward - off
        curve = self.bend + (rise - self.sink) * self.curving
        near = np.float32(1.0) / distance
        h11 = curve[0] + (self.square[0] - off[0] * off[0]) * near
        h22 = curve[1] + (self.square[1] - off[1] * off[1]) * near
        h12 = curve[2] + (self.square[2] - off[0] * off[1]) * near
        middle, half = 0.5 * (h11 + h22), np.hypot(0.5 * (h11 - h22), h12)
        # |H|^-1 is a I + b H, with a and b such that both eigenvalues fit.
        high, low = np.abs(middle + half), np.abs(middle - half)
        stiffness = np.maximum(high, low)
        tiny = np.float32(1e-6) * stiffness + np.float32(1e-12)
        f_high, f_low = 1.0 / np.maximum(high, tiny), 1.0 / np.maximum(low, tiny)
        b = (f_high - f_low) / np.maximum(2.0 * half, tiny)
        a = f_high - b * (middle + half)
        slope = g1 * g1 + g2 * g2
        detour = 0.5 * (a * slope + b * (h11 * g1 * g1 + h22 * g2 * g2 + 2.0 * h12 * g1 * g2))
        # Over a square of side 1, u has the variance 1/12, u²/2 1/720 and u v 1/144.
        angle = np.asarray(solid_angle, dtype=np.float32)
        variance = slope * (angle / 12.0) + (h11 * h11 + h22 * h22) * (angle * angle / 720.0)
        variance += h12 * h12 * (angle * angle / 144.0)
        return np.maximum(detour, 0.0), np.sqrt(variance), stiffness


def dots(a: Singles, b: Singles) -> Singles:
    """Scalar products (..., N) of vectors (..., 3, N) and (3, N)."""
    found: Singles = np.einsum("...dn,dn->...n", a, b)
    return found


def pairs(a: Singles, b: Singles) -> Singles:
    """Products (3, N) of two and two vectors (2, 3, N): first, second, first with second."""
    return np.stack([dots(a[0], b[0]), dots(a[1], b[1]), dots(a[0], b[1])])


def across(directions: Singles) -> Singles:
    """Two unit vectors (2, 3, N) square to each direction (3, N) and to each other.

    Source: T. Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    x, y, z = directions
    sign = np.where(z >= 0.0, np.float32(1.0), np.float32(-1.0))
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.stack(
        [
            np.stack([1.0 + sign * x * x * a, sign * b, -sign * x]),
            np.stack([b, sign + y * y * a, -y]),
        ]
    )


def land(
    shift: Singles,
    turn: Singles,
    *,
    incoming: Singles,
    flat: Singles,
    normals: Singles,
    gradients: Singles,
) -> tuple[Footprint, Singles]:
    """Let bundles fall on the surface.

    Args:
        shift ((2, 3, H) float32, m/rad): How the rays move square to themselves over u and v;
            overwritten.
        turn ((2, 3, H) float32): How their directions turn.
        incoming ((3, H) float32): Their directions.
        flat, normals ((3, H) float32): Of the triangle and of the smooth surface, unit vectors on
            the side of the ray.
        gradients ((4, 3, H) float32): Of the weights of the second and third corner, and by how
            much the smooth normals there differ from that at the first, on the side of the ray.

    Returns:
        footprint: On the surface.
        turned ((2, 3, H) float32): How the mirrored directions turn.
    """
    sink = np.minimum(dots(incoming, flat), np.float32(-1e-6))
    tube = np.abs(dots(_cross(shift[0], shift[1]), incoming))
    along = dots(incoming, normals)
    turned = np.zeros_like(turn)
    tilts = np.zeros_like(turn)
    to_second, to_third, second, third = gradients
    for k in range(2):
        shift[k] -= (dots(shift[k], flat) / sink) * incoming
        tilt = dots(shift[k], to_second) * second
        tilt += dots(shift[k], to_third) * third
        tilt -= dots(tilt, normals) * normals
        tilts[k] = tilt
        change = dots(turn[k], normals) + dots(tilt, incoming)
        turned[k] = turn[k] - 2.0 * (change * normals + along * tilt)
    onward = dots(shift, incoming) - 2.0 * along * dots(shift, normals)
    return (
        Footprint(
            shift, pairs(shift, shift), pairs(shift, turn), pairs(shift, tilts), onward, sink, tube
        ),
        turned,
    )


def _cross(a: Singles, b: Singles) -> Singles:
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
