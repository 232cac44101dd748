# SPDX-License-Identifier: MIT
"""What reading a fitted field out costs: seconds for each voxel size, medians of five."""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path

import torch

from sononerf import storage
from sononerf.run.run import Run
from sononerf.surface.start.read_out import StartMethod, read_field, start_surfaces
from tools.benchmarks.experiment import Row, aligned, ending, keep, ratios

REPEATS = 5


def reconstruct(arguments: argparse.Namespace) -> str:
    """Time volume and surface of fitted runs; on the CPU, no files are written but the table."""
    output = arguments.output or Path("runs") / "reconstruct"
    with ending(output):
        if arguments.compare is not None:
            storage.read_json(arguments.compare)
        rows: list[Row] = []
        for run in arguments.runs:
            fitted = Run(run)
            own = fitted.settings.reconstruction.spacing or fitted.model.field.resolution / 2
            for spacing in arguments.spacings or [own]:
                rows.append(_timed(run, spacing))
                print(f"{rows[-1]['name']}: done", file=sys.stderr, flush=True)
        found = {"rows": rows}
        text = f"{table(rows)}\nwrote {keep(output, 'reconstruct', 'cpu', found)}"
        return text if arguments.compare is None else f"{text}\n{ratios(arguments.compare, found)}"


def _timed(run: Path, spacing: float) -> Row:
    fitted = Run(run)
    options = fitted.settings.reconstruction
    method: StartMethod = "filled" if options.method in ("auto", "isosurface") else options.method
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        with torch.inference_mode():
            reading = read_field(
                fitted.model.field,
                fitted.hull,
                resolution=fitted.head.resolution,
                spacing=spacing,
                directions=options.directions,
            )
            list(start_surfaces(reading, [method]))
        seconds.append(time.perf_counter() - began)
    median = statistics.median(seconds)
    voxels = reading.volume.values.size
    return {
        "name": f"{run.resolve().name}, {1e3 * spacing:g} mm",
        "method": method,
        "voxels": voxels,
        "reconstruct_s": median,
        "voxels_per_s": voxels / median,
    }


def table(rows: list[Row]) -> str:
    """Return one line for each run and voxel size."""
    lines = [["run", "surface", "voxels", "s", "voxels/s"]]
    for row in rows:
        seconds, rate = f"{row['reconstruct_s']:.2f}", f"{row['voxels_per_s']:,.0f}"
        lines.append([row["name"], row["method"], f"{row['voxels']:,}", seconds, rate])
    return "\n".join(aligned(lines))
