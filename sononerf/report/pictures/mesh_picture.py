# SPDX-License-Identifier: MIT
"""Pictures of meshes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from sononerf.array_types import Floats
from sononerf.errors import NumericalError
from sononerf.report.pictures.figure import png_from_pixels
from sononerf.report.pictures.shading import (
    DEFAULT_VIEW,
    OVERSAMPLING,
    Camera,
    averaged,
    background,
    camera_for,
    draw_mesh,
)
from sononerf.surface.mesh_files import MANY_POSES, confidence_colours

STEEL, CLAY = (0.62, 0.72, 0.84), (0.93, 0.70, 0.52)
INK = (60, 66, 74)


def mesh_png(
    mesh: trimesh.Trimesh,
    *,
    size: tuple[int, int] = (960, 720),
    view: ArrayLike = DEFAULT_VIEW,
    colours: ArrayLike | None = None,
) -> bytes:
    """Draw a mesh in parallel projection, shaded, with a scale bar.

    Args:
        size (int, int): Width and height in pixels.
        view (3,): Direction from the mesh to the camera, world frame; z is up.
        colours ((3,) or (V, 3)): Colour in 0 to 1, one for all or one per vertex.
    """
    _require_drawable(mesh, "the mesh")
    camera = camera_for(mesh.vertices, size=size, view=view)
    return png_from_pixels(_picture(mesh, camera, STEEL if colours is None else colours))


def side_by_side_png(
    left: trimesh.Trimesh,
    right: trimesh.Trimesh,
    titles: tuple[str, str] = ("truth", "reconstruction"),
    *,
    size: tuple[int, int] = (720, 640),
    view: ArrayLike = DEFAULT_VIEW,
) -> bytes:
    """Draw two meshes next to each other through the same camera.

    Args:
        titles (str, str): One line above each.
        size (int, int): Width and height of each half in pixels.
        view (3,): Direction to the camera, world frame.
    """
    for mesh, title in zip((left, right), titles, strict=True):
        _require_drawable(mesh, title or "a mesh")
    camera = camera_for(np.vstack([left.vertices, right.vertices]), size=size, view=view, fill=0.76)
    halves = []
    for mesh, title, colour in zip((left, right), titles, (STEEL, CLAY), strict=True):
        half = Image.fromarray(_picture(mesh, camera, colour))
        font = ImageFont.load_default(max(12, size[1] // 28))
        ImageDraw.Draw(half).text((size[0] / 2, 14), title, fill=INK, font=font, anchor="ma")
        halves.append(np.asarray(half))
    gap = np.full((size[1], 4, 3), 255, np.uint8)
    return png_from_pixels(np.hstack([halves[0], gap, halves[1]]))


def confidence_png(
    mesh: trimesh.Trimesh,
    counts: ArrayLike,
    *,
    size: tuple[int, int] = (960, 720),
    view: ArrayLike = DEFAULT_VIEW,
) -> bytes:
    """Draw a mesh in the colours of its confidence, with a legend.

    Args:
        counts (V,): Number of poses that heard the surface around each vertex.
        size (int, int): Width and height in pixels.
        view (3,): Direction from the mesh to the camera, world frame; z is up.
    """
    _require_drawable(mesh, "the mesh")
    camera = camera_for(mesh.vertices, size=size, view=view, fill=0.74)
    picture = Image.fromarray(_picture(mesh, camera, confidence_colours(counts)))
    _draw_colour_bar(picture, CONFIDENCE_BAR)
    return png_from_pixels(np.asarray(picture))


@dataclass(frozen=True, eq=False)
class ColourBar:
    """Legend of the colours of a mesh.

    Attributes:
        title: Title, with the unit.
        colours: Colours (N, 3), 0 to 1, of places (N,) from 0 to 1 along the bar.
        marks: Place along the bar, 0 to 1, and its label.
    """

    title: str
    colours: Callable[[Floats], Floats]
    marks: tuple[tuple[float, str], ...]


CONFIDENCE_BAR = ColourBar(
    "poses that heard this place",
    lambda places: confidence_colours(np.expm1(places * np.log1p(MANY_POSES))),
    tuple(
        (float(np.log1p(n) / np.log1p(MANY_POSES)), f"{n}+" if n == MANY_POSES else str(n))
        for n in (0, 3, 10, 30, MANY_POSES)
    ),
)


def distance_bar(limit: float) -> ColourBar:
    """Return the colour bar of signed distances up to a limit, m: red outside, blue inside."""
    marks = tuple((0.5 + 0.5 * part, f"{1e3 * part * limit:+.2g}") for part in (-1, -0.5, 0.5, 1))
    return ColourBar("mm outside (+) or inside (-) of the truth", _diverging, (*marks, (0.5, "0")))


def distance_colours(distance: ArrayLike, limit: float) -> Floats:
    """Colour signed distances (V,), m, as :func:`distance_bar` shows; larger ones as the limit."""
    return _diverging(0.5 + 0.5 * np.clip(np.asarray(distance) / limit, -1, 1))


UNHEARD = (0.35, 0.35, 0.35)
"""Colour (sRGB, 0 to 1) of vertices that no echo bounds."""


def error_bar(limit: float) -> ColourBar:
    """Return the colour bar of errors up to a limit, m: yellow for small, violet for large ones."""
    marks = tuple((part, f"{1e3 * part * limit:.2g}") for part in (0, 0.5, 1))
    return ColourBar("error in mm (90 %); grey: unheard", _sequential, marks)


def error_colours(error: ArrayLike, limit: float) -> Floats:
    """Colour errors (V,), m, as :func:`error_bar` shows; larger ones as the limit."""
    return _sequential(np.clip(np.asarray(error) / limit, 0, 1))


def _sequential(places: Floats) -> Floats:
    from matplotlib import colormaps

    colours: Floats = colormaps["plasma_r"](np.asarray(places))[:, :3]
    return colours


def _diverging(places: Floats) -> Floats:
    from matplotlib import colormaps

    colours: Floats = colormaps["RdBu_r"](0.08 + 0.84 * np.asarray(places))[:, :3]
    return colours


SIDES = ("front", "left", "back", "right")


def sides_png(
    rows: Sequence[tuple[str, trimesh.Trimesh, ArrayLike, ColourBar | None]],
    *,
    size: tuple[int, int],
) -> bytes:
    """Draw meshes from four sides through the same cameras, one mesh per row.

    Args:
        size (int, int): Width and height of each view in pixels.
    """
    for title, mesh, *_ in rows:
        _require_drawable(mesh, title)
    points = np.vstack([mesh.vertices for _, mesh, *_ in rows])
    font = ImageFont.load_default(15)
    lines = []
    for title, mesh, colours, bar in rows:
        line = []
        for number, side in enumerate(SIDES):
            x, y, z = DEFAULT_VIEW
            view = [(x, y, z), (-y, x, z), (-x, -y, z), (y, -x, z)][number]
            camera = camera_for(points, size=size, view=view, fill=0.7)
            cell = Image.fromarray(_picture(mesh, camera, colours))
            text = f"{title}, from the {side}" if not number else f"from the {side}"
            ImageDraw.Draw(cell).text((10, 8), text, fill=INK, font=font)
            if bar is not None and not number:
                _draw_colour_bar(cell, bar)
            line.append(np.asarray(cell))
        lines.append(np.hstack(line))
    return png_from_pixels(np.vstack(lines))


def _draw_colour_bar(picture: Image.Image, bar: ColourBar) -> None:
    """Draw the legend near the lower left corner, in place."""
    width, height = picture.size
    margin, length, thick = height // 24, max(width // 4, 150), max(6, height // 55)
    left, bottom = max(margin, 22), height - margin  # half of the first mark stands to the left
    strip = np.round(255 * bar.colours(np.linspace(0, 1, length))).astype(np.uint8)
    strip = np.ascontiguousarray(np.broadcast_to(strip, (thick, length, 3)))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(max(11, height // 40))
    line = round(1.3 * font.getbbox("0")[3])
    top = bottom - line - thick
    picture.paste(Image.fromarray(strip), (left, top))
    draw.rectangle([(left, top), (left + length - 1, top + thick - 1)], outline=INK)
    for place, text in bar.marks:
        x = left + place * (length - 1)
        draw.line([(x, top + thick), (x, top + thick + 4)], fill=INK, width=1)
        draw.text((x, bottom), text, fill=INK, font=font, anchor="ms")
    draw.text((left, top - 6), bar.title, fill=INK, font=font, anchor="ls")


def _require_drawable(mesh: trimesh.Trimesh, name: str) -> None:
    if not len(mesh.faces):
        raise NumericalError(f"there is nothing to draw: {name} is empty")
    if not np.isfinite(mesh.vertices).all():
        raise NumericalError(f"{name} has vertices that are not finite")


def _picture(mesh: trimesh.Trimesh, camera: Camera, colour: ArrayLike) -> NDArray[np.uint8]:
    base = np.asarray(colour, dtype=np.float64)
    fine = oversampled(camera)
    pixels = background(fine.width, fine.height)
    draw_mesh(pixels, mesh, fine, base)
    picture = Image.fromarray(averaged(pixels))
    draw_scale_bar(picture, camera)
    return np.asarray(picture)


def oversampled(camera: Camera) -> Camera:
    """Return the same camera with more pixels, to be averaged afterwards."""
    return dataclasses.replace(
        camera,
        width=camera.width * OVERSAMPLING,
        height=camera.height * OVERSAMPLING,
        scale=camera.scale * OVERSAMPLING,
    )


def round_length(longest: float) -> float:
    """Return the greatest length of 1, 2 or 5 times a power of ten up to the longest."""
    power = float(10 ** np.floor(np.log10(longest)))
    return max(step for step in (power, 2 * power, 5 * power) if step <= longest)


def draw_scale_bar(picture: Image.Image, camera: Camera) -> None:
    """Draw a bar of a round length near the lower right corner, in place."""
    length = round_length(0.25 * camera.width / camera.scale)
    pixels = length * camera.scale
    margin = camera.height // 24
    right, bottom = camera.width - margin, camera.height - margin
    draw = ImageDraw.Draw(picture)
    draw.line([(right - pixels, bottom), (right, bottom)], fill=INK, width=3)
    for x in (right - pixels, right):
        draw.line([(x, bottom - 5), (x, bottom + 5)], fill=INK, width=2)
    font = ImageFont.load_default(max(11, camera.height // 40))
    place = (right - pixels / 2, bottom - 8)
    draw.text(place, f"{1e3 * length:g} mm", fill=INK, font=font, anchor="ms")
