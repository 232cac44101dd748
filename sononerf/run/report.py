# SPDX-License-Identifier: MIT
"""Page of a run: numbers, curves, surface, spectrograms, settings."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
import torch
import trimesh

from sononerf import storage
from sononerf.errors import InputError, NumericalError, SonoNerfError
from sononerf.evaluation.prediction import evenly, ranked
from sononerf.field.read_out import read_isosurface
from sononerf.head.front_end import compress, mae_db
from sononerf.numerics import Floats, Ints
from sononerf.progress import Progress
from sononerf.report.figure import curves_picture
from sononerf.report.mesh_picture import SurfaceViews, mesh_png
from sononerf.report.mip_picture import mip_pictures
from sononerf.report.page import NONE, Page, run_rows
from sononerf.report.scene_picture import scene_png
from sononerf.report.spectrogram_picture import spectrogram_picture
from sononerf.run.build import PROVENANCE_NAME, flat, true_mesh
from sononerf.run.export import read_volume
from sononerf.run.run import Run
from sononerf.settings.loading import dump_yaml
from sononerf.settings.schema import Settings
from sononerf.start.surface import confidence_of, error_of

PAGE = "report.html"


def report(
    path: Path,
    *,
    paper: bool = False,
    figures: Literal["svg", "pdf"] | None = None,
    output: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write one page of HTML with all its pictures inside.

    An interrupted fit has a page too, with its results so far.

    References:
        .. [1] Jansen & Steckel, Biomimetics 9(6):321, 2024, figures 4 to 8.
    """
    progress = progress or Progress(quiet=True)
    run = Run(path)
    settings = run.open()
    target = output or path / PAGE
    if target.suffix.lower() != ".html":
        raise InputError(f"{target}: expected a file whose name ends in .html")
    with run.locked(target):
        page = page_of(run, settings, paper, progress)
        drawn = {} if figures is None else _vector_figures(run, figures)
        storage.make_folder(target.parent)
        for name, data in drawn.items():
            storage.commit_bytes(target.parent / "figures" / f"{name}.{figures}", data)
        storage.commit_text(target, page.html())
    return target


def _vector_figures(run: Run, kind: Literal["svg", "pdf"]) -> dict[str, bytes]:
    """Return the figures of a run that are drawn by lines and letters, by name."""
    figures = {}
    curves, floors = curves_of(run)
    if curves:
        figures["curves"] = curves_picture(curves, floors=floors, kind=kind)
    if (run.reconstruction / "volume.vti").is_file():
        projections = mip_pictures(read_volume(run.path), kind=kind)
        figures |= {f"mip_{axis}": data for axis, data in projections.items()}
    predicted = read_predictions(run.path)
    if predicted is not None:
        for _, row in predicted.chosen():
            number = predicted.numbers[row]
            figures[f"pose_{number:04d}"] = spectrogram_picture(
                predicted.measured[row],
                predicted.predicted[row],
                predicted.range,
                predicted.frequency,
                f"pose {number}",
                kind=kind,
            )
    return figures


SIDES = (380, 340)
"""Width and height of the views of a surface, pixels: four fit into the page's width."""


@contextmanager
def damage_named(file: Path) -> Iterator[None]:
    """Name a JSON file that holds something else than numbers where these should be."""
    try:
        yield
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{file}: damaged ({error}); remove it and repeat the command that wrote it"
        ) from None


def page_of(run: Run, settings: Settings, paper: bool, progress: Progress) -> Page:
    """Return the page of a run; see :func:`report`."""
    page = Page(run.path.resolve().name)
    with damage_named(run.metrics_file):
        _made(page, run, settings)
        _numbers(page, run)
    _curves(page, run)
    if run.is_done("fit"):
        _surface(page, run, settings)
        if run.has_heldout:
            _predictions(page, run.path)
        if paper:
            _figures(page, run, progress)
    page.heading("Settings")
    page.code(dump_yaml(settings).rstrip())
    _provenance(page, run.path)
    return page


def _made(page: Page, run: Run, settings: Settings) -> None:
    cost = run.read_metrics().get("cost") or {}
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
    page.say(", ".join(said) + ".")
    if not run.is_done("fit"):
        page.say(
            f"The fit has not come to its end; `sononerf fit {shlex.quote(str(run.config))} "
            f"--output {shlex.quote(str(run.path))}` goes on."
        )


FLOOR_OF = {
    None: "the same echoes simulated with other rays",
    "repeated poses": "between poses that were recorded twice",
    "noise before the first echoes": "what noise as strong as that before the first echoes makes",
}


def _numbers(page: Page, run: Run) -> None:
    metrics = run.read_metrics()
    prediction, geometry = metrics.get("prediction") or {}, metrics.get("geometry") or {}
    page.heading("Numbers")
    if not run.is_done("fit"):
        page.say("None yet.")
        return
    page.table([("", "this run"), *run_rows([metrics])])
    if prediction:
        page.say(
            f"Held-out error: mean over {prediction.get('poses')} poses that were never trained "
            "on, in decibels above 60 dB below the loudest training echo. Active cells: measured "
            "or predicted is 3 dB or more, and above the noise of recordings. Field alone: without "
            "the echoes that are traced off the run's own mesh. Mean spectrogram: what the mean of "
            "the training poses predicts for every pose."
            + (
                ""
                if prediction.get("noise_floor_mae_db") is None
                else f" Noise floor: {FLOOR_OF[prediction.get('noise_floor_of')]}."
            )
        )
    elif run.has_heldout:
        page.say(f"No numbers of held-out poses yet: {_command('predict', run.path)}.")
    else:
        page.say("No pose was held out (`poses.heldout: 0`), so nothing is predicted.")
    if geometry:
        page.say("The baselines are given the best of several levels, chosen with the truth.")
    else:
        page.say(
            f"No geometry yet: {_command('evaluate', run.path)}; it needs the true mesh, and that "
            "the field has a surface."
        )


CURVES = {"all cells": "val/mae_db", "active cells": "val/mae_db_active"}
Curves = dict[str, tuple[list[float], list[float]]]


def curves_of(run: Run) -> tuple[Curves, dict[str, float]]:
    """Return the errors on validation poses, as the previews kept them, and the noise floors."""
    curves: Curves = {name: ([], []) for name in CURVES}
    for file in sorted(run.path.glob("epochs/*/metrics.json")):
        with damage_named(file):
            state = storage.read_json(file)
            for name, key in CURVES.items():
                if state.get(key) is not None and float(state[key]) > 0:
                    curves[name][0].append(float(state["step"]))
                    curves[name][1].append(float(state[key]))
    prediction = run.read_metrics().get("prediction") or {}
    floors = {
        f"noise floor, {name}": prediction.get(key)
        for name, key in zip(
            CURVES, ("noise_floor_mae_db", "noise_floor_mae_db_active"), strict=True
        )
    }
    return (
        {name: points for name, points in curves.items() if points[0]},
        {name: value for name, value in floors.items() if value},
    )


def _curves(page: Page, run: Run) -> None:
    curves, floors = curves_of(run)
    if curves:
        page.heading("Learning curves")
        picture = curves_picture(curves, floors=floors)
        page.pictures({"The field alone on validation poses.": picture})


def _surface(page: Page, run: Run, settings: Settings) -> None:
    page.heading("Surface")
    source, command = run.reconstruction, _command("reconstruct", run.path)
    if not run.is_done("surface"):
        page.say(f"None yet: {command}.")
        return
    mesh, frame = run.mesh(), run.frame()
    if not frame.is_world:
        low, high = (frame.mesh(mesh).bounds).round(1).tolist()
        page.say(
            f"mesh_original.ply is in the frame and unit of the recordings ({frame.unit_name}): "
            f"from {low} to {high}. All else is in the world frame: z up, metres."
        )
    views = SurfaceViews(
        mesh,
        confidence_of(mesh),
        error_of(mesh),
        _truth_beside(page, run, settings),
        run.head.resolution / 2,
    )
    page.view(views.meshes())
    page.pictures({"Four sides; colours are explained at the left.": views.png(SIDES)})
    page.heading("Maximum-intensity projections", 3)
    drawn = {}
    for axis in "xyz":
        file = source / f"mip_{axis}.png"
        if file.is_file():
            drawn[f"Reflectivity, the largest along {axis}."] = file.read_bytes()
        else:
            page.say(f"{file} is missing; {command} makes it.")
    page.pictures(drawn)


def _truth_beside(page: Page, run: Run, settings: Settings) -> trimesh.Trimesh | None:
    """Return the true surface in the frame of the reconstruction; None where it is not known."""
    try:
        true = true_mesh(settings, run.provenance)
    except SonoNerfError as error:
        page.say(f"The true surface is not shown: {error}.")
        return None
    with damage_named(run.metrics_file):
        geometry = run.read_metrics().get("geometry") or {}
        motion = (geometry.get("registration") or {}).get("matrix")
        if true is not None and motion is not None:
            true = true.copy()
            true.apply_transform(np.linalg.inv(np.asarray(motion, dtype=np.float64)))
    return true


@dataclass(frozen=True, eq=False)
class _Predicted:
    """Held-out poses as ``spectrograms.npz`` has them; levels (P, E, R, F) in dB."""

    measured: Floats
    predicted: Floats
    numbers: Ints
    range: Floats
    frequency: Floats

    def chosen(self) -> list[tuple[str, int]]:
        """Return the rows of the best, the median and the worst predicted pose."""
        rows = evenly(ranked(self.measured, self.predicted), 3)
        return list(zip(("best", "median", "worst"), rows.tolist(), strict=True))


def read_predictions(path: Path) -> _Predicted | None:
    """Return the prediction of a run for its held-out poses; None before it exists."""
    file = path / "prediction" / "spectrograms.npz"
    if not file.is_file():
        return None
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
            reference = float(arrays["reference"])
            return _Predicted(
                compress(arrays["measured"], reference),
                compress(arrays["predicted"], reference),
                arrays["pose"].astype(np.int64),
                arrays["range_m"],
                arrays["frequency_hz"],
            )
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise InputError(
            f"{file}: damaged ({error}); {_command('predict', path)} makes it anew"
        ) from None


def _predictions(page: Page, path: Path) -> None:
    """Show the best, the median and the worst predicted of the held-out poses."""
    page.heading("Spectrograms of poses that were never heard")
    predictions = read_predictions(path)
    if predictions is None:
        page.say(f"None yet: {_command('predict', path)}.")
        return
    for name, row in predictions.chosen():
        number = predictions.numbers[row]
        picture = path / "prediction" / f"pose_{number:04d}.png"
        count = len(predictions.numbers)
        error_db = mae_db(predictions.measured[row], predictions.predicted[row])
        said = f"Pose {number}, the {name} of {count}: {error_db:.2f} dB, all cells."
        if picture.is_file():
            page.pictures({said: picture.read_bytes()})
        else:
            page.say(f"{said} {picture} is missing; {_command('predict', path)} makes it.")


def _command(name: str, run: Path, rest: str = "") -> str:
    return f"`sononerf {name} {shlex.quote(str(run))}{rest}`"


def _provenance(page: Page, path: Path) -> None:
    file = path / PROVENANCE_NAME
    if file.is_file():
        page.heading("Made with")
        with damage_named(file):
            facts = flat(storage.read_json(file)).items()
            rows = [(name, str(value)) for name, value in facts if value is not None]
        page.table([("what", "value"), *rows])


def _figures(page: Page, run: Run, progress: Progress) -> None:
    page.heading("As in the paper")
    page.heading("Scene and poses (figures 4 to 6)", 3)
    mesh = true_mesh(run.settings, run.provenance)
    if mesh is None:
        page.say("The true surface is not known here: no scene or `evaluation.truth` can be read.")
    else:
        poses, split = run.all_poses()
        looks = poses.rotations[:, :, 0]
        page.pictures({"The scene.": scene_png(mesh, poses.positions, looks, split=split)})
    # Read before the long work, for they may be damaged.
    compared = list(_comparisons(run.path))
    page.heading("Iso-surface of the summed reflectivity (figures 4 to 6)", 3)
    _isosurface(page, run, progress)
    page.heading("What was heard here and not there (figures 7 and 8)", 3)
    if not compared:
        page.say(f"Not compared with another run yet: {_command('compare', run.path, ' OTHER')}.")
    for said, pictures in compared:
        page.say(said)
        page.pictures(pictures)


def _isosurface(page: Page, run: Run, progress: Progress) -> None:
    options = run.settings.reconstruction
    level = options.level
    try:
        with progress.task("reading out", 1000) as task, torch.inference_mode():
            mesh, volume, used_level = read_isosurface(
                run.model.field,
                spacing=options.spacing,
                level=level,
                directions=options.directions,
                smoothing=options.smoothing,
                progress=lambda done, total: task.advance(1000 * done // total - task.done),
            )
        picture = mesh_png(mesh)
    except NumericalError as error:
        page.say(f"None: {error}.")
        return
    rule = "by Otsu's rule" if level == "auto" else "as set"
    voxels = f"voxels of {1e3 * volume.spacing:.3g} mm"
    said = f"Sum over {options.directions} directions, {voxels}, level {rule}: {used_level:.3g}."
    page.pictures({said: picture})


def _comparisons(path: Path) -> Iterator[tuple[str, dict[str, bytes]]]:
    for file in sorted(path.glob("*/comparison.json")):
        with damage_named(file):
            comparison: dict[str, Any] = storage.read_json(file)
            away, score = comparison.get("distance_m"), comparison.get("score")
            said = (
                f"Beside `{comparison.get('second')}` the strongest difference is "
                + (NONE if score is None else f"{score:.2f}")
                + " of the common maximum"
                + (
                    ""
                    if away is None
                    else f", {1e3 * away:.1f} mm from the middle of what was added"
                )
            )
        names = {n: file.with_name(f"{n}.png") for n in ("mip_x", "mip_y", "mip_z", "overlay")}
        found = {n: picture.read_bytes() for n, picture in names.items() if picture.is_file()}
        yield f"{said}.", found
