# SPDX-License-Identifier: MIT
"""How good a reconstruction gets with ever more calls."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sononerf import storage
from sononerf.report.pictures.figure import figure, pixels_from_figure, png_from_pixels
from tools.benchmarks.experiment import Row, run_series

COUNTS = (12, 25, 50, 100, 200, 400)


def poses(arguments: argparse.Namespace) -> str:
    """Fit one scene from ever more calls; table and curve."""
    output = arguments.output or Path("runs") / f"poses-{arguments.scene}"
    picture = output / "poses.png"

    def draw(rows: Sequence[Row]) -> None:
        storage.commit_bytes(picture, curve_png(rows, arguments.scene))

    scene = f"scene.name={arguments.scene}"
    text = run_series(
        output,
        "poses.json",
        (
            (str(count), {"calls": count}, [scene, f"poses.count={count}", *arguments.set])
            for count in arguments.counts
        ),
        data=arguments.data,
        seconds=arguments.seconds,
        after=draw,
    )
    return f"{text}\nwrote {picture}"


def curve_png(rows: Sequence[Row], title: str) -> bytes:
    """Draw the F-scores over the number of calls; runs that failed are left out.

    Parameters
    ----------
    rows : sequence of dict
        With ``calls`` and ``fscore_1mm``, ``fscore_2mm``, ``fscore_5mm``.
    title : str
        One line above.

    Returns
    -------
    data : bytes
        A PNG file.
    """
    with figure(4.6, 3.2, 150) as drawn:
        axes = drawn.add_subplot()
        for mm, colour in ((1, "#bc5090"), (2, "#ef9b20"), (5, "#003f5c")):
            key = f"fscore_{mm}mm"
            points = sorted((row["calls"], row[key]) for row in rows if row.get(key) is not None)
            calls, scores = [call for call, _ in points], [score for _, score in points]
            axes.plot(calls, scores, "o-", color=colour, markersize=4, label=f"{mm} mm")
        ticks = sorted({row["calls"] for row in rows})
        axes.set_xscale("log")
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.set_xticks([], minor=True)
        axes.set_ylim(0.0, 1.02)
        axes.set_xlabel("calls")
        axes.set_ylabel("F-score")
        axes.set_title(title)
        axes.grid(linewidth=0.3)
        drawn.legend(loc="outside right center", frameon=False)
        return png_from_pixels(pixels_from_figure(drawn))
