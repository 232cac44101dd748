# SPDX-License-Identifier: MIT
"""Pictures of a scene with its poses, and of one echo."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from sononerf.errors import NumericalError
from sononerf.numerics import Bools, Floats, Ints
from sononerf.report.figure import (
    DEFAULT_VIEW,
    OVERSAMPLING,
    Camera,
    averaged,
    background,
    camera_for,
    draw_mesh,
    figure,
    picture_bytes,
    png_from_pixels,
)
from sononerf.report.mesh_picture import INK, STEEL, draw_scale_bar, oversampled
from sononerf.report.spectrogram_picture import (
    LEVEL_MAP,
    axis_edges,
    draw_cells,
    drawn_receivers,
    sounding_slice,
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
    positions: ArrayLike,
    poses_forward: ArrayLike,
    region_box: tuple[ArrayLike, ArrayLike] | None = None,
    *,
    split: ArrayLike | None = None,
    size: tuple[int, int] = (960, 800),
    view: ArrayLike = DEFAULT_VIEW,
) -> bytes:
    """Draw a scene with where the calls come from and where they go.

    In: positions ((P, 3), m), poses_forward (P, 3), region_box (((3,), (3,)), m), split (P,),
    size (int, int), view (3,).
    """
    heads = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
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


PALE = (0.84, 0.86, 0.88)
HIT_MAP = "plasma"
# Hits that are fainter than the loudest one by more than this are not drawn.
HIT_RANGE_DB = 40.0
EARS = ((46, 125, 50), (21, 101, 192))  # left, right
MOST_ROWS = 3  # number of receivers, at most, that are drawn, evenly chosen
SIZE = (760, 800)
MANY = 2000  # hits, from which on each is drawn as a small dot
# Of the head and of its look, as shares of the picture's height.
HEAD, AHEAD = 0.022, 0.25
# How far beside the line from scene to head the camera stands, as a sine.
LEAST_ASIDE, MOST_ASIDE = 0.2, 0.6


def echo_png(
    mesh: trimesh.Trimesh,
    points: ArrayLike,
    level_db: ArrayLike,
    position: ArrayLike,
    rotation: ArrayLike,
    echo: ArrayLike,
    sampling_rate: float,
    spectrogram_db: ArrayLike,
    range_m: ArrayLike,
    frequency_hz: ArrayLike,
    *,
    speed_of_sound: float,
    title: str = "",
) -> bytes:
    """Draw one pose: its hits on the scene, the waveforms at the receivers, and their spectrograms.

    Of more than three receivers three are drawn.

    In: points ((N, 3), m), level_db ((N,), dB), position ((3,), m), rotation (3, 3), echo (E, S),
    sampling_rate (Hz), spectrogram_db ((E, R, F), dB), range_m ((R,), m), frequency_hz ((F,), Hz),
    speed_of_sound (m/s).
    """
    ranges, frequencies = (np.asarray(axis, dtype=np.float64) for axis in (range_m, frequency_hz))
    hits = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    levels = np.asarray(level_db, dtype=np.float64)
    waves = np.asarray(echo, dtype=np.float64)
    sounds = np.asarray(spectrogram_db, dtype=np.float64)
    place = np.asarray(position, dtype=np.float64).reshape(3)
    turn = np.asarray(rotation, dtype=np.float64).reshape(3, 3)
    relative = levels - levels.max() if len(levels) else levels
    receivers = len(waves)
    shown = sounding_slice(sounds, ranges)
    distance = np.arange(waves.shape[1], dtype=np.float64) * speed_of_sound / (2.0 * sampling_rate)
    with figure(13.0, 6.6, 130) as drawn:
        left, right = drawn.subfigures(1, 2, width_ratios=[1.0, 1.08])
        unhit = "no hit: edges alone are heard" if waves.any() else "no hit is heard"
        _draw_view(left, mesh, hits, relative, place, turn, receivers, unhit)
        chosen, names = drawn_receivers(receivers, MOST_ROWS)
        rows = len(chosen)
        axes = right.subplots(2 * rows, 1, sharex=True, height_ratios=[1.0] * rows + [1.5] * rows)
        _draw_waves(axes[:rows], distance, waves[chosen], names)
        sounds = sounds[chosen][:, shown]
        _draw_spectrograms(right, axes[rows:], sounds, ranges[shown], frequencies, names)
        axes[0].set_xlim(*axis_edges(ranges[shown]))
        _add_time_axis(axes[0], speed_of_sound)
        if title:
            drawn.suptitle(title, fontsize=11)
        return picture_bytes(drawn)


def _draw_view(
    part: Any,
    mesh: trimesh.Trimesh,
    points: Floats,
    relative_db: Floats,
    position: Floats,
    rotation: Floats,
    ears: int,
    unhit: str,
) -> None:
    """Draw a scene with its hits and the head that hears them, seen over the head's shoulder."""
    if not len(mesh.faces):
        raise NumericalError("there is nothing to draw: the scene is empty")
    middle = np.asarray(mesh.bounds).mean(axis=0)
    view = _over_shoulder(position - middle, float(mesh.scale) / 2.0)
    camera = camera_for(np.vstack([mesh.vertices, position]), size=SIZE, view=view, fill=0.70)
    fine = oversampled(camera)
    pixels = background(fine.width, fine.height)
    nearness = draw_mesh(pixels, mesh, fine, PALE)
    picture = Image.fromarray(averaged(pixels))
    draw_scale_bar(picture, camera)
    draw_axes(picture, camera)
    panel = part.subplots()
    panel.imshow(np.asarray(picture), origin="upper", interpolation="bilinear")
    panel.set_axis_off()
    drawn = visible_hits(points, relative_db, fine, nearness, 0.01 * float(mesh.scale))
    colours = {"c": relative_db[drawn], "cmap": HIT_MAP, "vmin": -HIT_RANGE_DB, "vmax": 0.0}
    # Many hits melt together; few are dots.
    size = 6.0 if len(drawn) < MANY else 1.5
    dots = panel.scatter(*camera.project(points[drawn])[0].T, s=size, linewidths=0, **colours)
    unit = camera.height / camera.scale  # m per height of the picture
    forward, left, up = rotation.T
    sides = [HEAD * unit * (side * 0.75 * left + 0.9 * up) for side in (1.0, -1.0)]
    marks = [position, position + AHEAD * unit * forward, *(position + side for side in sides)]
    (start, end, *ends), _ = camera.project(np.stack(marks))
    ink = tuple(np.divide(INK, 255))
    panel.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": ink})
    for place, colour, name in zip(ends if ears == 2 else [], EARS, "LR", strict=False):
        outwards = (place - start) / max(float(np.linalg.norm(place - start)), 1e-9)
        tint = tuple(np.divide(colour, 255))
        panel.plot(*place, "o", color=tint, markersize=6)
        at = place + 0.04 * camera.height * outwards
        panel.text(*at, name, color=tint, ha="center", va="center")
    panel.plot(*start, "o", color=ink, markersize=11)
    said = f"{len(points)} hits, {int((relative_db >= -HIT_RANGE_DB).sum())} within "
    panel.set_title(f"{said}{HIT_RANGE_DB:g} dB of the loudest" if len(points) else unhit)
    bar = part.colorbar(dots, ax=panel, orientation="horizontal", aspect=40, shrink=0.8, pad=0.02)
    bar.set_label("strength of a hit (dB below the loudest)")


def _draw_waves(axes: Any, distance: Floats, waves: Floats, names: list[str]) -> None:
    # A number that is easy to read, and its power of ten in the label.
    top = float(np.abs(waves).max())
    power = int(np.floor(np.log10(top))) if top > 0.0 else 0
    colours = (*EARS, (96, 96, 96))
    for panel, wave, colour in zip(axes, waves, colours, strict=False):
        panel.plot(distance, wave / 10.0**power, color=np.divide(colour, 255), linewidth=0.7)
        panel.set_ylim(*(1.08 * (top / 10.0**power or 1.0) * np.array([-1.0, 1.0])))
        panel.grid(alpha=0.25, linewidth=0.5)
    _label(axes, names, f"pressure (10$^{{{power}}}$)")


def _draw_spectrograms(
    part: Any, axes: Any, sounds: Floats, ranges: Floats, frequencies: Floats, names: list[str]
) -> None:
    top = max(5.0, float(np.ceil(sounds.max() / 5.0)) * 5.0)
    for panel, sound in zip(axes, sounds, strict=True):
        options = {"cmap": LEVEL_MAP, "vmin": 0.0, "vmax": top}
        level = draw_cells(panel, sound, ranges, frequencies, **options)
    _label(axes, names, "frequency (kHz)")
    axes[-1].set_xlabel("range (m)")
    part.colorbar(level, ax=list(axes), label="level (dB)", pad=0.01, aspect=24)


def _label(axes: Any, names: list[str], quantity: str) -> None:
    """Name each panel, and the quantity at the middle one: more than two names leave no room."""
    for number, (panel, name) in enumerate(zip(axes, names, strict=True)):
        every = len(names) <= 2 or number == len(names) // 2
        panel.set_ylabel(f"{name}\n{quantity}" if every else f"{name}\n")


def _add_time_axis(panel: Any, speed_of_sound: float) -> None:
    per_metre = 2e3 / speed_of_sound  # ms
    above = panel.secondary_xaxis(
        "top", functions=(lambda metres: metres * per_metre, lambda ms: ms / per_metre)
    )
    above.set_xlabel("time since the call (ms)")


def visible_hits(
    points: Floats, relative_db: Floats, camera: Camera, nearness: Floats, depth: float
) -> Ints:
    """Return the numbers of the hits that a camera sees, the loudest last.

    In: points ((N, 3), m), relative_db ((N,), dB), nearness ((H, W), m), depth (m).
    """
    places, near = camera.project(points)
    column, row = np.floor(places).astype(np.int64).T
    height, width = nearness.shape
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    chosen = np.flatnonzero(within & (relative_db >= -HIT_RANGE_DB))
    chosen = chosen[near[chosen] > nearness[row[chosen], column[chosen]] - depth]
    return chosen[np.argsort(relative_db[chosen], kind="stable")]


def _over_shoulder(away: Floats, radius: float) -> Floats:
    """Return a view along which a head stands beside the scene that it looks at."""
    level, distance = float(np.hypot(away[0], away[1])), float(np.linalg.norm(away))
    aside = np.arcsin(np.clip(1.2 * radius / max(distance, 1e-9), LEAST_ASIDE, MOST_ASIDE))
    # Heads that look straight down or up have yaw 0, and are seen from behind, too.
    turn = (np.arctan2(away[1], away[0]) if level > 1e-9 * distance else np.pi) + aside
    # A camera that looks straight down has no up.
    tilt = float(np.clip(np.arctan2(away[2], level) + 0.5 * aside, -1.2, 1.2))
    return np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
