# SPDX-License-Identifier: MIT
"""Picture of one pose: the origin of its echo, and the sound at the receivers."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from sononerf.array_types import Floats
from sononerf.errors import NumericalError
from sononerf.report.pictures.figure import figure, picture_bytes
from sononerf.report.pictures.mesh_picture import INK, draw_scale_bar, oversampled
from sononerf.report.pictures.scene_picture import draw_axes
from sononerf.report.pictures.shading import (
    OVERSAMPLING,
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

    Args:
        points ((N, 3), m): Points that reflect sound towards the ears, world frame; none is
            allowed.
        level_db ((N,), dB): Level of each; drawn relative to the loudest.
        position ((3,), m): Place of the head, world frame.
        rotation (3, 3): Head to world.
        echo (E, S): Pressure at the receivers from the emission on, over that of the call at 1 m.
            Two of them are the left and the right ear.
        sampling_rate (Hz): Sampling rate of the echo.
        spectrogram_db ((E, R, F), dB): 0 dB is silence.
        range_m ((R,), m): Range axis, ascending; drawn only around what sounds.
        frequency_hz ((F,), Hz): Frequency axis, ascending; drawn in kHz.
        speed_of_sound (m/s): Puts the echo on the range axis.
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
    view = hits_image(mesh, hits, relative, place, turn, receivers=receivers)
    shown = sounding_slice(sounds, ranges)
    distance = np.arange(waves.shape[1], dtype=np.float64) * speed_of_sound / (2.0 * sampling_rate)
    with figure(13.0, 6.6, 130) as drawn:
        left, right = drawn.subfigures(1, 2, width_ratios=[1.0, 1.08])
        unhit = "no hit: edges alone are heard" if waves.any() else "no hit is heard"
        _draw_view(left, view, len(hits), int((relative >= -HIT_RANGE_DB).sum()), unhit)
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


def _draw_view(part: Any, view: NDArray[np.uint8], count: int, drawn: int, unhit: str) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    panel = part.subplots()
    panel.imshow(view, origin="upper", interpolation="bilinear")
    panel.set_axis_off()
    said = f"{count} hits, {drawn} within {HIT_RANGE_DB:g} dB of the loudest"
    panel.set_title(said if count else unhit)
    scale = ScalarMappable(Normalize(-HIT_RANGE_DB, 0.0), HIT_MAP)
    bar = part.colorbar(scale, ax=panel, orientation="horizontal", aspect=40, shrink=0.8, pad=0.02)
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


def hits_image(
    mesh: trimesh.Trimesh,
    points: Floats,
    relative_db: Floats,
    position: Floats,
    rotation: Floats,
    *,
    receivers: int = 2,
    size: tuple[int, int] = SIZE,
) -> NDArray[np.uint8]:
    """Draw a scene with its hits and the head that hears them, seen over the head's shoulder.

    Args:
        points ((N, 3), m): Hits, world frame; those behind something are hidden, and the faintest
            left out.
        relative_db ((N,), dB): Their levels below the loudest, zero at most.
        position ((3,), m): Place of the head.
        rotation (3, 3): Head to world.
        size (int, int): Width and height in pixels.

    Returns:
        pixels: (H, W, 3) uint8.
    """
    if not len(mesh.faces):
        raise NumericalError("there is nothing to draw: the scene is empty")
    middle = np.asarray(mesh.bounds).mean(axis=0)
    everything = np.vstack([mesh.vertices, position])
    view = _over_shoulder(position - middle, float(mesh.scale) / 2.0)
    camera = camera_for(everything, size=size, view=view, fill=0.70)
    fine = oversampled(camera)
    pixels = background(fine.width, fine.height)
    nearness = draw_mesh(pixels, mesh, fine, PALE)
    _draw_hits(pixels, nearness, fine, points, relative_db, float(mesh.scale))
    picture = Image.fromarray(np.round(255 * pixels).astype(np.uint8))
    _draw_head(picture, fine, position, rotation, ears=receivers == 2)
    done = Image.fromarray(averaged(np.asarray(picture) / 255.0))
    draw_scale_bar(done, camera)
    draw_axes(done, camera)
    return np.asarray(done)


def _over_shoulder(away: Floats, radius: float) -> Floats:
    """Return a view along which a head stands beside the scene that it looks at."""
    level, distance = float(np.hypot(away[0], away[1])), float(np.linalg.norm(away))
    aside = np.arcsin(np.clip(1.2 * radius / max(distance, 1e-9), LEAST_ASIDE, MOST_ASIDE))
    # Heads that look straight down or up have yaw 0, and are seen from behind, too.
    turn = (np.arctan2(away[1], away[0]) if level > 1e-9 * distance else np.pi) + aside
    # A camera that looks straight down has no up.
    tilt = float(np.clip(np.arctan2(away[2], level) + 0.5 * aside, -1.2, 1.2))
    return np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])


def _draw_hits(
    pixels: Floats,
    nearness: Floats,
    camera: Camera,
    points: Floats,
    relative_db: Floats,
    scale: float,
) -> None:
    from matplotlib import colormaps

    if not len(points):
        return
    places, depth = camera.project(points)
    column, row = np.floor(places).astype(np.int64).T
    height, width = nearness.shape
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen = within & (relative_db >= -HIT_RANGE_DB)
    # The surface of a pixel is its middle's, so a steep one is a little off.
    chosen = np.flatnonzero(seen)
    surface = nearness[row[chosen], column[chosen]]
    chosen = chosen[depth[chosen] > surface - 0.01 * scale]
    chosen = chosen[np.argsort(relative_db[chosen], kind="stable")]  # the loudest last
    colours = colormaps[HIT_MAP](1.0 + relative_db[chosen] / HIT_RANGE_DB)[:, :3]
    # Many hits melt together; few are dots.
    covered = np.isfinite(nearness).sum() / max(1, len(chosen))
    radius = int(np.clip(round(0.6 * float(np.sqrt(covered))), OVERSAMPLING, 3 * OVERSAMPLING))
    for down, across in np.ndindex(2 * radius + 1, 2 * radius + 1):
        if (down - radius) ** 2 + (across - radius) ** 2 <= radius**2:
            y = np.clip(row[chosen] + down - radius, 0, height - 1)
            x = np.clip(column[chosen] + across - radius, 0, width - 1)
            pixels[y, x] = colours


def _draw_head(
    picture: Image.Image,
    camera: Camera,
    position: Floats,
    rotation: Floats,
    *,
    ears: bool,
) -> None:
    """Draw a head of a fixed size in the picture, its ears if any, and where it looks."""
    draw = ImageDraw.Draw(picture)
    unit = camera.height / camera.scale  # m per height of the picture
    forward, left, up = rotation.T
    tip = position + LOOK * unit * forward
    (start, end, *sides), _ = camera.project(
        np.stack(
            [
                position,
                tip,
                position + HEAD * unit * (0.75 * left + 0.9 * up),
                position + HEAD * unit * (-0.75 * left + 0.9 * up),
            ]
        )
    )
    along = end - start
    length = float(np.linalg.norm(along))
    draw.line([tuple(start), tuple(end)], fill=INK, width=2 * OVERSAMPLING)
    if length > 1.0:
        back, side = along / length, np.array([-along[1], along[0]]) / length
        barb = 7.0 * OVERSAMPLING
        corners = [end + back * barb, end - side * barb / 2, end + side * barb / 2]
        draw.polygon([tuple(corner) for corner in corners], fill=INK)
    radius = HEAD * camera.height * 0.8
    for ear, colour, name in zip(sides if ears else [], EARS, "LR", strict=False):
        _disc(draw, ear, 0.55 * radius, colour)
        outwards = ear - start
        outwards = outwards / max(float(np.linalg.norm(outwards)), 1e-9)
        font = ImageFont.load_default(camera.height // 42)
        draw.text(tuple(ear + 1.5 * radius * outwards), name, fill=colour, font=font, anchor="mm")
    _disc(draw, start, radius, INK)


def _disc(
    draw: ImageDraw.ImageDraw, centre: Floats, radius: float, colour: tuple[int, ...]
) -> None:
    (x, y), r = centre, radius
    draw.ellipse([x - r, y - r, x + r, y + r], fill=colour)
