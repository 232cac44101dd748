# SPDX-License-Identifier: MIT
"""How good the surfaces of bodies are that nobody of this project drew.

Each start surface, the surface that each candidate of the refinement ends with, and the one that is
chosen are compared with the truth, so that a choice that harms is seen.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import trimesh
from torch import Tensor

import sononerf
from sononerf import storage
from sononerf.evaluation.metrics import Solid, geometry_metrics
from sononerf.refinement.reconstruction import starts_of
from sononerf.refinement.refine import Saved
from sononerf.settings.loading import load_settings
from tools.benchmarks.experiment import (
    CONFIG,
    STOPPED,
    Row,
    aligned,
    append_line,
    ending,
    ensemble_name,
    origin,
    rows_of,
)

KINDS = (".ply", ".stl", ".obj", ".off")
"""Endings of the files that are taken."""
STARTS = ("levels", "fuller", "sheet")
"""Order of the starts in the table."""


def foreign(arguments: argparse.Namespace, output: Path) -> str:
    """Reconstruct all bodies of a folder; one line of JSON for each and number of calls."""
    bodies = sorted(file for file in arguments.foreign.iterdir() if file.suffix.lower() in KINDS)
    if not bodies:
        raise SystemExit(f"error: {arguments.foreign}: holds no mesh ({', '.join(KINDS)})")
    file = output / "foreign.jsonl"
    for calls in arguments.calls:
        for body in bodies:
            settings = settings_of(body, calls, arguments.set)
            head = {"name": body.stem, "calls": calls, "settings": settings[2:]}
            if any(head.items() <= row.items() for row in rows_of(file)):
                continue
            with ending(output):
                line = storage.to_json({**head, **origin(), **measured(body, settings, output)})
                storage.make_folder(output)
                append_line(file, line)
                print(line, file=sys.stderr, flush=True)
    return f"{table(rows_of(file))}\nwrote {file}"


def settings_of(body: Path, calls: int, more: Sequence[str]) -> list[str]:
    """Return the settings of one body, ``KEY=VALUE``; the first two name it."""
    path = f"scene.options.path={body.resolve()}"
    return ["scene.name=mesh", path, "scene.options.unit=m", f"poses.count={calls}", *more]


def measured(body: Path, settings: Sequence[str], output: Path) -> Row:
    """Return the scores of one body, and the seconds that its surface took."""
    store = output / "data" / ensemble_name(load_settings(CONFIG, settings))
    command = [sys.executable, "-m", "sononerf.cli", "simulate", str(CONFIG), *settings]
    code = subprocess.run([*command, "--output", str(store)], stdout=sys.stderr, check=False)
    if code.returncode in STOPPED:
        raise KeyboardInterrupt
    if code.returncode:
        raise RuntimeError(f"{body}: exit code {code.returncode}: its echoes were not simulated")
    truth = Solid(trimesh.load_mesh(body))
    echoes, begun = sononerf.Echoes.open(store), time.monotonic()
    surface = sononerf.reconstruct(echoes)
    saved: Saved = {}
    found = sononerf.refine(surface, echoes, accelerator="cpu", saved=saved)
    ended = time.monotonic()
    refined = best_of(saved)
    return {
        "starts": {name: scores(mesh, truth) for name, mesh in starts_of(surface).items()},
        "refined": {name: scores(mesh, truth) for name, mesh in refined.items()},
        "result": scores(found.mesh, truth),
        "chosen": found.method,
        "kept": found.refined,
        "surface_s": ended - begun,
    }


def best_of(saved: Saved) -> dict[str, trimesh.Trimesh]:
    """Return the refined surface of each start with the lowest objective."""
    found: dict[str, dict[str, Tensor]] = {}
    for name, stage in saved.items():
        start = name.partition("-")[0]
        if start not in found or stage["objective"] < found[start]["objective"]:
            found[start] = stage
    return {
        start: trimesh.Trimesh(one["vertices"].numpy(), one["faces"].numpy(), process=False)
        for start, one in found.items()
    }


def scores(mesh: trimesh.Trimesh, truth: Solid) -> Row:
    """Return Chamfer distance, F-scores at 1, 2 and 5 mm, parts and volume of a surface."""
    geometry = geometry_metrics(mesh, truth)
    return {
        "chamfer_m": geometry["chamfer_m"],
        **{f"fscore_{mm}mm": geometry["fscore"][f"0.00{mm}"] for mm in (1, 2, 5)},
        "parts": geometry["components"],
        "parts_true": geometry["components_true"],
        "volume_ratio": geometry["volume_ratio"],
    }


def _columns(row: Row) -> Iterator[tuple[str, float]]:
    """Yield what is compared of a row: F-scores at 2 mm, and the result's Chamfer distance."""
    for what in ("starts", "refined"):
        for name in STARTS:
            if name in row[what]:
                title = name if what == "starts" else f"{name}, refined"
                yield title, row[what][name]["fscore_2mm"]
    best = max(one["fscore_2mm"] for one in [*row["starts"].values(), *row["refined"].values()])
    yield "best", best
    yield "result", row["result"]["fscore_2mm"]
    yield "F 5mm", row["result"]["fscore_5mm"]
    yield "mm", 1e3 * row["result"]["chamfer_m"]


def table(rows: Iterable[Row]) -> str:
    """Return F-scores at 2 mm by start, refined or not, and of the result, as lines of text."""
    parts = []
    every = [*STARTS, *(f"{name}, refined" for name in STARTS), "best", "result", "F 5mm", "mm"]
    for calls in sorted({row["calls"] for row in rows}, reverse=True):
        some = sorted((row for row in rows if row["calls"] == calls), key=lambda row: row["name"])
        columns: list[dict[str, float]] = [dict(_columns(row)) for row in some]
        titles = [title for title in every if any(title in found for found in columns)]
        lines = [[f"{calls} calls", *titles, "parts", "true", "s", "chosen"]]
        for row, found in zip(some, columns, strict=True):
            result: dict[str, Any] = row["result"]
            lines.append(
                [
                    row["name"],
                    *(f"{found[title]:.2f}" if title in found else "-" for title in titles),
                    str(result["parts"]),
                    str(result["parts_true"]),
                    f"{row['surface_s']:.0f}",
                    row["chosen"] + ("" if row["kept"] else ", unrefined"),
                ]
            )
        for name, pick in (
            ("median", statistics.median),
            ("least", min),
            ("mean", statistics.fmean),
        ):
            values = [[one[title] for one in columns if title in one] for title in titles]
            lines.append(
                [name, *(f"{pick(each):.2f}" if each else "-" for each in values), *4 * [""]]
            )
        parts.append("\n".join(aligned(lines)))
    return "\n\n".join(parts)
