# SPDX-License-Identifier: MIT
"""Pictures of meshes, and the views of a surface that page and viewer show."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import cKDTree

from sononerf.errors import NumericalError
from sononerf.evaluation.numbers import signed_error
from sononerf.numerics import Floats
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
from sononerf.start.surface import MANY_POSES, confidence_colours, linear_light

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

    In: size (int, int), view (3,), colours ((3,) or (V, 3)).
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

    In: titles (str, str), size (int, int), view (3,).
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

    In: counts (V,), size (int, int), view (3,).
    """
    _require_drawable(mesh, "the mesh")
    camera = camera_for(mesh.vertices, size=size, view=view, fill=0.74)
    row = ("", _picture(mesh, camera, confidence_colours(counts)), confidence_scale())
    return _laid_out([[row]])


@dataclass(frozen=True, eq=False)
class ColourScale:
    """Colours of values on a mesh, and their legend."""

    label: str  # Quantity and unit
    mappable: Any  # Norm and colour map of matplotlib
    # Values that the legend names; chosen by matplotlib where None
    ticks: Sequence[float] | None = None

    def __call__(self, values: ArrayLike) -> Floats:
        """Return the colours (V, 3), 0 to 1, of values (V,); larger ones as the largest shown."""
        return np.asarray(self.mappable.to_rgba(np.asarray(values)))[:, :3]


def confidence_scale() -> ColourScale:
    """Return the scale of numbers of poses."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import FuncNorm, ListedColormap

    norm = FuncNorm((np.log1p, np.expm1), 0, MANY_POSES)
    colours = confidence_colours(np.expm1(np.linspace(0, np.log1p(MANY_POSES), 256)))
    mappable = ScalarMappable(norm, ListedColormap(colours))
    return ColourScale("poses that heard this place", mappable, (0, 3, 10, 30, MANY_POSES))


def distance_scale(limit: float) -> ColourScale:
    """Return the scale of signed distances in mm, up to a limit in m: red outside, blue inside."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    mappable = ScalarMappable(Normalize(-1e3 * limit, 1e3 * limit), "coolwarm")
    return ColourScale("mm outside (+) or inside (-) of the truth", mappable)


def error_scale(limit: float) -> ColourScale:
    """Return the scale of errors in mm, up to a limit in m: yellow for small, violet for large."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    mappable = ScalarMappable(Normalize(0.0, 1e3 * limit), "plasma_r")
    return ColourScale("error in mm (90 %); grey: unheard", mappable)


UNHEARD = (0.35, 0.35, 0.35)
"""Colour (sRGB, 0 to 1) of vertices that no echo bounds."""


SIDES = ("front", "left", "back", "right")


def sides_png(
    rows: Sequence[tuple[str, trimesh.Trimesh, ArrayLike, ColourScale | None]],
    *,
    size: tuple[int, int],
) -> bytes:
    """Draw meshes from four sides through the same cameras, one mesh per row.

    In: size (int, int).
    """
    for title, mesh, *_ in rows:
        _require_drawable(mesh, title)
    points = np.vstack([mesh.vertices for _, mesh, *_ in rows])
    x, y, z = DEFAULT_VIEW
    views = [(x, y, z), (-y, x, z), (-x, -y, z), (y, -x, z)]
    cameras = [camera_for(points, size=size, view=view, fill=0.7) for view in views]
    return _laid_out(
        [
            [
                (
                    f"{title}, from the {side}" if not number else f"from the {side}",
                    _picture(mesh, camera, colours),
                    None if number else scale,
                )
                for number, (side, camera) in enumerate(zip(SIDES, cameras, strict=True))
            ]
            for title, mesh, colours, scale in rows
        ]
    )


def _laid_out(rows: Sequence[Sequence[tuple[str, NDArray[np.uint8], ColourScale | None]]]) -> bytes:
    """Lay pictures (H, W, 3) of one size side by side, with their titles and legends."""
    height, width, _ = rows[0][0][1].shape
    down, across = 1.0 / len(rows), 1.0 / len(rows[0])
    with figure(width * len(rows[0]) / 100, height * len(rows) / 100, 100, layout=None) as drawn:
        for row, cells in enumerate(rows):
            for column, (title, pixels, scale) in enumerate(cells):
                axes = drawn.add_axes((column * across, 1 - (row + 1) * down, across, down))
                axes.imshow(pixels, origin="upper", aspect="auto")
                axes.set_axis_off()
                axes.text(10, 8, title, va="top", fontsize=10)
                if scale is not None:
                    bar = axes.inset_axes((0.05, 0.075, 0.4, 0.02))
                    drawn.colorbar(
                        scale.mappable, cax=bar, orientation="horizontal", ticks=scale.ticks
                    )
                    bar.set_title(scale.label, fontsize=8, loc="left", pad=3)
                    bar.tick_params(labelsize=7)
                    if scale.ticks is not None:
                        bar.set_xticks(scale.ticks, [f"{tick:g}" for tick in scale.ticks])
        return picture_bytes(drawn)


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


MOST_TRIANGLES = 60_000
"""Largest number of triangles of a mesh in a page: three such meshes take about 6 MB of the 15 MB
that a page may have. Larger meshes are decimated."""


@dataclass(frozen=True, eq=False)
class SurfaceViews:
    """Pictures and coloured meshes of a surface.

    In: confidence ((V,) int32 or None), error ((V,) float32 or None, m), limit (m).
    """

    mesh: trimesh.Trimesh
    confidence: NDArray[np.int32] | None
    error: NDArray[np.float32] | None
    truth: trimesh.Trimesh | None
    limit: float

    @cached_property
    def _rows(self) -> list[tuple[str, trimesh.Trimesh, Floats, ColourScale | None]]:
        rows: list[tuple[str, trimesh.Trimesh, Floats, ColourScale | None]] = []
        if self.truth is not None:
            scale = distance_scale(self.limit)
            off = scale(1e3 * signed_error(self.mesh, self.truth))
            rows.append(("truth", self.truth, np.array(STEEL), None))
            rows.append(("distance", self.mesh, off, scale))
        if self.error is not None:
            scale = error_scale(self.limit)
            colours = scale(1e3 * self.error)
            if self.confidence is not None:
                colours[self.confidence == 0] = UNHEARD
            rows.append(("error", self.mesh, colours, scale))
        elif self.confidence is not None:
            scale = confidence_scale()
            rows.append(("confidence", self.mesh, scale(self.confidence), scale))
        return rows or [("reconstruction", self.mesh, np.array(CLAY), None)]

    def png(self, size: tuple[int, int] = (380, 340)) -> bytes:
        """Draw truth, distance and error from four sides, one row each; ``size`` is of a view."""
        return sides_png(self._rows, size=size)

    def meshes(self) -> dict[str, trimesh.Trimesh]:
        """Return coloured meshes by name, the reconstruction first; of glTF's linear colours."""
        names = {
            "distance": "reconstruction, coloured by its distance from the truth",
            "error": "reconstruction, coloured by its error, known without the truth",
            "confidence": "reconstruction, coloured by how many poses heard it",
        }
        rows = self._rows
        ordered = [row for row in rows if row[0] != "truth"]
        ordered += [row for row in rows if row[0] == "truth"]
        return {names.get(name, name): _coloured(mesh, c) for name, mesh, c, _ in ordered}


def _coloured(mesh: trimesh.Trimesh, colours: Floats) -> trimesh.Trimesh:
    small = decimated(mesh, MOST_TRIANGLES)
    if colours.ndim == 2:
        colours = colours[cKDTree(mesh.vertices).query(small.vertices)[1]]
    light = np.broadcast_to(linear_light(colours), (len(small.vertices), 3))
    small.visual = trimesh.visual.ColorVisuals(
        small, vertex_colors=np.round(255 * light).astype(np.uint8)
    )
    return small


def decimated(mesh: trimesh.Trimesh, triangles: int) -> trimesh.Trimesh:
    """Return a copy of a mesh, without colours, with at most about this number of triangles."""
    if len(mesh.faces) > triangles:
        import pyvista

        reduced = pyvista.wrap(mesh).decimate(1.0 - triangles / len(mesh.faces))
        return trimesh.Trimesh(reduced.points, reduced.regular_faces, process=False)
    return trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False, validate=False)
