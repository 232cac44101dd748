# SPDX-License-Identifier: MIT
"""Pictures of maximum-intensity projections, and of where two runs differ."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import zoom

from sononerf.errors import NumericalError
from sononerf.evaluation.numbers import Comparison
from sononerf.geometry.lattice import Volume, require_finite
from sononerf.numerics import Floats
from sononerf.report.figure import (
    DEFAULT_VIEW,
    PictureFormat,
    figure,
    picture_bytes,
    pixels_from_figure,
)
from sononerf.report.mesh_picture import mesh_png, round_length

# Reflectivity spans decades; values farther below the maximum are drawn black.
RANGE_DB = 40.0
COLOUR_MAP = "magma"
LONGEST_SIDE = 4.6  # inches

Scale = Literal["db", "linear"]
Extents = tuple[tuple[float, float], tuple[float, float]]


def _scaled(projection: ArrayLike, scale: Scale) -> Floats:
    """Return decibels below the greatest value, or the values themselves from zero."""
    values = np.asarray(projection, dtype=np.float64)
    if not np.isfinite(values).all():
        raise NumericalError("the projection holds values that are not finite")
    if scale == "linear":
        return np.maximum(values, 0)
    top = float(values.max())
    if not top > 0:
        return np.full(values.shape, -RANGE_DB)
    return 10 * np.log10(np.maximum(values / top, 10 ** (-RANGE_DB / 10)))


def _limits(values: Floats, scale: Scale) -> tuple[float, float]:
    if scale == "db":
        return -RANGE_DB, 0.0
    top = float(values.max())
    return 0.0, top if top > 0 else 1.0


def mip_picture(
    projection: ArrayLike,
    extents: Extents,
    labels: tuple[str, str],
    *,
    title: str = "",
    scale: Scale = "db",
    kind: PictureFormat = "png",
) -> bytes:
    """Draw one projection in millimetres.

    In: projection (A, B), extents (((low, high), (low, high)), m), labels (str, str).
    """
    values = _scaled(projection, scale)
    low, high = _limits(values, scale)
    (left, right), (bottom, top) = extents
    wide, tall = right - left, top - bottom
    inch = LONGEST_SIDE / max(wide, tall)
    # The colour bar is as high as the picture; a flat picture needs room for its label.
    width, height = max(1.4, wide * inch) + 1.6, max(2.2, tall * inch) + 0.9
    with figure(width, height, 130, layout="compressed") as drawn:
        axes = drawn.subplots()
        picture = _draw(axes, values, extents, (low, high))
        axes.set_xlabel(f"{labels[0]} (mm)")
        axes.set_ylabel(f"{labels[1]} (mm)")
        if title:
            axes.set_title(title)
        label = "dB below the maximum" if scale == "db" else "value"
        drawn.colorbar(picture, ax=axes, label=label, pad=0.02)
        return picture_bytes(drawn, kind)


def mip_image(
    projection: ArrayLike, *, scale: Scale = "db", longest: int = 384
) -> NDArray[np.uint8]:
    """Return one projection as pixels (H, W, 3), second axis upwards, without axes or labels.

    Values between voxels are interpolated, so that the longer side has about ``longest`` pixels.
    """
    from matplotlib import colormaps

    values = _scaled(projection, scale)
    low, high = _limits(values, scale)
    repeat = max(1, longest // max(values.shape))
    fine = zoom(values.T[::-1], repeat, order=1, grid_mode=True, mode="nearest")
    pixels: NDArray[np.uint8] = colormaps[COLOUR_MAP]((fine - low) / (high - low), bytes=True)
    return pixels[..., :3]


def _panels(volume: Volume) -> Iterator[tuple[str, Floats, Extents, tuple[str, str]]]:
    """Yield the axis looked along, the projection, its outer edges (m), and names of its axes."""
    edges = [
        (float(axis[0] - volume.spacing / 2), float(axis[-1] + volume.spacing / 2))
        for axis in volume.axes()
    ]
    for name, projection in maximum_intensity_projections(volume).items():
        first, second = (axis for axis in range(3) if "xyz"[axis] != name)
        extents = edges[first], edges[second]
        yield name, np.asarray(projection), extents, ("xyz"[first], "xyz"[second])


def mip_pictures(
    volume: Volume, *, scale: Scale = "db", kind: PictureFormat = "png"
) -> dict[str, bytes]:
    """Draw a volume's three projections, named by the axis looked along: "x", "y" and "z"."""
    return {
        name: mip_picture(
            projection, extents, labels, title=f"maximum along {name}", scale=scale, kind=kind
        )
        for name, projection, extents, labels in _panels(volume)
    }


def mips_image(volume: Volume) -> NDArray[np.uint8]:
    """Return the three projections beside one another as pixels (H, W, 3), with axes in mm.

    All parts have fixed places: finding a layout would take twice as long as drawing.
    """
    top = float(volume.values.max())
    with figure(10.5, 3.3, 90, layout=None) as drawn:
        for number, (name, projection, extents, labels) in enumerate(_panels(volume)):
            axes = drawn.add_axes((0.06 + 0.3 * number, 0.16, 0.235, 0.74))
            levels = 10 * np.log10(np.maximum(projection / top, 10 ** (-RANGE_DB / 10)))
            picture = _draw(axes, levels, extents, (-RANGE_DB, 0.0))
            axes.set_xlabel(f"{labels[0]} (mm)")
            axes.set_ylabel(f"{labels[1]} (mm)", labelpad=1)
            axes.set_title(f"maximum along {name}")
        bar = drawn.add_axes((0.925, 0.16, 0.014, 0.74))
        drawn.colorbar(picture, cax=bar, label="dB below the maximum")
        return pixels_from_figure(drawn)


def _draw(axes: Any, values: Floats, extents: Extents, limits: tuple[float, float]) -> Any:
    """Draw values (A, B) over millimetres and return the picture."""
    (left, right), (bottom, top) = extents
    length = round_length(0.3 * (right - left))
    end, height = right - 0.05 * (right - left), bottom + 0.06 * (top - bottom)
    axes.plot([1e3 * (end - length), 1e3 * end], [1e3 * height] * 2, color="white", linewidth=2)
    place = 1e3 * (end - length / 2), 1e3 * (height + 0.015 * (top - bottom))
    axes.text(*place, f"{1e3 * length:g} mm", color="white", fontsize=7, ha="center", va="bottom")
    return axes.imshow(
        values.T,
        cmap=COLOUR_MAP,
        vmin=limits[0],
        vmax=limits[1],
        extent=[1e3 * edge for edge in (left, right, bottom, top)],
        aspect="equal",
        interpolation="bilinear",
    )


def maximum_intensity_projections(volume: Volume) -> dict[str, NDArray[np.floating]]:
    """Return the greatest value along each axis."""
    require_finite(volume)
    return {name: volume.values.max(axis=axis) for axis, name in enumerate("xyz")}


LEVEL_COLOURS, DIFFERENCE_COLOURS = "magma", "RdBu_r"
PANEL = 3.4  # inches, the longer side of one projection
SILENT = np.array((0.80, 0.80, 0.80))
"""Colour of a surface without differences."""


def difference_pngs(
    comparison: Comparison, titles: tuple[str, str], *, truth: ArrayLike | None = None
) -> dict[str, bytes]:
    """Draw two volumes and their difference along each axis: ``"x"``, ``"y"``, ``"z"``.

    In: titles (str, str), truth ((3,), m).
    """
    volumes = (comparison.first, comparison.second, comparison.difference)
    projections = [maximum_intensity_projections(volume) for volume in volumes[:2]]
    projections.append(_strongest_along(comparison.difference.values))
    half = comparison.difference.spacing / 2
    axes_m = comparison.difference.axes()
    most = float(np.abs(comparison.difference.values).max()) or 1.0
    pictures = {}
    for name in "xyz":
        across, up = (axis for axis in range(3) if "xyz"[axis] != name)
        edges = [1e3 * e for a in (across, up) for e in (axes_m[a][0] - half, axes_m[a][-1] + half)]
        wide, tall = edges[1] - edges[0], edges[3] - edges[2]
        inch = PANEL / max(wide, tall)
        with figure(3 * max(1.6, wide * inch) + 2.6, max(2.2, tall * inch) + 0.8, 120) as drawn:
            panels = drawn.subplots(1, 3, sharex=True, sharey=True)
            for number, (panel, shown) in enumerate(zip(panels, projections, strict=True)):
                last = number == 2
                picture = panel.imshow(
                    shown[name].T,
                    cmap=DIFFERENCE_COLOURS if last else LEVEL_COLOURS,
                    vmin=-most if last else 0.0,
                    vmax=most if last else 1.0,
                    extent=edges,
                    aspect="equal",
                )
                panel.set_title("difference" if last else titles[number])
                panel.set_xlabel(f"{'xyz'[across]} (mm)")
                if number:
                    label = "level over the common maximum" if number == 1 else "first − second"
                    drawn.colorbar(picture, ax=panel, label=label, pad=0.02)
            panels[0].set_ylabel(f"{'xyz'[up]} (mm)")
            if comparison.strongest is not None:
                place = 1e3 * comparison.strongest
                panels[2].plot(
                    place[across], place[up], "o", mfc="none", mec="black", ms=14, label="strongest"
                )
            if truth is not None:
                real = 1e3 * np.asarray(truth)
                panels[2].plot(real[across], real[up], "k+", ms=10, label="true")
            if panels[2].get_legend_handles_labels()[1]:
                panels[2].legend(loc="best", fontsize=7)
            pictures[name] = picture_bytes(drawn)
    return pictures


def _strongest_along(values: NDArray[np.floating]) -> dict[str, NDArray[np.floating]]:
    """Return along each axis the value that is farthest from zero."""
    projections = {}
    for axis, name in enumerate("xyz"):
        index = np.expand_dims(np.abs(values).argmax(axis=axis), axis)
        projections[name] = np.take_along_axis(values, index, axis).squeeze(axis)
    return projections


def overlay_png(
    mesh: trimesh.Trimesh, comparison: Comparison, *, view: ArrayLike = DEFAULT_VIEW
) -> bytes:
    """Draw a mesh coloured by the difference next to its surface: red where the first has more.

    In: view (3,).
    """
    from matplotlib import colormaps
    from scipy.ndimage import map_coordinates

    volume = comparison.difference
    at = (np.asarray(mesh.vertices) - volume.origin) / volume.spacing
    values = map_coordinates(volume.values, at.T, order=1, mode="constant")
    most = float(np.abs(volume.values).max()) or 1.0
    strength = np.abs(values / most)[:, None]
    colours = colormaps[DIFFERENCE_COLOURS](0.5 + 0.5 * values / most)[:, :3]
    return mesh_png(mesh, view=view, colours=SILENT * (1 - strength) + colours * strength)
