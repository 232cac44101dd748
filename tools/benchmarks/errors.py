# SPDX-License-Identifier: MIT
"""Whether the errors of surfaces and predictions hold, and how well they rank what is wrong."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sononerf import open_run, reconstruct
from sononerf.evaluation.numbers import signed_error
from sononerf.numerics import Floats
from sononerf.refinement.optics import Optics
from sononerf.refinement.reconstruction import starts_of
from sononerf.refinement.surface_error import surface_error
from sononerf.run.build import true_mesh
from sononerf.run.run import Run
from tools.benchmarks.experiment import Row, aligned

DRAWN = 2000
"""Vertices of each body that take part in the calibration, so that all bodies count the same."""
LEAST = 0.01
"""Distance from the truth that is added before the logarithm is taken, shortest wavelengths."""
MEMBERS = range(1, 5)
"""Seeds of the further runs of the same echoes that make an ensemble with seed 0."""


def errors(arguments: argparse.Namespace) -> str:
    """Compare errors of finished runs with the truth, or calibrate them; a line for each run."""
    if arguments.calibrate:
        return calibrated(arguments.runs)
    rows = [measured(run) for run in arguments.runs]
    names = [name for name in rows[0] if name != "run"]
    known = {name: [row[name] for row in rows if row[name] is not None] for name in names}
    mean = {name: float(np.mean(found)) if found else None for name, found in known.items()}
    lines = [["run", *names]]
    for row in [*rows, {"run": "mean", **mean}]:
        found = [row[name] for name in names]
        lines.append([str(row["run"]), *("" if x is None else f"{x:.3f}" for x in found)])
    return "\n".join(aligned(lines))


def measured(path: Path) -> Row:
    """Return what a run's errors hold, and the area under the sparsification error."""
    run = open_run(path)
    surface, distance = run.surface, off_truth(path)
    assert surface.error is not None, f"{path}: no errors"
    heard = surface.confidence > 0
    return {
        "run": path.name,
        "vertices held": float((distance <= surface.error)[heard].mean()),
        "unheard": float(1.0 - heard.mean()),
        "cells held": run.metrics["prediction"].get("interval_coverage"),
        "sparsification": sparsification(distance, surface.error),
        "by ensemble": _by_ensemble(path, distance),
        "by poses": sparsification(distance, -surface.confidence.astype(np.float64)),
        "median distance, mm": float(1e3 * np.median(distance)),
        "median error, mm": float(1e3 * np.median(surface.error[heard])),
    }


def _by_ensemble(path: Path, distance: Floats) -> float | None:
    """Return the area where vertices are ranked by their mean distance from the members' surfaces.

    The members are the runs beside it whose names end with another seed; None without them.
    """
    name = path.name.removesuffix("-0")
    members = [path.with_name(f"{name}-{seed}") for seed in MEMBERS]
    members = [member for member in members if Run(member).config.is_file()]
    if not members:
        return None
    mesh = open_run(path).surface.mesh
    apart = [np.abs(signed_error(mesh, open_run(one).surface.mesh)) for one in members]
    return sparsification(distance, np.mean(apart, axis=0))


def off_truth(path: Path) -> Floats:
    """Return the distance (V,), m, of a run's vertices from the true surface."""
    folder, run = Run(path), open_run(path)
    truth = true_mesh(run.settings, folder.provenance)
    assert truth is not None, f"{path}: no true surface"
    return np.abs(signed_error(run.surface.mesh, truth))


def sparsification(distance: Floats, error: Floats) -> float:
    """Return the area between two curves of the mean distance of the vertices that are left.

    One leaves out those with the largest error first, the other those with the largest distance;
    both are over the mean distance of all [1]_.

    References:
        .. [1] E. Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical
           flow", ECCV 2018.
    """
    left = np.arange(1, len(distance) + 1)
    by_error, by_distance = (
        np.cumsum(distance[np.argsort(key, kind="stable")]) / left for key in (error, distance)
    )
    return float((by_error - by_distance).mean() / distance.mean())


def calibrated(runs: list[Path]) -> str:
    """Return exponents and scale of the errors, by least squares over the runs' logarithms."""
    inputs, targets = [], []
    for path in runs:
        run = open_run(path)
        surface, optics = run.surface, Optics(run.echoes.head)
        known = surface_error(
            surface.mesh,
            run.echoes,
            optics,
            starts=starts_of(reconstruct(run.model, run.echoes)).values(),
            validation_db=surface.error_db,
            seed=0,
        )
        distance = off_truth(path) / optics.wavelength
        drawn = np.random.default_rng(0).choice(np.flatnonzero(known.heard), DRAWN)
        inputs.append(np.log(known.factors[drawn]))
        targets.append(np.log(distance[drawn] + LEAST))
    given, wanted = np.concatenate(inputs), np.concatenate(targets)
    ones = np.ones((len(given), 1))
    *found, _ = np.linalg.lstsq(np.concatenate([given, ones], axis=1), wanted, rcond=None)[0]
    scale = np.exp(np.quantile(wanted - given @ found, 0.9))
    exponents = ", ".join(f"{one:.3f}" for one in found)
    return f"EXPONENTS ({exponents})  SCALE {scale:.3f}  from {len(runs)} runs"
