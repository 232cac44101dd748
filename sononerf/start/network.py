# SPDX-License-Identifier: MIT
"""The start surface, by a network that reads the levels of all poses, without a fitted field.

In: levels over range and onsets. Out: a closed mesh, m. A U-Net [1]_ takes the features of all
places (:mod:`sononerf.start.features`) and returns the signed distance [2]_; lengths are in range
resolutions. Section 4 of ``docs/method.md``.

References:
    .. [1] O. Ronneberger, P. Fischer, T. Brox, "U-Net: convolutional networks for biomedical image
       segmentation", 2015.
    .. [2] Z. Murez et al., "Atlas: end-to-end 3D scene reconstruction from posed images", 2020.
"""

from __future__ import annotations

import math
from contextlib import suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import trimesh
from safetensors import SafetensorError
from safetensors.torch import load_file
from scipy import ndimage
from torch import Tensor, nn

from sononerf.echoes.detection import RangeLevels
from sononerf.echoes.free_space import EchoHull
from sononerf.errors import IncompatibleError, NumericalError
from sononerf.geometry.lattice import MARGIN, Lattice, level_surface
from sononerf.numerics import Floats, Ints, Singles
from sononerf.start.features import (
    FEATURES,
    PlaceFeatures,
    clearance_grid,
    features_of,
    free_places,
)
from sononerf.start.sheet import fit_sheet

StartMethod = Literal["levels", "fuller", "sheet", "isosurface", "given"]
"""Start of a refinement. ``levels``: the surface of the network. ``fuller``: that with gaps closed.
``sheet``: a thin body through what the network finds. ``isosurface``: a level of the field's
volume. ``given``: a surface of the user's."""
WEIGHTS = Path(__file__).with_name("network.safetensors")
"""File of the trained weights, float16."""
VOXEL = 0.25
"""Spacing of the signed distance, range resolutions: walls of half a range resolution have two
voxels. Features have twice this spacing."""
MAX_VOXELS = 3_000_000
"""Number of voxels, at most; a larger body gets a coarser lattice. The network takes about 1 µs of
one core per voxel."""
OUTSIDE = 4.0
"""Distance outside of the lattice, voxels; the training clips larger ones to it."""
FULLER_DISTANCE = 0.4
"""Distance outside of the surface at which the fuller one lies, voxels. A refinement thins a body
but does not close gaps in it: four letters, refined from here, lose less of their strokes, with
twice this distance they run together (``docs/notes/surface.md``)."""
LOGIT = 0.7
"""Distance at which the logit of the probability that a voxel is outside is 1, voxels; the same in
the training."""
SURE_DISTANCE = 3.0
"""Distance from which a voxel is taken to be outside, voxels. Farther voxels are many, and their
small probabilities would add up."""
BLOCK = 16
"""Number of voxels along an axis that are one voxel at the coarsest level of the network."""
PAIRS = 320
"""Number of pose-ear pairs of one pass of the network, at most: as many as in the training. More
are parted at random into lots, whose signed distances are averaged."""
FRAMES = (((0, 1, 2), (1, 1, 1)), ((1, 2, 0), (-1, -1, 1)), ((2, 0, 1), (1, -1, -1)))
"""Frames in which the network sees the lattice: order of the axes, and their signs. The mean over
four frames raises the median F-score at 2 mm of 19 withheld bodies from 0.83 to 0.84, the least
from 0.59 to 0.65; eight frames give no more."""
CHANNELS = (48, 80, 112, 144)
"""Channels of the network, from fine to coarse."""
FEWEST_POSES, NARROWEST_CAP, LARGEST_BODY = 12, 53, 26
"""Of the training: number of poses and half-angle of the cap that they lie on, degrees, at least;
longest side of a body, range resolutions, at most."""
_RESOLVED = 8  # voxels of the smallest part
_ROOM = 1.0  # distance in front of the onsets that the lattice covers, steps of the search


def lattice_of(hull: EchoHull, box: Floats, resolution: float) -> Lattice | None:
    """Return the lattice over all places that the onsets leave; None if they leave none.

    In: box ((2, 3), m), resolution (m).
    """
    step = max(resolution, float(np.prod(box[1] - box[0]) / MAX_VOXELS) ** (1 / 3))
    coarse = Lattice.over(box[0], box[1], step)
    left = np.argwhere(clearance_grid(hull, coarse) > -_ROOM * step)
    if not len(left):
        return None
    lower = coarse.origin + coarse.spacing * (left.min(axis=0) - 1.5)
    upper = coarse.origin + coarse.spacing * (left.max(axis=0) + 1.5)
    spacing = max(VOXEL * resolution, float(np.prod(upper - lower) / MAX_VOXELS) ** (1 / 3))
    blocks = np.ceil((upper - lower) / (BLOCK * spacing)).astype(int)
    x, y, z = (int(n) * BLOCK for n in blocks)
    origin = (lower + upper) / 2 - spacing * (np.array([x, y, z]) - 1) / 2
    return Lattice(origin, spacing, (x, y, z))


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.n1, self.c1 = nn.GroupNorm(8, channels), nn.Conv3d(channels, channels, 3, padding=1)
        self.n2, self.c2 = nn.GroupNorm(8, channels), nn.Conv3d(channels, channels, 3, padding=1)
        for part in self.c2.parameters():
            nn.init.zeros_(part)

    def forward(self, values: Tensor) -> Tensor:
        silu = nn.functional.silu
        return values + self.c2(silu(self.n2(self.c1(silu(self.n1(values))))))


def _blocks(channels: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(_Residual(channels) for _ in range(count)))


class StartNetwork(nn.Module):
    """U-Net from features to the signed distance, eight voxels of it for each place.

    It adds to the bound of free space.
    """

    def __init__(self, channels: tuple[int, ...] = CHANNELS) -> None:
        super().__init__()
        first, steps = channels[0], list(pairwise(channels))
        self.enter = nn.Sequential(
            nn.Conv3d(FEATURES, 2 * first, 1), nn.SiLU(), nn.Conv3d(2 * first, first, 1)
        )
        self.down = nn.ModuleList(_blocks(c, 1 if c == first else 2) for c in channels)
        self.pool = nn.ModuleList(nn.Conv3d(a, b, 2, stride=2) for a, b in steps)
        self.widen = nn.ModuleList(
            nn.ConvTranspose3d(b, a, 2, stride=2) for a, b in reversed(steps)
        )
        self.up = nn.ModuleList(_blocks(a, 1 if a == first else 2) for a, _ in reversed(steps))
        self.leave = nn.Sequential(nn.GroupNorm(8, first), nn.SiLU(), nn.Conv3d(first, 8, 1))

    def forward(self, features: Tensor, bound: Tensor) -> Tensor:
        """Return the signed distance, voxels, positive outside, (B, 2X, 2Y, 2Z).

        In: features (B, FEATURES, X, Y, Z), bound ((B, X, Y, Z), voxels).
        """
        batch, _, x, y, z = features.shape
        values = self.enter(features.contiguous(memory_format=torch.channels_last_3d))
        levels = [self.down[0](values)]
        for pool, down in zip(self.pool, self.down[1:], strict=True):
            levels.append(down(pool(levels[-1])))
        values = levels.pop()
        for widen, up in zip(self.widen, self.up, strict=True):
            values = up(widen(values) + levels.pop())
        values_out = self.leave(values).float().unflatten(1, (2, 2, 2))
        values_out = values_out.permute(0, 4, 1, 5, 2, 6, 3).reshape(batch, 2 * x, 2 * y, 2 * z)
        free = nn.functional.interpolate(
            bound[:, None].clamp(-6, 6), scale_factor=2, mode="trilinear", align_corners=False
        )
        return 2.0 * values_out + free[:, 0]


def trained_network() -> StartNetwork:
    """Return the network with the weights of the package.

    Raises:
        IncompatibleError: If they are those of another version, or damaged.
    """
    network = StartNetwork()
    try:
        network.load_state_dict({name: part.float() for name, part in load_file(WEIGHTS).items()})
    except (RuntimeError, SafetensorError, OSError):
        raise IncompatibleError(
            f"{WEIGHTS}: not the weights of the start network of this version; install it again"
        ) from None
    return network.eval()


_network = cache(trained_network)


def expected_level(distance: Singles) -> float:
    """Return the level at which the volume is the expected one, voxels.

    A wire whose place is known less exactly than it is thick is nowhere likelier than air, so that
    the level 0 would lose it.

    In: distance ((X, Y, Z), voxels).
    """
    near = distance[distance < SURE_DISTANCE].astype(np.float64)
    expected = int((1 / (1 + np.exp(near / LOGIT))).sum())
    return float(np.partition(near, expected)[expected]) if expected < len(near) else SURE_DISTANCE


def beyond_training(levels: RangeLevels, bounds: Floats, *, support: bool = False) -> str:
    """Return in what the echoes are unlike those of the training; empty if in nothing.

    In: bounds ((2, 3), m): Of the body.
    """
    if support:
        return "the body stands on a support, and the start network was trained without one"
    size, middle = float(np.ptp(bounds, axis=0).max() / levels.resolution), bounds.mean(axis=0)
    if size > LARGEST_BODY:
        return (
            f"the body is {size:.0f} range resolutions large, and the start network was "
            f"trained with {LARGEST_BODY} at most"
        )
    if len(levels.poses) < FEWEST_POSES:
        return (
            f"{len(levels.poses)} training poses are fewer than the {FEWEST_POSES} of the training "
            "of the start network"
        )
    out = levels.emitters - middle
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    axis = out.mean(axis=0)
    least = float((out @ axis).min() / max(np.linalg.norm(axis), 1e-9))
    widest = math.degrees(math.acos(max(-1.0, min(least, 1.0))))
    if widest < NARROWEST_CAP:
        return (
            f"all poses lie within {widest:.0f} degrees of one direction, and the start network "
            f"was trained with {NARROWEST_CAP} and more"
        )
    return ""


def lots_of(levels: RangeLevels) -> list[Ints]:
    """Return the poses of each pass, parted at random; the order of the poses does not matter."""
    poses = np.lexsort(levels.emitters.T)
    count = max(1, -(-levels.level[:, :, 0, 0].size // PAIRS))
    count = min(count, len(poses))
    return np.array_split(np.random.default_rng(0).permutation(poses), count)


def predicted_distance(levels: RangeLevels, hull: EchoHull, lattice: Lattice) -> Singles:
    """Return the signed distance by the network, (X, Y, Z) voxels, positive outside."""
    free = free_places(hull, lattice)
    lots = lots_of(levels)
    passes = max(len(FRAMES), len(lots))
    mean = np.zeros(lattice.shape, np.float32)
    for first, some in enumerate(lots):
        places = features_of(levels, some, hull, lattice, free)
        numbers = range(first, passes, len(lots))
        for number in numbers:
            frame = FRAMES[number % len(FRAMES)]
            mean += _in_frame(places, *frame) / np.float32(len(lots) * len(numbers))
    return mean


def _in_frame(places: PlaceFeatures, order: tuple[int, ...], signs: tuple[int, ...]) -> Singles:
    """Return the network's output for a rotated or mirrored frame, in the original frame."""
    seen, bound = places.in_frame(order, signs)
    with torch.no_grad():
        made = _network()(torch.from_numpy(seen)[None], torch.from_numpy(bound)[None])
    back = tuple(axis for axis, sign in enumerate(signs) if sign < 0)
    return np.flip(made[0].numpy(), back).transpose(np.argsort(order))


def start_surfaces(
    levels: RangeLevels, hull: EchoHull, box: Floats, resolution: float
) -> dict[StartMethod, trimesh.Trimesh]:
    """Return the closed surfaces of the body by the network, m, normals outward.

    A sheet is among them only if what the network finds lies on one.

    In: box ((2, 3), m), resolution (m).
    """
    plane = hull.plane
    if plane is not None:
        levels, hull = levels.with_images(plane, len(hull.first)), hull.with_images()
        corners = np.stack(np.meshgrid(*np.transpose(box), indexing="ij"), -1).reshape(-1, 3)
        corners = np.concatenate([corners, plane.mirrored(corners)])
        box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    lattice = lattice_of(hull, box, resolution)
    if lattice is None:
        raise NumericalError("no surface: the first echoes leave no room for a body")
    distance, room = predicted_distance(levels, hull, lattice), clearance_grid(hull, lattice)
    if plane is not None:
        height = plane.height(lattice.points()).reshape(lattice.shape)
        distance = np.maximum(distance, -height / lattice.spacing).astype(np.float32)
        room = np.minimum(room, height)
    if not (distance < SURE_DISTANCE).any():
        raise NumericalError("no surface: the network finds no body in the levels of the echoes")
    distance = distance - np.float32(expected_level(distance))
    made: dict[StartMethod, trimesh.Trimesh] = {
        "levels": _at_level(distance, 0.0, lattice),
        "fuller": _at_level(distance, FULLER_DISTANCE, lattice),
    }
    probability = (1 / (1 + np.exp(distance.clip(-9, 9) / LOGIT))).astype(np.float32)
    with suppress(NumericalError):
        made["sheet"] = fit_sheet(probability, room, lattice, resolution)
    return made


def _at_level(distance: Singles, level: float, lattice: Lattice) -> trimesh.Trimesh:
    """Return the closed surface where a signed distance has a level, voxels."""
    x, y, z = (n + 2 * MARGIN for n in lattice.shape)
    wider = Lattice(lattice.origin - MARGIN * lattice.spacing, lattice.spacing, (x, y, z))
    distance = np.pad(np.minimum(distance - level, OUTSIDE), MARGIN, constant_values=OUTSIDE)
    return surface_of(without_small_parts(without_hollows(distance)), wider)


def without_hollows(distance: Singles) -> Singles:
    """Fill hollows of a signed distance (X, Y, Z): no sound comes out of them."""
    labels, _ = ndimage.label(distance > 0)
    hollow = (labels != labels[0, 0, 0]) & (distance > 0)
    return np.where(hollow, -distance, distance).astype(np.float32)


def without_small_parts(distance: Singles) -> Singles:
    """Leave out parts that the lattice does not resolve, but never all of them.

    In: distance ((X, Y, Z), voxels).
    """
    labels, count = ndimage.label(distance < 0)
    size = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    dropped = np.concatenate(([False], size < min(_RESOLVED, size.max(initial=0))))[labels]
    return np.where(dropped, np.float32(1.0), distance).astype(np.float32)


def surface_of(distance: Singles, lattice: Lattice) -> trimesh.Trimesh:
    """Return the surface of a signed distance (X, Y, Z), voxels, in m."""
    # A voxel on the surface itself would be wrapped in triangles without area.
    near = np.abs(distance) < 1e-3
    off = np.where(near, np.where(distance < 0, -1e-3, 1e-3), distance)
    return level_surface(off, 0.0, lattice.origin, lattice.spacing)
