# SPDX-License-Identifier: MIT
"""One page of a run: its numbers beside those of the baselines, its pictures, its settings."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch

from sononerf import storage
from sononerf.errors import InputError, NumericalError
from sononerf.evaluation.prediction import evenly, ranked
from sononerf.head.decibels import compress, mae_db
from sononerf.progress import Progress
from sononerf.report.pictures.mesh_picture import mesh_png
from sononerf.report.pictures.scene_picture import scene_png
from sononerf.run.build import results_folder, true_mesh
from sononerf.run.fitted import Fitted, all_poses
from sononerf.run.run_folder import RunFolder
from sononerf.settings.loading import dump_yaml
from sononerf.surface.start.read_out import read_isosurface

PAGE = "report.md"
Table = list[tuple[str, ...]]


def report(
    path: Path,
    *,
    paper: bool = False,
    output: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write one page of Markdown with its pictures beside it; it can be moved as it is.

    Args:
        path: A fitted run.
        paper: Whether the counterparts of the paper's figures 4 to 8 are drawn too: the scene with
            its poses, an iso-surface of the summed reflectivity, and, where the run was compared
            with others, what was heard in it and not in them.
        output: Folder of the page; ``RUN/report`` where None.
        progress: Where to show it.

    Returns:
        page: ``report.md``. What the run has not come to yet is named with the command that makes
            it.

    Raises:
        InputError: If it is no fitted run, or one of its files is damaged.

    References:
        .. [1] Jansen & Steckel, Biomimetics 9(6):321, 2024, figures 4 to 8.
    """
    progress = progress or Progress(quiet=True)
    run = RunFolder(path)
    fitted = run.fitted
    folder = output or path / "report"
    heldout = run.has_heldout
    pictures: dict[str, bytes] = {}
    with run.locked(folder), results_folder(folder):
        parts = [f"# {path.resolve().name}"]
        with _damage_named(run.metrics):
            parts += [_made(path, fitted), *_numbers(path, heldout)]
        if heldout:
            parts += _predictions(path, pictures)
        parts += _surface(path, pictures)
        if paper:
            parts += _figures(path, pictures, fitted, progress)
        parts += ["## Settings", f"```yaml\n{dump_yaml(fitted.settings).rstrip()}\n```"]
        # Nothing is written before all is known, and the page after what it shows.
        for name, data in pictures.items():
            storage.commit_bytes(folder / name, data)
        storage.commit_text(folder / PAGE, "\n\n".join(parts) + "\n")
    return folder / PAGE


@contextmanager
def _damage_named(file: Path) -> Iterator[None]:
    """Name a JSON file that holds something else than numbers where these should be."""
    try:
        yield
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{file}: damaged ({error}); remove it and repeat the command that wrote it"
        ) from None


def _made(path: Path, fitted: Fitted) -> str:
    metrics = RunFolder(path).read_metrics()
    cost = metrics.get("cost") or {}
    settings = fitted.settings
    echoes = (
        f"Recorded echoes of `{settings.data.store}`"
        if settings.scene is None
        else f"Scene `{settings.scene.name}`, {settings.poses.count} poses for training"
    )
    said = [f"{echoes}; field `{settings.field.kind}` through renderer `{settings.renderer.kind}`"]
    if cost.get("steps") is not None:
        said.append(f"{cost['steps']} steps")
    if cost.get("fit_s") is not None:
        said.append(f"{cost['fit_s']:.0f} s of fit on {cost.get('device', 'an unknown device')}")
    if cost.get("peak_memory_bytes") is not None:
        said.append(f"{cost['peak_memory_bytes'] / 1e9:.1f} GB of memory at most")
    if cost.get("parameters") is not None:
        said.append(f"{cost['parameters']} parameters")
    return ", ".join(said) + "."


PREDICTED = (
    ("all cells", "mae_db", "mean_predictor_mae_db", "noise_floor_mae_db", "rendered_mae_db"),
    (
        "active cells",
        "mae_db_active",
        "mean_predictor_mae_db_active",
        "noise_floor_mae_db_active",
        "rendered_mae_db_active",
    ),
)
SHAPE = (
    ("Chamfer distance, mm", "chamfer_m", 1e3, ".2f"),
    ("thickness bias, mm", "thickness_bias_m", 1e3, "+.2f"),
    ("volume over true volume", "volume_ratio", 1.0, ".2f"),
    ("intersection over union", "iou", 1.0, ".2f"),
    ("normal consistency", "normal_consistency", 1.0, ".2f"),
    ("parts", "components", 1.0, ".0f"),
)


def _numbers(path: Path, heldout: bool) -> Iterator[str]:
    metrics = RunFolder(path).read_metrics()
    prediction, geometry = metrics.get("prediction") or {}, metrics.get("geometry") or {}
    yield "## Numbers"
    if prediction:
        heads = ("held-out error, dB", "this run", "mean spectrogram", "noise floor", "field alone")
        yield _table(
            [
                heads,
                *((name, *(_shown(prediction.get(k)) for k in keys)) for name, *keys in PREDICTED),
            ]
        )
        yield (
            f"Mean over {prediction.get('poses')} poses that were never trained on, in decibels "
            "above 60 dB below the loudest training echo. Active cells: measured or predicted is "
            "3 dB or more. Noise floor: the same echoes simulated with other rays. Field alone: "
            "without the calls that are traced off the run's own mesh."
        )
    elif heldout:
        yield f"No numbers of held-out poses yet: {_command('predict', path)}."
    else:
        yield "No pose was held out (`poses.heldout: 0`), so nothing is predicted."
    if not geometry:
        yield (
            f"No geometry yet: {_command('evaluate', path)}; it needs the true mesh, and that the "
            "field has a surface."
        )
        return
    baseline = metrics.get("baseline") or {}
    columns = [geometry, baseline.get("backprojection") or {}, baseline.get("voxels") or {}]
    rows: Table = [("geometry", "this run", "backprojection", "voxel fit")]
    for limit in geometry.get("fscore", {}):
        scores = [(column.get("fscore") or {}).get(limit) for column in columns]
        rows.append((f"F-score at {1e3 * float(limit):g} mm", *(_shown(s) for s in scores)))
    for name, key, scale, form in SHAPE:
        rows.append((name, *(_shown(column.get(key), scale, form) for column in columns)))
    yield _table(rows)
    target = (geometry.get("target") or {}).get("fscore") or {}
    if target:
        alone = (f"{_shown(s)} at {1e3 * float(limit):g} mm" for limit, s in target.items())
        yield f"F-score of the target alone, without its background: {', '.join(alone)}."
    yield (
        f"In truth there are {geometry.get('components_true')} parts. The baselines are given the "
        "best of several levels, chosen with the truth."
    )


def _table(rows: Sequence[tuple[str, ...]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def _shown(value: float | None, scale: float = 1.0, form: str = ".2f") -> str:
    return "-" if value is None else f"{scale * value:{form}}"


def _predictions(path: Path, pictures: dict[str, bytes]) -> Iterator[str]:
    """Show the best, the median and the worst predicted of the held-out poses."""
    yield "## Spectrograms of poses that were never heard"
    file = path / "prediction" / "spectrograms.npz"
    if not file.is_file():
        yield f"None yet: {_command('predict', path)}."
        return
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
            reference = float(arrays["reference"])
            measured, predicted = (
                compress(arrays[k], reference) for k in ("measured", "predicted")
            )
            numbers = arrays["pose"].astype(int)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise InputError(
            f"{file}: damaged ({error}); {_command('predict', path)} makes it anew"
        ) from None
    chosen = evenly(ranked(measured, predicted), 3)
    for name, row in zip(("best", "median", "worst"), chosen, strict=True):
        picture = f"pose_{numbers[row]:04d}.png"
        error_db = mae_db(measured[row], predicted[row])
        yield f"Pose {numbers[row]}, the {name} of {len(numbers)}: {error_db:.2f} dB, all cells."
        yield _picture(path / "prediction" / picture, pictures, _command("predict", path))


def _command(name: str, run: Path, rest: str = "") -> str:
    return f"`sononerf {name} {shlex.quote(str(run))}{rest}`"


def _picture(
    source: Path, pictures: dict[str, bytes], command: str, name: str | None = None
) -> str:
    """Put a picture beside the page, and return how it is shown there."""
    name = name or source.name
    if not source.is_file():
        return f"{source} is missing; {command} makes it."
    pictures[name] = source.read_bytes()
    return f"![{Path(name).stem}]({name})"


def _surface(path: Path, pictures: dict[str, bytes]) -> Iterator[str]:
    yield "## Surface and projections"
    source, command = path / "reconstruction", _command("reconstruct", path)
    if not source.is_dir():
        yield f"None yet: {command}."
        return
    yield _picture(source / "view.png", pictures, command)
    for axis in "xyz":
        yield f"Reflectivity, the largest along {axis}:"
        yield _picture(source / f"mip_{axis}.png", pictures, command)


def _figures(
    path: Path, pictures: dict[str, bytes], fitted: Fitted, progress: Progress
) -> Iterator[str]:
    yield "## As in the paper"
    yield "### Scene and poses (figures 4 to 6)"
    mesh = true_mesh(fitted.settings)
    if mesh is None:
        yield "The true surface is not known here: no scene or `evaluation.truth` can be read."
    else:
        poses, split = all_poses(fitted)
        looks = poses.rotations[:, :, 0]
        pictures["scene.png"] = scene_png(mesh, poses.positions, looks, split=split)
        yield "![scene](scene.png)"
    # Read before the long work, for they may be damaged.
    compared = list(_comparisons(path, pictures))
    yield "### Iso-surface of the summed reflectivity (figures 4 to 6)"
    yield from _isosurface(fitted, pictures, progress)
    yield "### What was heard here and not there (figures 7 and 8)"
    yield from compared or [
        f"Not compared with another run yet: {_command('compare', path, ' OTHER')}."
    ]


def _isosurface(fitted: Fitted, pictures: dict[str, bytes], progress: Progress) -> Iterator[str]:
    options = fitted.settings.reconstruction
    level = options.level
    try:
        with progress.task("reading out", 1000) as task, torch.inference_mode():
            mesh, volume, found = read_isosurface(
                fitted.module.field,
                spacing=options.spacing,
                level=level,
                directions=options.directions,
                smoothing=options.smoothing,
                progress=lambda done, total: task.advance(1000 * done // total - task.done),
            )
        pictures["isosurface.png"] = mesh_png(mesh)
    except NumericalError as error:
        yield f"None: {error}."
        return
    yield (
        f"Sum over {options.directions} directions, voxels of "
        f"{1e3 * volume.spacing:.3g} mm, level "
        + ("by Otsu's rule" if level == "auto" else "as set")
        + f": {found:.3g}."
    )
    yield "![isosurface](isosurface.png)"


def _comparisons(path: Path, pictures: dict[str, bytes]) -> Iterator[str]:
    for file in sorted(path.glob("*/comparison.json")):
        with _damage_named(file):
            told: dict[str, Any] = storage.read_json(file)
            away = told.get("distance_m")
            said = (
                f"Beside `{told.get('second')}` the strongest difference is "
                f"{_shown(told.get('score'))} of the common maximum"
                + (
                    ""
                    if away is None
                    else f", {1e3 * away:.1f} mm from the middle of what was added"
                )
            )
        yield f"{said}."
        for name in ("mip_x", "mip_y", "mip_z", "overlay"):
            picture = file.with_name(f"{name}.png")
            if picture.is_file():  # without a true surface there is no overlay
                yield _picture(picture, pictures, "", f"{file.parent.name}-{name}.png")
