# SPDX-License-Identifier: MIT
"""How cost grows with poses, range slices, the size of the scene and the resolution.

Each figure is that of a whole ``sononerf fit``. One thing grows at a time; between the first and
the last of its rows each cost is said to grow with a power of it, by which what does not fit here
may be estimated. Memory is that of the command and of all processes that it started, together,
looked at twice a second: pages that they share count for each of them.
"""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from sononerf import storage
from tools.benchmarks.experiment import Row, aligned, ending, origin, run_experiment

SECONDS = 0.5
COUNTS = (100, 400, 1600)


class Case(NamedTuple):
    """One value of what grows."""

    axis: str
    value: float
    settings: tuple[str, ...]

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.axis}-{self.value:g}"


def _part(scale: float) -> tuple[str, ...]:
    parts = f"scene.options.parts=[{{scene: three_spheres, scale: {scale:g}}}]"
    return "scene.name=composed", parts, "poses.radius=0.5"


OTHERS = (
    *(Case("slices", n, (f"spectrogram.range_max={m}",)) for n, m in ((438, 0.45), (1750, 1.35))),
    *(Case("size", s, _part(s)) for s in (1, 2, 3)),
    *(Case("places", n, (f"field.options.spacing={1 / n:g}",)) for n in (125, 250, 500)),
)
"""Beside the poses: slices, times the size of three spheres, places of the field along a metre."""


def scale(arguments: argparse.Namespace) -> str:
    """Fit ever larger experiments; table, memory and the power by which each cost grows."""
    output = arguments.output or Path("runs") / "scale"
    poses = [Case("poses", n, (f"poses.count={n}",)) for n in arguments.counts]
    rows: list[Row] = []
    for case in (*poses, *OTHERS):
        if arguments.axes and case.axis not in arguments.axes:
            continue
        settings = [*case.settings, *arguments.set]
        file = output / f"{case.name}.json"
        with ending(output):
            try:
                rows.append(_row(case, settings, output, arguments.data or output / "data", file))
            except RuntimeError as error:
                rows.append({"axis": case.axis, "value": case.value, "failed": str(error)})
        said = rows[-1].get("failed", "done")
        print(f"{output / case.name}: {said}", file=sys.stderr, flush=True)
        found = {**origin(), "rows": rows, "powers": powers(rows)}
        storage.commit_json(output / "scale.json", found)
    return f"{table(rows)}\n{sentences(powers(rows))}\nwrote {output / 'scale.json'}"


def _row(case: Case, settings: list[str], output: Path, data: Path, file: Path) -> Row:
    """Run a case, or take what is known of it: time and memory are those of one whole run."""
    if file.is_file():
        kept: Row = storage.read_json(file)
        return kept
    with watched() as seen:
        metrics = run_experiment(output / case.name, data, settings)
    row = {"axis": case.axis, "value": case.value, **row_of(metrics), **seen}
    storage.commit_json(file, row)
    return row


@contextmanager
def watched() -> Iterator[dict[str, float]]:
    """Give the seconds that passed and the most memory that this process's children had."""
    seen = {"wall_s": 0.0, "memory_bytes": 0.0}
    done = threading.Event()

    def look() -> None:
        while not done.wait(SECONDS):
            seen["memory_bytes"] = max(seen["memory_bytes"], _children_bytes())

    watch = threading.Thread(target=look, daemon=True)
    began = time.monotonic()
    watch.start()
    try:
        yield seen
    finally:
        done.set()
        watch.join()
        seen["wall_s"] = time.monotonic() - began


def _children_bytes() -> float:
    total = 0.0
    for child in psutil.Process().children(recursive=True):
        try:
            total += child.memory_info().rss
        except psutil.Error:
            continue  # it has ended since
    return total


def row_of(metrics: dict[str, Any]) -> Row:
    """Return the costs that are compared; None for what a run does not have."""
    cost, prediction, geometry = (
        metrics.get(part) or {} for part in ("cost", "prediction", "geometry")
    )
    fit_s, steps = cost.get("fit_s"), cost.get("steps")
    return {
        "simulate_s": cost.get("simulate_s"),
        "fit_s": fit_s,
        "steps": steps,
        "step_s": fit_s / steps if fit_s and steps else None,
        "reconstruct_s": cost.get("reconstruct_s"),
        "mae_db": prediction.get("mae_db"),
        "fscore_2mm": geometry.get("fscore", {}).get("0.002"),
    }


COSTS = ("simulate_s", "step_s", "reconstruct_s", "wall_s", "memory_bytes")


def powers(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return by what power of the value each cost grows, from the first row of an axis to the last.

    Parameters
    ----------
    rows : sequence of dict
        With ``axis``, ``value`` and the costs.

    Returns
    -------
    powers : dict of dict
        By axis and cost; none of an axis of which fewer than two rows came to an end.
    """
    found: dict[str, dict[str, float]] = {}
    for axis in dict.fromkeys(row["axis"] for row in rows):
        own = [row for row in rows if row["axis"] == axis and "failed" not in row]
        if len(own) < 2:
            continue
        first, last = own[0], own[-1]
        times = math.log(last["value"] / first["value"])
        found[axis] = {
            cost: math.log(last[cost] / first[cost]) / times
            for cost in COSTS
            if first.get(cost) and last.get(cost)
        }
    return found


COLUMNS = (
    ("simulate_s", "simulate/s", ".1f", 1.0),
    ("steps", "steps", "d", 1),
    ("fit_s", "fit/s", ".0f", 1.0),
    ("step_s", "step/ms", ".1f", 1e3),
    ("reconstruct_s", "read-out/s", ".1f", 1.0),
    ("wall_s", "all/s", ".0f", 1.0),
    ("memory_bytes", "memory/GB", ".2f", 1e-9),
    ("mae_db", "held-out/dB", ".2f", 1.0),
    ("fscore_2mm", "F 2mm", ".2f", 1.0),
)


def table(rows: Sequence[Row]) -> str:
    """Return one line for each case, and one for each that failed."""
    lines = [["grows", "to", *(title for _, title, _, _ in COLUMNS)]]
    for row in rows:
        shown = [
            "-" if row.get(key) is None else f"{times * row[key]:{form}}"
            for key, _, form, times in COLUMNS
        ]
        lines.append([row["axis"], f"{row['value']:g}", *shown])
    failed = [f"{row['axis']} {row['value']:g}: {row['failed']}" for row in rows if "failed" in row]
    return "\n".join([*aligned(lines), *failed])


def sentences(found: dict[str, dict[str, float]]) -> str:
    """Return one line for each axis."""
    lines = ["grows with the power of"]
    for axis, own in found.items():
        said = (f"{cost.rpartition('_')[0]} {power:.2f}" for cost, power in own.items())
        lines.append(f"{axis}: {', '.join(said)}")
    return "\n".join(lines)
