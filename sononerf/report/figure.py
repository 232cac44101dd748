# SPDX-License-Identifier: MIT
"""Figures and pixels as PNG files, and shaded meshes without OpenGL."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from sononerf.errors import NumericalError
from sononerf.geometry.raycast import RayCaster
from sononerf.numerics import Floats

STYLE = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so pictures look alike everywhere
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "axes.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "image.interpolation": "nearest",
    "image.origin": "lower",
    "svg.hashsalt": "sononerf",  # the same names of parts each time
}
PictureFormat = Literal["png", "svg", "pdf"]
_UNDATED: dict[PictureFormat, dict[str, None]] = {
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}


def png_from_pixels(pixels: NDArray[np.uint8]) -> bytes:
    """Return pixels (H, W, 3) as a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


@contextmanager
def figure(
    width: float,
    height: float,
    dpi: int,
    *,
    layout: Literal["constrained", "compressed"] | None = "constrained",
) -> Iterator[Any]:
    """Open a figure of this size (inches) in our style; draw in the block, then take its pixels.

    Computing a layout takes twice as long as drawing.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        drawn = Figure(figsize=(width, height), dpi=dpi, layout=layout, facecolor="white")
        FigureCanvasAgg(drawn)
        yield drawn


def picture_bytes(drawn: Any, kind: PictureFormat = "png") -> bytes:
    """Return a figure as a file: pixels, or lines and letters for a paper (SVG, PDF)."""
    if kind == "png":
        return png_from_pixels(pixels_from_figure(drawn))
    buffer = io.BytesIO()
    drawn.savefig(buffer, format=kind, metadata=_UNDATED[kind])
    return buffer.getvalue()


def pixels_from_figure(drawn: Any) -> NDArray[np.uint8]:
    """Return a figure's pixels, (H, W, 3)."""
    drawn.canvas.draw()
    return np.array(drawn.canvas.buffer_rgba(), dtype=np.uint8)[..., :3]


def curves_picture(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    *,
    floors: Mapping[str, float] | None = None,
    kind: PictureFormat = "png",
) -> bytes:
    """Draw errors over steps on a logarithmic axis."""
    with figure(6.4, 3.4, 130) as drawn:
        axes = drawn.subplots()
        for number, (name, (steps, errors)) in enumerate(curves.items()):
            axes.plot(steps, errors, "o-", markersize=2.5, color=f"C{number}", label=name)
        for number, (name, floor) in enumerate((floors or {}).items()):
            axes.axhline(floor, linestyle="--", linewidth=1, color=f"C{number}", label=name)
        axes.set_yscale("log")
        axes.set_xlabel("step")
        axes.set_ylabel("error on validation poses (dB)")
        axes.grid(which="both", linewidth=0.3, alpha=0.6)
        axes.legend(fontsize=8)
        return picture_bytes(drawn, kind)


# From the scene's front (+x), a little from the right and from above; z is up.
DEFAULT_VIEW = (1.0, 0.42, 0.34)
# Rays per pixel along each side.
OVERSAMPLING = 2
# Lights in the camera's frame (towards the camera, right, up) and their strengths.
LIGHTS = (((0.75, -0.35, 0.56), 0.55), ((0.45, 0.85, 0.05), 0.26), ((1.0, 0.0, 0.0), 0.10))
AMBIENT = 0.27


@dataclass(frozen=True, eq=False)
class Camera:
    """A parallel projection. In: axes (3, 3), centre ((3,), m)."""

    axes: Floats
    centre: Floats
    width: int
    height: int
    scale: float

    def project(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Return pixels (..., 2), x to the right and y down, and nearness (...,) m."""
        local = (np.asarray(points, dtype=np.float64) - self.centre) @ self.axes.T
        x = self.width / 2 + self.scale * local[..., 1]
        y = self.height / 2 - self.scale * local[..., 2]
        return np.stack([x, y], axis=-1), local[..., 0]


def camera_for(
    points: ArrayLike, *, size: tuple[int, int], view: ArrayLike = DEFAULT_VIEW, fill: float = 0.78
) -> Camera:
    """Place a camera so that points (N, 3) fill a share of a picture (width, height)."""
    cloud = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    towards = np.asarray(view, dtype=np.float64)
    if not len(cloud):
        raise NumericalError("there is nothing to draw: the mesh is empty")
    if not np.isfinite(cloud).all():
        raise NumericalError("there is a point to draw that is not finite")
    towards = towards / np.linalg.norm(towards)
    # Looking straight down, x points down in the picture, as on a map with +x towards the viewer.
    up = np.array([-1.0, 0, 0]) if abs(towards[2]) > 0.999 else np.array([0, 0, 1.0])
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    axes = np.stack([towards, right, np.cross(towards, right)])
    local = cloud @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    extent = np.maximum(high - low, 1e-9)
    scale = fill * min(size[0] / extent[1], size[1] / extent[2])
    return Camera(axes, (low + high) / 2 @ axes, size[0], size[1], float(scale))


def background(width: int, height: int) -> Floats:
    """Return a soft vertical gradient, (H, W, 3) in 0 to 1."""
    fall = np.linspace(0, 1, height)[:, None, None]
    top, bottom = np.array([0.985, 0.988, 0.992]), np.array([0.86, 0.875, 0.89])
    return np.broadcast_to(top + (bottom - top) * fall**1.5, (height, width, 3)).copy()


def _lit(normals: Floats) -> Floats:
    """Return the brightness of unit normals (N, 3) in the camera's frame."""
    brightness = AMBIENT + 0.10 * normals[:, 2]  # more light from the sky than from the ground
    for direction, strength in LIGHTS:
        light = np.asarray(direction) / np.linalg.norm(direction)
        brightness = brightness + strength * np.maximum(normals @ light, 0)
    return np.maximum(brightness, 0.05)


def draw_mesh(pixels: Floats, mesh: trimesh.Trimesh, camera: Camera, colour: ArrayLike) -> Floats:
    """Draw a mesh over pixels, in place.

    In: pixels (H, W, 3), colour ((3,) or (V, 3)). Out: nearness ((H, W), m), minus infinity where
    nothing is drawn.
    """
    height, width = pixels.shape[:2]
    local = (np.asarray(mesh.vertices) - camera.centre) @ camera.axes.T
    nearest = float(local[:, 0].max())
    rows, columns = np.indices((height, width)).reshape(2, -1) + 0.5
    origins = np.zeros((height * width, 3))
    origins[:, 0] = nearest + float(np.ptp(local, axis=0).max())
    origins[:, 1] = (columns - width / 2) / camera.scale
    origins[:, 2] = (height / 2 - rows) / camera.scale
    low, high = local[:, 1:].min(axis=0), local[:, 1:].max(axis=0)
    cast = np.flatnonzero(((origins[:, 1:] >= low) & (origins[:, 1:] <= high)).all(axis=1))
    caster = RayCaster(trimesh.Trimesh(local, mesh.faces, process=False, validate=False))
    hits = caster.first_hit(origins[cast], np.tile([-1.0, 0.0, 0.0], (len(cast), 1)))
    seen = cast[hits.ray]
    nearness = np.full(height * width, -np.inf)
    nearness[seen] = hits.points[:, 0]
    # The back of a sheet is lit like its front.
    normals = np.where(hits.flat[:, :1] < 0, -hits.normals, hits.normals)
    base = np.asarray(colour, dtype=np.float64)
    if base.ndim == 2:
        weights = trimesh.triangles.points_to_barycentric(
            local[np.asarray(mesh.faces)[hits.triangle]], hits.points
        )
        base = np.einsum("nc,nci->ni", weights, base[np.asarray(mesh.faces)[hits.triangle]])
    image = nearness.reshape(height, width)
    shade = _lit(normals) * _crevices(image).reshape(-1)[seen]
    pixels.reshape(-1, 3)[seen] = np.clip(base * shade[:, None], 0, 1)
    return image


def _crevices(nearness: Floats) -> Floats:
    """Return the ambient light of each pixel: less where its surroundings are nearer."""
    there = np.isfinite(nearness)
    if not there.any():
        return np.ones(nearness.shape)
    low, high = nearness[there].min(), nearness[there].max()
    filled = np.where(there, nearness - low, 0).astype(np.float32)
    # A blur this wide need not be computed at every pixel.
    coarse = 4
    radius = 0.02 * max(nearness.shape) / coarse
    mask = gaussian_filter(there[::coarse, ::coarse].astype(np.float32), radius)
    blurred = gaussian_filter(filled[::coarse, ::coarse], radius) / np.maximum(mask, 1e-6)
    rows, columns = (np.arange(size, dtype=np.float32) / coarse for size in nearness.shape)
    around = map_coordinates(
        blurred, np.meshgrid(rows, columns, indexing="ij"), order=1, mode="nearest"
    )
    rise = (around - filled) / max(high - low, 1e-9)
    return 1 - np.clip(1.6 * rise, -0.06, 0.30)


def averaged(pixels: Floats, factor: int = OVERSAMPLING) -> NDArray[np.uint8]:
    """Average blocks of pixels (H, W, 3) in 0 to 1 into bytes."""
    height, width = pixels.shape[0] // factor, pixels.shape[1] // factor
    blocks = pixels[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return np.round(255 * blocks.mean(axis=(1, 3))).astype(np.uint8)
