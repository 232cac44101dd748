# SPDX-License-Identifier: MIT
"""Spectrograms: measured, predicted, and their difference; the first pings of an import."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.geometry.poses import Poses
from sononerf.head.front_end import ACTIVE_DB
from sononerf.numerics import Floats, Ints
from sononerf.report.figure import PictureFormat, figure, picture_bytes, pixels_from_figure

MARGIN = 0.02
"""Range that is shown before the first and after the last active cell, m."""
LEVEL_MAP, DIFFERENCE_MAP = "magma", "RdBu_r"
MOST_ROWS = 8  # number of receivers, at most, that are drawn, evenly chosen
# Where a logarithmic axis is marked.
KHZ_MARKS = [digit * 10.0**power for power in range(-3, 4) for digit in (1, 2, 5)]


def spectrogram_picture(
    measured_db: ArrayLike | None,
    predicted_db: ArrayLike | None,
    range_m: ArrayLike,
    frequency_hz: ArrayLike,
    title: str = "",
    *,
    kind: PictureFormat = "png",
) -> bytes:
    """Draw one pose's spectrograms, one row per receiver, of eight at most.

    In: measured_db, predicted_db ((E, R, F) or None, dB), range_m ((R,), m), frequency_hz ((F,),
    Hz).
    """
    given = (measured_db, predicted_db, range_m, frequency_hz)
    with _drawn(*given, title, 130) as drawn:
        return picture_bytes(drawn, kind)


def spectrogram_image(
    measured_db: ArrayLike | None,
    predicted_db: ArrayLike | None,
    range_m: ArrayLike,
    frequency_hz: ArrayLike,
    title: str = "",
) -> NDArray[np.uint8]:
    """Return the picture of :func:`spectrogram_picture` as pixels (H, W, 3), smaller."""
    with _drawn(measured_db, predicted_db, range_m, frequency_hz, title, 90) as drawn:
        return pixels_from_figure(drawn)


CELL, CELL_GAP = (380, 150), 12
"""Width and height of a receiver's spectrogram in :func:`quick_image`, and between two, pixels."""
LIVE_DB, LIVE_DIFFERENCE_DB = 50.0, 12.0
"""Ends of the colours in :func:`quick_image`, dB; fixed, so that pictures can be compared."""


def quick_image(
    levels_db: Mapping[str, ArrayLike], range_m: ArrayLike, frequency_hz: ArrayLike
) -> NDArray[np.uint8]:
    """Return one pose's spectrograms as pixels (H, W, 3), drawn in milliseconds.

    A row per receiver, at most four; a column per kind of level, and with two kinds a third column
    with the second minus the first. Only the ends of the axes are labelled.

    In: levels_db ((E, R, F), dB), range_m ((R,), m), frequency_hz ((F,), Hz).
    """
    from matplotlib import colormaps
    from PIL import Image, ImageDraw, ImageFont

    ranges, frequencies = np.asarray(range_m), np.asarray(frequency_hz) / 1e3
    parts = {name: np.asarray(level, dtype=np.float64) for name, level in levels_db.items()}
    chosen, ears = drawn_receivers(len(next(iter(parts.values()))), 4)
    columns = {
        f"{name}, 0 to {LIVE_DB:.0f} dB": colormaps[LEVEL_MAP](level[chosen] / LIVE_DB, bytes=True)
        for name, level in parts.items()
    }
    if len(parts) == 2:
        (_, first), (_, second) = parts.items()
        place = 0.5 + 0.5 * (second - first)[chosen] / LIVE_DIFFERENCE_DB
        title = f"difference, -{LIVE_DIFFERENCE_DB:.0f} to {LIVE_DIFFERENCE_DB:.0f} dB"
        columns[title] = colormaps[DIFFERENCE_MAP](place, bytes=True)
    (width, height), left, line = CELL, 56, 18
    size = left + len(columns) * (width + CELL_GAP), len(chosen) * (height + line) + line
    picture = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(12)

    def write(x: float, y: float, text: str, anchor: str = "la") -> None:
        draw.text((x, y), text, fill="black", font=font, anchor=anchor)

    for row, ear in enumerate(ears):
        top = row * (height + line) + line
        write(left - 4, top, f"{frequencies[-1]:.0f} kHz", "ra")
        write(left - 4, top + height - 14, f"{frequencies[0]:.0f} kHz", "ra")
        for column, (title, colours) in enumerate(columns.items()):
            x = left + column * (width + CELL_GAP)
            pixels = np.ascontiguousarray(colours[row, ..., :3].transpose(1, 0, 2)[::-1])
            cell = Image.fromarray(pixels).resize(CELL, Image.Resampling.BILINEAR)
            picture.paste(cell, (x, top))
            write(x, top - line + 1, f"{ear}: {title}")
            write(x, size[1] - line + 2, f"{ranges[0]:.3f} m")
            write(x + width, size[1] - line + 2, f"{ranges[-1]:.3f} m", "ra")
    return np.asarray(picture)


def sounding_slice(spectrograms: NDArray[np.floating], range_m: Floats) -> slice:
    """Return the slices with a sound in any of (..., R, F), with a margin.

    All slices if nothing sounds.
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
    measured_db: ArrayLike | None,
    predicted_db: ArrayLike | None,
    range_m: ArrayLike,
    frequency_hz: ArrayLike,
) -> tuple[dict[str, Floats], Floats, Floats]:
    ranges, frequencies = (np.asarray(a, dtype=np.float64) for a in (range_m, frequency_hz))
    levels = {
        name: np.asarray(values, dtype=np.float64)
        for name, values in (("measured", measured_db), ("predicted", predicted_db))
        if values is not None
    }
    return levels, ranges, frequencies


def drawn_receivers(count: int, most: int = MOST_ROWS) -> tuple[Ints, list[str]]:
    """Return the receivers that are drawn, evenly chosen, and their names."""
    chosen = np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)
    if count == 2:
        return chosen, ["left ear", "right ear"]
    return chosen, ["receiver" if count == 1 else f"receiver {number}" for number in chosen]


def axis_edges(axis: Floats) -> tuple[float, float]:
    """Return the outer edges of an axis' first and last cell, so that ticks stand at centres."""
    half = (axis[1] - axis[0]) / 2 if len(axis) > 1 else 0.5
    return float(axis[0] - half), float(axis[-1] + half)


def draw_cells(
    panel: Any, values: Floats, ranges: Floats, frequencies: Floats, **options: Any
) -> Any:
    """Draw cells (R, F) over range (m) and frequency (Hz, drawn in kHz) and return the picture.

    Where the steps of the frequency axis grow, the axis is logarithmic and each cell as tall as
    its channel is wide.
    """
    steps = np.diff(frequencies)
    if len(steps) < 2 or np.ptp(steps) <= 1e-6 * steps.mean():
        extent = (*axis_edges(ranges), *axis_edges(frequencies / 1e3))
        return panel.imshow(values.T, extent=extent, aspect="auto", **options)
    levels = np.log(frequencies / 1e3)
    between = (levels[1:] + levels[:-1]) / 2
    ends = 2 * levels[[0, -1]] - between[[0, -1]]
    rows = np.exp(np.concatenate(([ends[0]], between, [ends[1]])))
    columns = np.linspace(*axis_edges(ranges), len(ranges) + 1)
    picture = panel.pcolormesh(columns, rows, values.T, rasterized=True, **options)
    panel.set_yscale("log")
    marks = [mark for mark in KHZ_MARKS if rows[0] <= mark <= rows[-1]]
    panel.set_yticks(marks, labels=[f"{mark:g}" for mark in marks])
    panel.minorticks_off()
    return picture


def _round_up(value: float, step: float) -> float:
    return max(step, step * float(np.ceil(value / step - 1e-9)))


@contextmanager
def _drawn(
    measured_db: ArrayLike | None,
    predicted_db: ArrayLike | None,
    range_m: ArrayLike,
    frequency_hz: ArrayLike,
    title: str,
    dpi: int,
) -> Iterator[Any]:
    panels, ranges, frequencies = _checked(measured_db, predicted_db, range_m, frequency_hz)
    shown = sounding_slice(np.stack([*panels.values()]), ranges)
    panels, ranges = {name: values[:, shown] for name, values in panels.items()}, ranges[shown]
    top = _round_up(max(values.max() for values in panels.values()), 5)
    chosen, names = drawn_receivers(len(next(iter(panels.values()))))
    panels = {name: values[chosen] for name, values in panels.items()}
    ears, levels = len(chosen), len(panels)
    if levels == 2:
        panels["predicted − measured"] = panels["predicted"] - panels["measured"]
    width, height = 10.5 * len(panels) / 3 + (len(panels) == 1), 0.9 + 2.3 * ears
    # All pictures have the same parts, so one layout serves all of them.
    with figure(width, height, dpi, layout=None) as drawn:
        axes = drawn.subplots(ears, len(panels), sharex=True, sharey=True, squeeze=False)
        sides = {"left": 0.76 / width, "right": 1 - 0.45 / width}
        drawn.subplots_adjust(
            **sides, bottom=0.46 / height, top=1 - 0.48 / height, hspace=0.12, wspace=0.12
        )
        for column, (name, values) in enumerate(panels.items()):
            options: dict[str, Any] = {"cmap": LEVEL_MAP, "vmin": 0, "vmax": top}
            if column == 2:
                # One outlier must not set the scale of the colours.
                worst = _round_up(float(np.quantile(np.abs(values), 0.998)), 3)
                options = {"cmap": DIFFERENCE_MAP, "vmin": -worst, "vmax": worst}
            axes[0][column].set_title(name)
            axes[-1][column].set_xlabel("range (m)")
            for row, level in zip(axes, values, strict=True):
                picture = draw_cells(row[column], level, ranges, frequencies, **options)
                row[column].locator_params(axis="x", nbins=5)  # more would touch one another
            if column == 2:
                drawn.colorbar(picture, ax=axes[:, 2], label="difference (dB)", pad=0.04)
            elif column == levels - 1:
                drawn.colorbar(picture, ax=axes[:, :levels], label="level (dB)", pad=0.02)
        for row, name in zip(axes, names, strict=True):
            row[0].set_ylabel(f"{name}\nfrequency (kHz)")
        if title:
            drawn.suptitle(title, fontsize=10, y=1 - 0.06 / height, va="top")
        yield drawn


SHOWN_DB = 50.0
MOST_ARROWS = 400


def pings_png(
    waveforms: Sequence[NDArray[np.floating]],
    spectrograms: Sequence[NDArray[np.floating]],
    labels: Sequence[str],
    *,
    sampling_rate: float,
    range_m: Floats,
    frequency_hz: Floats,
    poses: Poses,
) -> bytes:
    """Draw the first pings of an import, so that a wrong convention can be seen.

    In: waveforms (sequence of (E, S) float), spectrograms (sequence of (E, R, F) float),
    sampling_rate (Hz), range_m ((R,), m), frequency_hz ((F,), Hz).
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
        return picture_bytes(drawn)


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


def _waveform(axes: Any, waveform: Floats, sampling_rate: float, label: str) -> None:
    time = 1e3 * np.arange(waveform.shape[1]) / sampling_rate
    for number, wave in enumerate(waveform):
        axes.plot(time, wave, linewidth=0.5, label=str(number))
    axes.set_title(label, fontsize=9)
    if 1 < len(waveform) <= 8:
        axes.legend(title="receiver", fontsize=7, title_fontsize=7, loc="upper right")
