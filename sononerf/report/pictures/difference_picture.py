# SPDX-License-Identifier: MIT
"""Pictures of what is heard of one scene and not of another."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.evaluation.prediction import Comparison
from sononerf.report.pictures.figure import figure, pixels_from_figure, png_from_pixels
from sononerf.report.pictures.mesh_picture import mesh_png
from sononerf.report.pictures.mip_picture import maximum_intensity_projections
from sononerf.report.pictures.shading import DEFAULT_VIEW

LEVEL_COLOURS, DIFFERENCE_COLOURS = "magma", "RdBu_r"
PANEL = 3.4  # inches, the longer side of one projection
SILENT = np.array((0.80, 0.80, 0.80))
"""Of a surface where nothing differs."""


def difference_pngs(
    comparison: Comparison, titles: tuple[str, str], *, truth: ArrayLike | None = None
) -> dict[str, bytes]:
    """Draw two volumes and their difference along each axis: ``"x"``, ``"y"``, ``"z"``.

    Parameters
    ----------
    comparison : Comparison
        What to draw; a ring marks the strongest difference, where there is one.
    titles : (str, str)
        Names of the two.
    truth : (3,) float, m, optional
        Where something was truly added; a cross marks it.

    Returns
    -------
    pictures : dict
        PNG files by the axis looked along.
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
            pictures[name] = png_from_pixels(pixels_from_figure(drawn))
    return pictures


def _strongest_along(values: NDArray[np.floating]) -> dict[str, NDArray[np.floating]]:
    """Return along each axis the value that is farthest from zero."""
    found = {}
    for axis, name in enumerate("xyz"):
        index = np.expand_dims(np.abs(values).argmax(axis=axis), axis)
        found[name] = np.take_along_axis(values, index, axis).squeeze(axis)
    return found


def overlay_png(
    mesh: trimesh.Trimesh, comparison: Comparison, *, view: ArrayLike = DEFAULT_VIEW
) -> bytes:
    """Draw a mesh coloured by the difference next to its surface: red where the first has more.

    Parameters
    ----------
    mesh : Trimesh
        Metres, world frame.
    comparison : Comparison
        The difference.
    view : (3,) float
        Direction to the camera.
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
