# SPDX-License-Identifier: MIT
"""Compare a run with the true surface, with baselines, and with other runs."""

from __future__ import annotations

import csv as csv_format
import io
import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import trimesh

from sononerf import storage
from sononerf.display import aligned
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.memory_ensemble import TRAIN
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.evaluation.baseline import BASELINES, backprojection
from sononerf.evaluation.numbers import (
    Comparison,
    Evaluation,
    RegistrationKind,
    Truth,
    added_part,
    baseline_volume,
    check_truth,
    compare_prediction,
)
from sononerf.evaluation.numbers import compare as compare_volumes
from sononerf.evaluation.prediction import Prediction
from sononerf.field.fitting import render_poses
from sononerf.geometry.lattice import Volume, vti_bytes
from sononerf.geometry.poses import FrameName, Poses
from sononerf.head.front_end import compress
from sononerf.numerics import Floats
from sononerf.progress import Progress
from sononerf.report.mip_picture import difference_pngs, overlay_png
from sononerf.report.page import run_rows
from sononerf.run.build import (
    Unit,
    differing_keys,
    flat,
    locked,
    read_truth,
    results_folder,
    true_mesh,
    true_scene,
)
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run import Run


def evaluate(
    run: Path | Run,
    *,
    truth: Path | None = None,
    registration: RegistrationKind | None = None,
    unit: Unit | None = None,
    frame: FrameName | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare a reconstruction with the true surface, and the baselines likewise.

    The baselines are moved by the registration of the reconstruction.

    Args:
        run: A run that was reconstructed.
        truth: File of the true surface; ``evaluation.truth`` of the run's settings by default, or
            else the surface of its scene.
        registration, unit, frame: Its registration, unit and frame; those of the settings where
            None.
        progress: Display of progress.

    Returns:
        metrics: All of ``metrics.json``.

    Raises:
        InputError: If there is no run, or the true surface cannot be read.
    """
    progress = progress or Progress(quiet=True)
    run = Run.of(run)
    _ = run.model  # a folder that is no run is refused before it is locked
    with run.locked():
        if not (run.reconstruction / "mesh.ply").is_file():
            reconstruct(run, progress=progress)
        chosen = run.settings.evaluation
        file, kind = truth or chosen.truth, registration or chosen.registration
        scene = None if file else true_scene(run.settings)
        if file:
            to_world = run.frame(frame or chosen.frame).to_world
            true = to_world(read_truth(file, unit or chosen.unit))
            check_truth(run.mesh(), true, kind, str(file))
        elif scene is not None:
            true = scene.mesh
        else:
            run.write_metrics("geometry", None)
            run.write_metrics("baseline", dict.fromkeys(BASELINES))
            return run.read_metrics()
        laid, echoes = Truth(true, run.mesh(), kind), run.echoes
        lower, upper = (corner.double().numpy() for corner in run.model.field.region)

        def baseline(name: str) -> dict[str, Any] | None:
            return laid.of_volume(baseline_volume(name, echoes, lower, upper))

        with (
            progress.task("evaluating", 1 + len(BASELINES)) as task,
            ThreadPoolExecutor(len(BASELINES)) as pool,
        ):
            parts = {name: pool.submit(baseline, name) for name in BASELINES}
            geometry = {**laid.of_reconstruction(scene), "level": run.read_out["level"]}
            task.advance()
            baselines = {}
            for name, part in parts.items():
                baselines[name] = part.result()
                task.advance()
        run.write_metrics("geometry", geometry)
        run.write_metrics("baseline", baselines)
    return run.read_metrics()


def table(paths: Sequence[Path], *, csv: Path | None = None) -> list[str]:
    """Return the numbers of runs as lines: a row per number, a column per run."""
    runs = [Run(path) for path in paths]
    lines = []
    for run in runs:
        run.open()
        lines.append(run.read_metrics())
        try:
            run_rows(lines[-1:])
        except (TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"{run.metrics_file}: damaged ({error}); remove it and evaluate again"
            ) from None
    names = [run.path.resolve().name for run in runs]
    if len(set(names)) < len(names):
        names = [str(run.path) for run in runs]
    rows = [("", *names), *run_rows(lines)]
    if csv is not None:
        values = [flat(metrics) for metrics in lines]
        keys = sorted({key for one in values for key in one} - {"schema"})
        text = io.StringIO()
        writer = csv_format.writer(text, lineterminator="\n")
        writer.writerow(["run", *keys])
        for name, one in zip(names, values, strict=True):
            writer.writerow([name, *("" if one.get(key) is None else one[key] for key in keys)])
        with locked(runs, csv):
            storage.commit_text(csv, text.getvalue())
    return aligned(rows, "<" + ">" * len(runs))


logger = logging.getLogger("sononerf")

HEAD_SECTIONS_COMPARED = ("air", "ears", "call", "spectrogram")
"""Sections in which two runs must agree; otherwise the listeners differ, not the scenes."""
VOXELS = 80
"""Number of voxels along the longest side."""
SWAPPED_RATIO = 2.0
"""Excess of the second run over the first, relative to that of the first over the second, from
which the runs look swapped."""
MOST_POSES = 400


def compare_runs(
    first: Path,
    second: Path,
    *,
    output: Path | None = None,
    accelerator: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Compare the echoes of two fitted fields, place by place.

    Both are rendered for the same poses, those that either was trained on, and their levels (dB,
    0 is silence) are projected back to where they can have come from. In decibels a few loud
    flashes of a smooth face do not drown what answers more faintly in all directions. The places
    of the two fields themselves are not compared: two fits of one scene place the same sound some
    millimetres apart.
    """
    progress = progress or Progress(quiet=True)
    run = Run(first)
    other = Run(second)
    _ = run.model, other.model  # a folder that is no run is refused at once
    if first.resolve() == second.resolve():
        raise SettingsError(
            f"{first} and {second} are the same run; give as the second a run without what is "
            "looked for"
        )
    _check_alike(run, other)
    folder = output or first / f"compare-{second.resolve().name}"
    with run.locked(folder), results_folder(folder):
        comparison = compare_runs_of(run, other, accelerator=accelerator, progress=progress)
        surfaces = [true_mesh(each.settings, each.provenance) for each in (run, other)]
        truth = _added(*surfaces)
        names = first.resolve().name, second.resolve().name
        for name in ("first", "second", "difference"):
            storage.commit_bytes(
                folder / f"{name}.vti", vti_bytes(getattr(comparison, name), "level")
            )
        for axis, picture in difference_pngs(comparison, names, truth=truth).items():
            storage.commit_bytes(folder / f"mip_{axis}.png", picture)
        if surfaces[0] is not None:
            storage.commit_bytes(folder / "overlay.png", overlay_png(surfaces[0], comparison))
        place = comparison.strongest
        distance: float | None = None
        if place is not None and truth is not None:
            distance = float(np.linalg.norm(place - truth))
        storage.commit_json(
            folder / "comparison.json",
            {
                "first": names[0],
                "second": names[1],
                "poses": comparison.poses,
                "score": comparison.score,
                "strongest_m": None if place is None else place.tolist(),
                "added_m": None if truth is None else truth.tolist(),
                "distance_m": distance,
            },
        )
    return folder


def compare_runs_of(
    first: Run, second: Run, *, accelerator: str = "auto", progress: Progress | None = None
) -> Comparison:
    """Compare the echoes of two fitted fields; see :func:`compare_runs`, whose errors it raises."""
    progress = progress or Progress()
    runs = [first, second]
    _check_alike(first, second)
    corners = np.array([one.model.field.region.cpu().double().numpy() for one in runs])
    box = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    reference = max(one.model.reference for one in runs)
    poses = _common_poses(runs)
    one, other = (_heard(each, poses, reference, *box, accelerator, progress) for each in runs)
    comparison = compare_volumes(one, other)
    missing = -float(comparison.difference.values.min())
    if missing > SWAPPED_RATIO * comparison.score:
        logger.warning(
            "the second run has up to %.2f of the maximum that the first has not: the runs look "
            "swapped; pass the run with the target first",
            missing,
        )
    return replace(comparison, poses=len(poses))


def _check_alike(first: Run, second: Run) -> None:
    differing = [
        key
        for key in differing_keys(first.settings, second.settings)
        if key.split(".")[0] in HEAD_SECTIONS_COMPARED
    ]
    if differing:
        keys = ", ".join(differing)
        raise IncompatibleError(f"the two runs hear differently ({keys}); fit both alike")


def _common_poses(runs: list[Run]) -> Poses:
    """Return the poses that either run was trained on, each once, evenly thinned out."""
    table = []
    for run in runs:
        poses, split = run.all_poses()
        rows = np.concatenate([poses.positions, poses.rotations.reshape(-1, 9)], axis=1)
        table.append(rows[split == TRAIN])
    _, index = np.unique(np.concatenate(table).round(9), axis=0, return_index=True)
    rows = np.concatenate(table)[np.sort(index)]
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_POSES)).astype(int)]
    return Poses(rows[:, :3], rows[:, 3:].reshape(-1, 3, 3))


def _heard(
    run: Run,
    poses: Poses,
    reference: float,
    lower: Floats,
    upper: Floats,
    accelerator: str,
    progress: Progress,
) -> Volume:
    """Return the mean level that is heard from each place's range."""
    rendered = render_poses(run.model, poses, accelerator=accelerator, progress=progress)
    # Delay-and-sum adds squares; the square of this is the level.
    roots = (np.sqrt(compress(spectrogram, reference)) for spectrogram in rendered)
    return backprojection(
        roots, poses, run.head, lower, upper, float((upper - lower).max()) / VOXELS
    )


def _added(first: trimesh.Trimesh | None, second: trimesh.Trimesh | None) -> Floats | None:
    """Return the middle of the parts that only the first true surface has, (3,) m."""
    if first is None or second is None:
        return None
    added = added_part(first, second)
    if added is None:
        return None
    weights = added.area_faces
    return np.asarray(weights @ added.triangles_center / weights.sum(), dtype=np.float64)


@overload
def compare(first: Prediction, second: Echoes) -> Evaluation: ...


@overload
def compare(first: Run, second: Run) -> Comparison: ...


def compare(first: Prediction | Run, second: Echoes | Run) -> Evaluation | Comparison:
    """Compare a prediction with echoes, or two runs with each other.

    Args:
        first: A prediction of poses of the echoes; or a run with the target.
        second: The measured echoes; or a run without the target.

    Returns:
        found: For a prediction its errors, ``mae_db`` and others; of runs what the first sends back
            and the second does not.

    Raises:
        InputError: If a pose is not among those of the echoes, or the two do not go together.
        IncompatibleError: If two runs hear differently.
    """
    if isinstance(first, Prediction) and isinstance(second, Echoes):
        return compare_prediction(first, second)
    if isinstance(first, Run) and isinstance(second, Run):
        return compare_runs_of(first, second)
    raise InputError(
        f"found {type(first).__name__} and {type(second).__name__}, expected a Prediction and "
        "Echoes, or two runs"
    )
