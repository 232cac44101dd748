# SPDX-License-Identifier: MIT
"""Spectrograms of both ears: measured, predicted, and their difference."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.errors import NumericalError
from sononerf.render.figure import figure, pixels_from_figure, png_from_pixels

# What counts as sound, and how much of the range axis is shown around it.
ACTIVE_DB = 3.0
MARGIN = 0.02
LEVEL_MAP, DIFFERENCE_MAP = "magma", "RdBu_r"


def spectrogram_png(
    measured_db: ArrayLike,
    predicted_db: ArrayLike,
    range_m: ArrayLike,
    frequency_hz: ArrayLike,
    title: str = "",
) -> bytes:
    """Draw one pose's spectrograms, one row per ear.

    Parameters
    ----------
    measured_db, predicted_db : (E, R, F) float, dB
        0 dB is silence.
    range_m : (R,) float, m
        Range axis, ascending; drawn only around what sounds.
    frequency_hz : (F,) float, Hz
        Frequency axis, ascending; drawn in kHz.
    title : str
        One line above.

    Returns
    -------
    data : bytes
        A PNG file.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    NumericalError
        If a value is not finite.
    """
    return png_from_pixels(_pixels(measured_db, predicted_db, range_m, frequency_hz, title, 130))


def spectrogram_image(
    measured_db: ArrayLike,
    predicted_db: ArrayLike,
    range_m: ArrayLike,
    frequency_hz: ArrayLike,
    title: str = "",
) -> NDArray[np.uint8]:
    """Return the picture of :func:`spectrogram_png` as pixels (H, W, 3), smaller."""
    return _pixels(measured_db, predicted_db, range_m, frequency_hz, title, 90)


def sounding_slice(spectrograms: NDArray[np.floating], range_m: NDArray[np.float64]) -> slice:
    """Return the part of the range axis that sounds in any of (..., R, F), with a margin.

    All of it where nothing sounds.
    """
    loudest = spectrograms.max(axis=-1).reshape(-1, len(range_m)).max(axis=0)
    active = np.flatnonzero(loudest >= ACTIVE_DB)
    if not len(active):
        return slice(0, len(range_m))
    low, high = range_m[active[0]] - MARGIN, range_m[active[-1]] + MARGIN
    return slice(
        int(np.searchsorted(range_m, low)), int(np.searchsorted(range_m, high, side="right"))
    )


def _checked(
    measured_db: ArrayLike, predicted_db: ArrayLike, range_m: ArrayLike, frequency_hz: ArrayLike
) -> tuple[NDArray[np.float64], ...]:
    measured, predicted, ranges, frequencies = (
        np.asarray(values, dtype=np.float64)
        for values in (measured_db, predicted_db, range_m, frequency_hz)
    )
    expected = (len(measured), len(ranges), len(frequencies))
    if measured.shape != expected or predicted.shape != expected or not measured.size:
        raise ValueError(
            f"measured {measured.shape} and predicted {predicted.shape}: expected (E, R, F) with "
            f"R = {len(ranges)} and F = {len(frequencies)}"
        )
    for name, values in (("measured", measured), ("predicted", predicted)):
        if not np.isfinite(values).all():
            raise NumericalError(f"the {name} spectrogram holds values that are not finite")
    return measured, predicted, ranges, frequencies


def axis_edges(axis: NDArray[np.float64]) -> tuple[float, float]:
    """Return the outer edges of an axis' first and last cell, so that ticks stand at centres."""
    half = (axis[1] - axis[0]) / 2 if len(axis) > 1 else 0.5
    return float(axis[0] - half), float(axis[-1] + half)


def _round_up(value: float, step: float) -> float:
    return max(step, step * float(np.ceil(value / step - 1e-9)))


def _pixels(
    measured_db: ArrayLike,
    predicted_db: ArrayLike,
    range_m: ArrayLike,
    frequency_hz: ArrayLike,
    title: str,
    dpi: int,
) -> NDArray[np.uint8]:
    measured, predicted, ranges, frequencies = _checked(
        measured_db, predicted_db, range_m, frequency_hz
    )
    shown = sounding_slice(np.stack([measured, predicted]), ranges)
    measured, predicted, ranges = measured[:, shown], predicted[:, shown], ranges[shown]
    difference = predicted - measured
    top = _round_up(max(measured.max(), predicted.max()), 5)
    # A single odd cell must not bleach all the others.
    worst = _round_up(float(np.quantile(np.abs(difference), 0.998)), 3)
    ears = len(measured)
    names = ["left ear", "right ear"] if ears == 2 else [f"ear {ear}" for ear in range(ears)]
    extent = (*axis_edges(ranges), *axis_edges(frequencies / 1e3))
    with figure(10.5, 0.9 + 2.3 * ears, dpi) as drawn:
        axes = drawn.subplots(ears, 3, sharex=True, sharey=True, squeeze=False)
        for ear in range(ears):
            panels = measured[ear], predicted[ear], difference[ear]
            levels = _row(axes[ear], panels, extent, top, worst)
            axes[ear, 0].set_ylabel(f"{names[ear]}\nfrequency (kHz)")
        for axis, name in zip(
            axes[0], ("measured", "predicted", "predicted − measured"), strict=True
        ):
            axis.set_title(name)
        for axis in axes[-1]:
            axis.set_xlabel("range (m)")
        drawn.colorbar(levels[0], ax=axes[:, :2], label="level (dB)", pad=0.01, aspect=12 * ears)
        drawn.colorbar(
            levels[1], ax=axes[:, 2:], label="difference (dB)", pad=0.02, aspect=12 * ears
        )
        if title:
            drawn.suptitle(title, fontsize=10)
        return pixels_from_figure(drawn)


def _row(
    axes: Any,
    panels: tuple[NDArray[np.float64], ...],
    extent: tuple[float, ...],
    top: float,
    worst: float,
) -> tuple[Any, Any]:
    """Draw one ear; returns what the two colour bars are made from."""
    options = {"extent": extent, "aspect": "auto"}
    measured, predicted, difference = (panel.T for panel in panels)
    level = axes[0].imshow(measured, cmap=LEVEL_MAP, vmin=0, vmax=top, **options)
    axes[1].imshow(predicted, cmap=LEVEL_MAP, vmin=0, vmax=top, **options)
    deviation = axes[2].imshow(difference, cmap=DIFFERENCE_MAP, vmin=-worst, vmax=worst, **options)
    for panel in axes:
        panel.locator_params(axis="x", nbins=5)  # more labels would touch one another
    return level, deviation
