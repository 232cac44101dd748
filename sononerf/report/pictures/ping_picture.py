# SPDX-License-Identifier: MIT
"""First pings of an import: poses from above and from the side, waveforms, spectrograms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.geometry.poses import Poses
from sononerf.report.pictures.figure import figure, pixels_from_figure, png_from_pixels
from sononerf.report.pictures.spectrogram_picture import LEVEL_MAP, axis_edges

Array = NDArray[np.float64]

SHOWN_DB = 50.0
MOST_ARROWS = 400


def pings_png(
    waveforms: Sequence[NDArray[np.floating]],
    spectrograms: Sequence[NDArray[np.floating]],
    labels: Sequence[str],
    *,
    sampling_rate: float,
    range_m: Array,
    frequency_hz: Array,
    poses: Poses,
) -> bytes:
    """Draw the first pings of an import, so that a wrong convention can be seen.

    Args:
        waveforms (sequence of (E, S) float): From the emission on.
        spectrograms (sequence of (E, R, F) float): Linear magnitude.
        labels: Names of these pings.
        sampling_rate (Hz): Of the waveforms.
        range_m ((R,), m): Ascending.
        frequency_hz ((F,), Hz): Ascending.
        poses: Of all pings; the first ones are marked.
    """
    rows = len(labels)
    with figure(10.5, 3.4 + 2.2 * rows, 100, layout="constrained") as drawn:
        grid = drawn.subplots(
            1 + rows, 2, gridspec_kw={"height_ratios": [3.4, *[2.2] * rows]}, squeeze=False
        )
        for axes, names in zip(grid[0], ((0, 1), (0, 2)), strict=True):
            _poses(axes, poses, names, rows)
        loudest = max((float(np.max(one)) for one in spectrograms), default=0.0) or 1.0
        for row, label in enumerate(labels):
            _waveform(grid[row + 1][0], np.asarray(waveforms[row]), sampling_rate, label)
            level = 20.0 * np.log10(np.maximum(np.asarray(spectrograms[row][0]) / loudest, 1e-12))
            axes = grid[row + 1][1]
            axes.imshow(
                level.T,
                origin="lower",
                extent=(*axis_edges(range_m), *axis_edges(frequency_hz / 1e3)),
                aspect="auto",
                cmap=LEVEL_MAP,
                vmin=-SHOWN_DB,
                vmax=0.0,
            )
            axes.set_ylabel("frequency (kHz)")
        grid[-1][0].set_xlabel("time after the emission (ms)")
        grid[-1][1].set_xlabel(f"range (m), receiver 0, {SHOWN_DB:.0f} dB")
        return png_from_pixels(pixels_from_figure(drawn))


def _poses(axes: Any, poses: Poses, shown: tuple[int, int], marked: int) -> None:
    few = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MOST_ARROWS)).astype(int))
    place, look = poses.positions[few][:, shown], poses.rotations[few][:, shown, 0]
    axes.quiver(*place.T, *look.T, angles="xy", color="0.5", width=0.003)
    axes.plot(*poses.positions[:marked, shown].T, "o", color="C1", markersize=4)
    axes.set_aspect("equal", adjustable="datalim")
    names = "xyz"
    axes.set_xlabel(f"{names[shown[0]]} (m)")
    axes.set_ylabel(f"{names[shown[1]]} (m)")
    axes.set_title("poses from above" if shown[1] == 1 else "poses from the side")


def _waveform(axes: Any, waveform: Array, sampling_rate: float, label: str) -> None:
    time = 1e3 * np.arange(waveform.shape[1]) / sampling_rate
    for number, wave in enumerate(waveform):
        axes.plot(time, wave, linewidth=0.5, label=str(number))
    axes.set_title(label, fontsize=9)
    if 1 < len(waveform) <= 8:
        axes.legend(title="receiver", fontsize=7, title_fontsize=7, loc="upper right")
