# SPDX-License-Identifier: MIT
"""Picture of one pose: the origin of its echo, and the sound at the receivers."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from PIL import Image

from sononerf.array_types import Floats, Ints
from sononerf.errors import NumericalError
from sononerf.report.pictures.figure import figure, picture_bytes
from sononerf.report.pictures.mesh_picture import INK, draw_scale_bar, oversampled
from sononerf.report.pictures.scene_picture import draw_axes
from sononerf.report.pictures.shading import (
    Camera,
    averaged,
    background,
    camera_for,
    draw_mesh,
)
from sononerf.report.pictures.spectrogram_picture import (
    LEVEL_MAP,
    axis_edges,
    draw_cells,
    drawn_receivers,
    sounding_slice,
)

PALE = (0.84, 0.86, 0.88)
HIT_MAP = "plasma"
# Hits that are fainter than the loudest one by more than this are not drawn.
HIT_RANGE_DB = 40.0
EARS = ((46, 125, 50), (21, 101, 192))  # left, right
MOST_ROWS = 3  # number of receivers, at most, that are drawn, evenly chosen
SIZE = (760, 800)
MANY = 2000  # hits, from which on each is drawn as a small dot
# Of the head and of its look, as shares of the picture's height.
HEAD, LOOK = 0.022, 0.25
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
    marks = [position, position + LOOK * unit * forward, *(position + side for side in sides)]
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
    part: Any,
    axes: Any,
    sounds: Floats,
    ranges: Floats,
    frequencies: Floats,
    names: list[str],
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
