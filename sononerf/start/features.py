# SPDX-License-Identifier: MIT
"""What the echoes say about places: statistics over all poses, the input of the start network.

In: levels over range, onsets, poses. Out: features on a lattice of half a range resolution, from
any number of poses and receivers in any arrangement, without a fitted field. Section 4 of
``docs/method.md``.

An edge or a corner is heard from nearly everywhere, so that most poses have a level at its range. A
face is heard by few poses, but loudly and from its normal. Inside a body only chance gives levels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sononerf.echoes.detection import RangeLevels
from sononerf.echoes.free_space import EchoHull
from sononerf.geometry.lattice import Lattice
from sononerf.numerics import Bools, Floats, Ints, Singles, compiled
from sononerf.resources import in_threads

HARMONICS = 9
"""Number of spherical harmonics of the direction of a pose, up to order 2."""
KINDS = 15
"""Number of quantities of a pose-ear pair at a place, see :func:`pooled`."""
FEATURES = KINDS * HARMONICS + 6
"""Number of features of a place: the pooled quantities, the least and the fourth distance behind
onsets, the number of pairs, and the direction of the pose with the least one."""
USUAL = 200
"""Number of pairs at which the feature of their number is zero."""
DENSE_DISTANCE = 1.0
"""Distance in front of the onsets, range resolutions, beyond which only every second place along
each axis is computed: a third of the time, and the same F-score at 2 mm to 0.003."""
PART = 4096
"""Number of places that one thread takes at a time, so that all cores end together."""
_COARSER = 4  # voxels between the places of a first look; only saves time
_FARTHEST = 12.0  # voxels behind an onset, or in front of it, at most
_LANES = 16  # KINDS, filled up to the width of a vector register: the loop over them is one step
_LATE = 0.15  # range resolutions in front of an onset, from which a place is in free space
_NEAR = 0.35  # range resolutions, width of the Gaussian of places at the range of an onset


@compiled
def pooled(
    places: Floats,
    emitters: Floats,
    receivers: Floats,
    onsets: Floats,
    table: Singles,
    first: float,
    spacing: float,
    resolution: float,
) -> tuple[Singles, Singles, Singles]:
    """Return the pooled quantities of all pose-ear pairs at places.

    A pair hears a place with the level h over the usual one, spreading removed, at the distance c
    behind the pair's onset. Its quantities are, in this order: seven linear bins of h from -36 to 0
    dB; whether h is a peak, if it is quiet, if it is loud, and times the amplitude a; whether the
    place is at the onset, and that times a; whether it lies in free space; a times the tilt of the
    spectrum; and 1.

    In: places ((N, 3), m), emitters, receivers ((P, 3), (P, E, 3), m), onsets ((P, E), m), minus
    infinity without an onset, table
    (P, E, R, 4), first, spacing, resolution (m). Out: means (N, KINDS, HARMONICS), behind ((N, 4),
    m), direction (N, 3).
    """
    f32 = np.float32
    means = np.zeros((len(places), KINDS, HARMONICS), f32)
    behind = np.full((len(places), 4), np.inf, f32)
    direction = np.zeros((len(places), 3), f32)
    total = np.zeros((HARMONICS, _LANES), f32)
    w, s = np.zeros(_LANES, f32), np.zeros(HARMONICS, f32)
    to_db, to_log = f32(20 / math.log(10)), f32(math.log(10) / 20)
    zero, one, last = f32(0), f32(1), table.shape[2] - 1
    for n in range(len(places)):
        total[:] = 0
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        c0, c1, c2, c3 = np.inf, np.inf, np.inf, np.inf
        for p in range(emitters.shape[0]):
            ex, ey, ez = emitters[p, 0] - x, emitters[p, 1] - y, emitters[p, 2] - z
            out = math.sqrt(ex * ex + ey * ey + ez * ez)
            for e in range(receivers.shape[1]):
                rx = receivers[p, e, 0] - x
                ry = receivers[p, e, 1] - y
                rz = receivers[p, e, 2] - z
                back = math.sqrt(rx * rx + ry * ry + rz * rz)
                c = (out + back) / 2 - onsets[p, e]
                at = ((out + back) / 2 - first) / spacing
                dx, dy, dz = ex + rx, ey + ry, ez + rz
                unit = 1 / max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
                s[0], s[1], s[2], s[3] = one, f32(dx * unit), f32(dy * unit), f32(dz * unit)
                if c < c3:
                    if c < c0:
                        c0, c1, c2, c3 = c, c0, c1, c2
                        direction[n] = s[1:4]
                    elif c < c1:
                        c1, c2, c3 = c, c1, c2
                    elif c < c2:
                        c2, c3 = c, c2
                    else:
                        c3 = c
                if at < 0 or at >= last:
                    continue
                row = int(at)
                part = f32(at - row)
                low = table[p, e, row, 0] + (table[p, e, row + 1, 0] - table[p, e, row, 0]) * part
                high = table[p, e, row, 1] + (table[p, e, row + 1, 1] - table[p, e, row, 1]) * part
                h = table[p, e, row, 2] + (table[p, e, row + 1, 2] - table[p, e, row, 2]) * part
                off = table[p, e, row, 3] + (table[p, e, row + 1, 3] - table[p, e, row, 3]) * part
                h += to_db * math.log(f32(out * back))
                peak = max(one + off / f32(3), zero)
                amplitude = math.exp(to_log * min(max(h, f32(-60)), f32(10)))
                loud = min(max((h + f32(20)) / f32(12), zero), one)
                q = f32(c / (_NEAR * resolution))
                at_onset = math.exp(-q * q)
                height = (min(max(h, f32(-36)), zero) + f32(36)) / f32(6)
                for k in range(7):
                    w[k] = max(one - abs(height - f32(k)), zero)
                w[7], w[8], w[9] = peak * (one - loud), peak * loud, peak * amplitude
                w[10], w[11] = at_onset, at_onset * amplitude
                w[12] = one if c < -_LATE * resolution else zero
                tilt = min(max((high - low) / f32(12), f32(-2)), f32(2))
                w[13] = amplitude * (one + tilt) / f32(2)
                w[14] = one
                s[4], s[5], s[6] = s[1] * s[2], s[2] * s[3], s[3] * s[1]
                for k in range(4, 7):
                    s[k] += s[k]
                s[7] = s[1] * s[1] - s[2] * s[2]
                s[8] = f32(1.5) * s[3] * s[3] - f32(0.5)
                for j in range(HARMONICS):
                    for k in range(_LANES):
                        total[j, k] += s[j] * w[k]
        for k in range(KINDS):
            for j in range(HARMONICS):
                means[n, k, j] = total[j, k] / (emitters.shape[0] * receivers.shape[1])
        behind[n, 0], behind[n, 1], behind[n, 2], behind[n, 3] = c0, c1, c2, c3
    return means, behind, direction


@dataclass(frozen=True, eq=False)
class PlaceFeatures:
    """Features of places on a lattice of two voxels."""

    # X, Y, Z, KINDS, HARMONICS), behind ((X, Y, Z, 4), voxels), direction (X, Y, Z, 3: As of
    # :func:`pooled`
    means: Singles
    behind: Singles
    direction: Singles
    pairs: int  # Number of pose-ear pairs

    def in_frame(self, order: tuple[int, ...], signs: tuple[int, ...]) -> tuple[Singles, Singles]:
        """Return the input of the network in a turned or mirrored frame.

        Out: features (FEATURES, X, Y, Z), bound ((X, Y, Z), voxels).
        """
        back = tuple(axis for axis, sign in enumerate(signs) if sign < 0)

        def permuted(values: Singles) -> Singles:
            return np.flip(values.transpose(*order, *range(3, values.ndim)), back)

        means = np.ascontiguousarray(permuted(self.means)) @ _of_harmonics(order, signs)
        behind = permuted(self.behind)
        direction = permuted(self.direction)[..., list(order)] * np.array(signs, np.float32)
        free = -behind[..., [0, 3]].clip(-_FARTHEST, _FARTHEST) / 6
        pairs = np.full((*behind.shape[:3], 1), math.log(self.pairs / USUAL) / 2, np.float32)
        pooled_ = np.arcsinh(50 * means.reshape(*behind.shape[:3], -1)) / 2.5
        seen = np.concatenate([pooled_, free, pairs, direction], axis=3)
        return np.ascontiguousarray(np.moveaxis(seen, 3, 0)), np.ascontiguousarray(-behind[..., 1])


def _of_harmonics(order: tuple[int, ...], signs: tuple[int, ...]) -> Singles:
    """Return the matrix that turns harmonics of a direction, rows, into those in a frame."""
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    permuted = directions[:, list(order)] * signs
    found = np.linalg.lstsq(harmonics(directions), harmonics(permuted), rcond=None)[0]
    return found.astype(np.float32)


def harmonics(directions: Floats) -> Floats:
    """Return the spherical harmonics (N, HARMONICS) of unit vectors (N, 3), up to order 2."""
    x, y, z = directions.T
    second = (2 * x * y, 2 * y * z, 2 * z * x, x * x - y * y, 1.5 * z * z - 0.5)
    return np.stack([np.ones_like(x), x, y, z, *second], axis=1)


def halved(lattice: Lattice) -> Lattice:
    """Return the lattice of half as many places along each axis, each amid 2 x 2 x 2 voxels."""
    x, y, z = (n // 2 for n in lattice.shape)
    return Lattice(lattice.origin + lattice.spacing / 2, 2 * lattice.spacing, (x, y, z))


def clearance_grid(hull: EchoHull, lattice: Lattice) -> Floats:
    """Return the distance of each voxel behind the onsets, (X, Y, Z) m; exact near zero.

    Out: clearance ((X, Y, Z), m).
    """
    far = lattice.spacing * float(np.linalg.norm(lattice.shape))
    coarse = [np.unique(np.append(np.arange(0, n, _COARSER), n - 1)) for n in lattice.shape]
    corners = np.stack(np.meshgrid(*coarse, indexing="ij"), axis=-1).reshape(-1, 3)
    found = np.minimum(hull.clearance(lattice.origin + lattice.spacing * corners)[0], far)
    values = found.reshape([len(c) for c in coarse])
    for axis, (picked, count) in enumerate(zip(coarse, lattice.shape, strict=True)):
        at = np.interp(np.arange(count), picked, np.arange(len(picked)))
        left = np.minimum(at.astype(int), max(len(picked) - 2, 0))
        part = (at - left).reshape([-1 if a == axis else 1 for a in range(3)])
        right = np.minimum(left + 1, len(picked) - 1)
        values = values.take(left, axis) * (1 - part) + values.take(right, axis) * part
    near = np.abs(values) < _COARSER * lattice.spacing
    places = lattice.origin + lattice.spacing * np.argwhere(near)
    values[near] = np.minimum(hull.clearance(places)[0], far)
    return np.asarray(values)


def free_places(hull: EchoHull, lattice: Lattice) -> Bools:
    """Return the mask (X, Y, Z) of the places of the halved lattice well in front of the onsets."""
    return np.asarray(clearance_grid(hull, halved(lattice)) < -DENSE_DISTANCE * 4 * lattice.spacing)


def features_of(
    levels: RangeLevels, some: Ints, hull: EchoHull, lattice: Lattice, free: Bools
) -> PlaceFeatures:
    """Return the features of the places of a lattice, each of which stands for 2 x 2 x 2 voxels.

    In: some (N,), free (X, Y, Z).
    """
    spacing, unit = lattice.spacing, 4 * lattice.spacing
    half = halved(lattice)
    shape, places = half.shape, half.points()
    steps = np.indices(shape).reshape(3, -1).T
    middle = lattice.origin + spacing * (np.asarray(lattice.shape) - 1) / 2
    emitters, receivers = levels.emitters[some], levels.receivers[some]
    onsets, table = hull.inlier_onsets[levels.poses[some]], levels.table(middle)[some]
    given = (emitters, receivers, onsets, table, levels.first, levels.spacing, unit)
    # In free space the nearest place with even steps stands for all eight around it.
    like = np.where(free.reshape(-1, 1), steps // 2 * 2, steps)
    used, which = np.unique(np.ravel_multi_index(tuple(like.T), shape), return_inverse=True)
    parts = np.array_split(places[used], -(-len(used) // PART))
    of_parts = in_threads(lambda part: pooled(part, *given), parts)
    means, behind, direction = (
        np.concatenate([one[k] for one in of_parts], dtype=np.float32) for k in range(3)
    )
    return PlaceFeatures(
        means[which].reshape(*shape, KINDS, HARMONICS),
        behind[which].reshape(*shape, 4) / np.float32(spacing),
        direction[which].reshape(*shape, 3),
        onsets.size,
    )
