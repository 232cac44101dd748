# SPDX-License-Identifier: MIT
"""A scene, the poses around it, and the box that is fitted."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from sononerf.array_types import Bools, Floats, Ints
from sononerf.errors import NumericalError
from sononerf.report.pictures.figure import png_from_pixels
from sononerf.report.pictures.mesh_picture import INK, STEEL, draw_scale_bar, oversampled
from sononerf.report.pictures.shading import (
    DEFAULT_VIEW,
    OVERSAMPLING,
    Camera,
    averaged,
    background,
    camera_for,
    draw_mesh,
)

# Training, validation, test; paler the further away.
NEAR = np.array([[190, 70, 40], [20, 140, 100], [50, 70, 200]])
FAR = np.round(NEAR + 0.7 * (240 - NEAR))
SPLITS = ("train", "validation", "test")
BOX = (90, 110, 130)
# Length of a look, as a share of the picture's height.
LOOK = 0.045


def scene_png(
    mesh: trimesh.Trimesh,
    poses_positions: ArrayLike,
    poses_forward: ArrayLike,
    region_box: tuple[ArrayLike, ArrayLike] | None = None,
    *,
    split: ArrayLike | None = None,
    size: tuple[int, int] = (960, 800),
    view: ArrayLike = DEFAULT_VIEW,
) -> bytes:
    """Draw a scene with where the calls come from and where they go.

    In: poses_positions ((P, 3), m), poses_forward (P, 3), region_box (((3,), (3,)), m), split (P,),
    size (int, int), view (3,).
    """
    heads = np.asarray(poses_positions, dtype=np.float64).reshape(-1, 3)
    looks = np.asarray(poses_forward, dtype=np.float64).reshape(-1, 3)
    kinds = np.zeros(len(heads), dtype=np.int64) if split is None else np.asarray(split)
    if not len(mesh.faces):
        raise NumericalError("there is nothing to draw: the scene is empty")
    corners = np.zeros((0, 3)) if region_box is None else _corners(*region_box)
    everything = np.vstack([mesh.vertices, heads, corners])
    camera = camera_for(everything, size=size, view=view, fill=0.86)
    fine = oversampled(camera)
    middle = (np.asarray(mesh.bounds).mean(axis=0) - camera.centre) @ camera.axes[0]
    nearness = (heads - camera.centre) @ camera.axes[0]
    behind = nearness < middle
    picture = Image.fromarray(np.round(255 * background(fine.width, fine.height)).astype(np.uint8))
    _draw_poses(picture, fine, heads, looks, kinds, nearness, behind)
    _draw_box(picture, fine, corners)
    pixels = np.asarray(picture) / 255.0
    draw_mesh(pixels, mesh, fine, STEEL)
    picture = Image.fromarray(np.round(255 * pixels).astype(np.uint8))
    _draw_poses(picture, fine, heads, looks, kinds, nearness, ~behind)
    done = Image.fromarray(averaged(np.asarray(picture) / 255.0))
    draw_scale_bar(done, camera)
    draw_axes(done, camera)
    _draw_caption(done, camera, len(heads), None if split is None else kinds)
    return png_from_pixels(np.asarray(done))


def _corners(lower: ArrayLike, upper: ArrayLike) -> Floats:
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    return np.array([np.where(choice, high, low) for choice in np.ndindex(2, 2, 2)])


def _draw_poses(
    picture: Image.Image,
    camera: Camera,
    heads: Floats,
    looks: Floats,
    kinds: Ints,
    nearness: Floats,
    chosen: Bools,
) -> None:
    if not chosen.any():
        return
    draw = ImageDraw.Draw(picture)
    spread = max(float(np.ptp(nearness)), 1e-9)
    share = 1 - (nearness.max() - nearness) / spread
    starts, _ = camera.project(heads)
    ends, _ = camera.project(heads + looks * LOOK * camera.height / camera.scale)
    for index in np.flatnonzero(chosen)[np.argsort(nearness[chosen], kind="stable")]:
        far, near = FAR[kinds[index]], NEAR[kinds[index]]
        colour = tuple(int(c) for c in np.round(far + share[index] * (near - far)))
        radius = (2.6 if kinds[index] == 0 else 4.2) * OVERSAMPLING
        (x, y), end = starts[index], ends[index]
        draw.line([(x, y), (end[0], end[1])], fill=colour, width=OVERSAMPLING)
        draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=colour)


def _draw_box(picture: Image.Image, camera: Camera, corners: Floats) -> None:
    if not len(corners):
        return
    draw = ImageDraw.Draw(picture)
    places, _ = camera.project(corners)
    for i, j in combinations(range(8), 2):
        # Edges join corners that differ on one axis, which is one bit of their number.
        if (i ^ j).bit_count() == 1:
            draw.line([tuple(places[i]), tuple(places[j])], fill=BOX, width=OVERSAMPLING)


def draw_axes(picture: Image.Image, camera: Camera) -> None:
    """Draw the world's axes in the lower left corner."""
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(max(11, camera.height // 44))
    length = camera.height / 16
    start = np.array([1.6 * length, camera.height - 1.3 * length])
    colours = ((200, 60, 50), (60, 150, 70), (60, 90, 190))
    # The axis that points away most is drawn first.
    for axis in np.argsort(camera.axes[0], kind="stable"):
        step = length * np.array([camera.axes[1, axis], -camera.axes[2, axis]])
        end, label = start + step, start + 1.28 * step
        draw.line([tuple(start), tuple(end)], fill=colours[axis], width=3)
        draw.text(tuple(label), "xyz"[axis], fill=colours[axis], font=font, anchor="mm")


def _draw_caption(picture: Image.Image, camera: Camera, count: int, kinds: Ints | None) -> None:
    draw = ImageDraw.Draw(picture)
    size = max(12, camera.height // 36)
    font = ImageFont.load_default(size)
    if kinds is None:
        text = f"{count} pose" + ("" if count == 1 else "s")
        draw.text((camera.width / 2, 10), text, fill=INK, font=font, anchor="ma")
        return
    numbers = np.bincount(kinds, minlength=len(SPLITS))
    texts = [f"{number} {name}" for number, name in zip(numbers, SPLITS, strict=True)]
    gap, dot = 1.6 * size, 0.35 * size
    widths = [2 * gap + draw.textlength(text, font=font) for text in texts]
    x, y = (camera.width - sum(widths)) / 2, 10 + size / 2
    for text, width, colour in zip(texts, widths, NEAR.tolist(), strict=True):
        draw.ellipse([x + gap - dot, y - dot, x + gap + dot, y + dot], fill=tuple(colour))
        draw.text((x + gap + 2 * dot, y), text, fill=INK, font=font, anchor="lm")
        x += width
