# SPDX-License-Identifier: MIT
"""Fit a field to an ensemble, then reconstruct, predict and evaluate; go on where it stopped."""

from __future__ import annotations

import logging
import resource
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.fabric.utilities.rank_zero import rank_zero_only

from sononerf import storage
from sononerf.callbacks import (
    CheckpointCallback,
    PreviewCallback,
    ProgressCallback,
    RunLogger,
    SpectrogramImages,
    log_results,
)
from sononerf.echoes.echoes import SAME_POSE, Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import NumericalError, ResourceError, StoppedError
from sononerf.evaluation.traced import Traced, learn_traced
from sononerf.field.checkpoint_io import save_weights
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.fitting import StepCost, make_trainer, step_cost, usable_accelerator
from sononerf.field.fitting import fit as fit_field
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses, aim_fault
from sononerf.numerics import Floats
from sononerf.progress import Progress, duration
from sononerf.resources import gigabytes, require_memory
from sononerf.run.build import flat, module_for, stated_frame, with_store
from sononerf.run.evaluate import evaluate
from sononerf.run.predict import predict
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run import Run
from sononerf.run.simulate import (
    background_path,
    head_of,
    open_ensemble,
    open_or_simulate,
    store_path,
)
from sononerf.settings.loading import faults_of
from sononerf.settings.schema import Settings

LINE_WARNING = (
    "all training poses lie on a straight line: the echoes do not tell the angle around it, so the "
    "surface may be drawn out around the line; fly another way as well"
)
FAULTY_FRACTION = 0.5
"""Fraction of a table or a region above which a fault of it is reported, no unit. It is a half,
since a few repeated poses, or corners out of every pose's reach, do no harm."""
DEAF_FRACTION = 0.25
"""Fraction of the poses with an echo that may have none from the region, no unit. With a body 70 mm
outside the region, 3 of 8 poses had none; with a body inside it, all had one."""
MAX_POSE_SPACING = 8.0
"""Mean distance between neighbouring places on a sphere around the region that poses face, range
resolutions, above which poses are too few. The shipped experiments have 1 to 6. Between such places
no part of a convex body reflects sound straight back."""
GRID_SIDE = 8
"""Number of places along each side of the region whose distance from the poses is checked."""


SWEEP_ERROR = 1.0 / 7.0
"""Error of a surface divided by the length of a point's echo, no unit: 0.14 to 0.22 for three
spheres, and 0.10 to 0.15 for another body, under sweeps of 0.4 to 3 ms (``docs/calls.md``)."""


def fit_warnings(echoes: Echoes, region: Floats, *, is_set: bool) -> list[str]:
    """Return warnings about a fit, one line each. In: region ((2, 3), m)."""
    training = echoes.poses("train")
    warnings = [_repeated(training)]
    if echoes.hull.width < echoes.head.resolution:
        warnings.append(LINE_WARNING)
    if echoes.head.ears.is_directional and (fault := aim_fault(training, region.mean(axis=0))):
        warnings.append(f"training {fault}")
    warnings.append(_few(training, region, echoes.head.resolution))
    if is_set:
        warnings += [_out_of_reach(echoes, training, region), _elsewhere(echoes, region)]
    plane = echoes.head.plane
    if plane is not None and plane.height(region.mean(axis=0)) < 0.0:
        warnings.append(
            "the echoes come from below the support; check support.point and the heights of poses"
        )
    return [line for line in warnings if line]


def _repeated(poses: Poses) -> str:
    whole = np.column_stack([poses.positions, poses.rotations.reshape(-1, 9)])
    different = len(np.unique(np.round(whole / SAME_POSE), axis=0))
    if different > FAULTY_FRACTION * len(poses):
        return ""
    return f"only {different} of {len(poses)} training poses differ; check the table of poses"


def _few(poses: Poses, region: Floats, resolution: float) -> str:
    """Return a warning if the poses face places too far apart for the range resolution."""
    places = len(np.unique(np.round(poses.positions / SAME_POSE), axis=0))
    radius = float((region[1] - region[0]).mean()) / 2.0
    gap = radius * float(np.sqrt(4.0 * np.pi / max(places, 1)))
    if gap <= MAX_POSE_SPACING * resolution:
        return ""
    needed = int(np.ceil(places * (gap / (MAX_POSE_SPACING * resolution)) ** 2))
    return (
        f"{places} places of training poses are few for a region of {2e3 * radius:.0f} mm across "
        f"at a range resolution of {1e3 * resolution:.1f} mm: record from {needed} or more, or set "
        "a smaller region"
    )


def _out_of_reach(echoes: Echoes, poses: Poses, region: Floats) -> str:
    """Return a warning if the region holds poses, or places that no pose hears."""
    within = ((poses.positions > region[0]) & (poses.positions < region[1])).all(axis=1)
    if within.any():
        return (
            f"{within.sum()} training poses lie inside the region, where there is no body: it is "
            "larger than the scene can be; check region.lower and region.upper (m)"
        )
    axes = [np.linspace(low, high, GRID_SIDE) for low, high in region.T]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    some = poses.positions[np.linspace(0, len(poses) - 1, min(len(poses), 64)).astype(int)]
    away = np.linalg.norm(places[:, None] - some[None], axis=2)
    ranges = echoes.head.range
    deaf = ((away < ranges[0]) | (away > ranges[-1])).all(axis=1)
    if deaf.mean() <= FAULTY_FRACTION:
        return ""
    return (
        f"no training pose hears {100 * deaf.mean():.0f} % of the region within {ranges[0]:.3g} to "
        f"{ranges[-1]:.3g} m; check region.lower and region.upper (m)"
    )


def _elsewhere(echoes: Echoes, region: Floats) -> str:
    """Return a warning if poses hear an echo, and none from the region that was set."""
    free = Echoes(echoes.store, echoes.head)
    heard = np.isfinite(free.onsets.first).any(axis=1)
    hull = echoes.within(region).hull
    corners = np.stack(np.meshgrid(*region.T, indexing="ij"), axis=-1).reshape(-1, 3)
    out = np.linalg.norm(hull.emitters[:, None] - corners, axis=-1)[:, None]  # (P, 1, 8)
    back = np.linalg.norm(hull.receivers[:, :, None] - corners, axis=-1)  # (P, E, 8)
    farthest = ((out + back) / 2.0).max(axis=-1) + echoes.head.resolution
    # Sound before any echo from the region is no onset here; outliers have weight zero.
    from_region = (np.isfinite(hull.inlier_onsets) & (hull.inlier_onsets <= farthest)).any(axis=1)
    none = heard & ~from_region
    if none.sum() <= DEAF_FRACTION * heard.sum():
        return ""
    return (
        f"{none.sum()} of {heard.sum()} training poses hear echoes, and none from the region: the "
        "body lies elsewhere, or the places of poses are wrong; leave region.lower and "
        "region.upper out to find it"
    )


logger = logging.getLogger("sononerf")


def finish(
    run: Path | Run, *, accelerator: str = "auto", progress: Progress | None = None
) -> dict[str, Any]:
    """Reconstruct, find the weight of the surface's echoes, predict held-out poses, evaluate."""
    progress = progress or Progress(quiet=True)
    run = Run.of(run)
    shown: dict[str, Any] = {"accelerator": accelerator, "progress": progress}
    no_surface: NumericalError | None = None
    with run.locked():
        try:
            if not run.is_done("surface"):
                reconstruct(run, **shown)
            if not run.is_done("traced"):
                _learn_traced(run, accelerator, progress)
        except NumericalError as error:
            no_surface = error
        if not run.is_done("prediction"):
            predict(run, **shown)
        if no_surface is not None:
            raise no_surface
        if not run.is_done("evaluation"):
            evaluate(run, progress=progress)
            log_results(run.path, flat(run.settings.plain()), run.read_metrics())
    return run.read_metrics()


def _learn_traced(run: Run, accelerator: str, progress: Progress) -> None:
    settings, mesh = run.settings, run.mesh()
    run.begin("traced")
    if settings.prediction.traced == "off":
        traced = Traced.none(mesh, run.head)
    else:
        try:
            traced = learn_traced(
                run.model,
                run.echoes,
                mesh,
                settings.simulation,
                seed=settings.fit.seed,
                accelerator=accelerator,
                progress=progress,
            )
        except ResourceError as error:
            progress.say(
                f"no echoes are traced off the surface; the same command tries again: {error}"
            )
            return
    run.keep_traced(traced)


WAIT_SECONDS = 0.5
PATIENCE_SECONDS = 120.0
"""How long other processes wait for the first one to take the run's folder, s. Importing torch from
a slow network disk takes a minute."""


def follows() -> bool:
    """Return True if this process is one of several that fit together, and not the first."""
    return int(getattr(rank_zero_only, "rank", 0)) > 0


def _wait_for_store(settings: Settings, folder: Path) -> EnsembleStore:
    """Open the ensemble once the first process has sealed it."""
    path = store_path(settings, None, None)
    background = background_path(settings)
    last_held = time.monotonic()
    while not all(_is_sealed(part) for part in (path, background) if part is not None):
        if storage.is_held(folder):
            last_held = time.monotonic()
        if time.monotonic() - last_held > PATIENCE_SECONDS:
            raise ResourceError(
                f"{folder}: the first process of this fit does not run; its own output says why"
            )
        time.sleep(WAIT_SECONDS)
    return open_ensemble(settings, path)


def _is_sealed(path: Path) -> bool:
    if not (path / "zarr.json").is_file():
        return False
    return EnsembleStore.open(path).is_sealed


def fit(
    settings: Settings,
    path: Path,
    *,
    accelerator: str = "auto",
    devices: int | str = "auto",
    num_nodes: int = 1,
    precision: str = "32-true",
    strategy: str = "auto",
    overwrite: bool = False,
    workers: int | None = None,
    finishes: bool = False,
    progress: Progress | None = None,
) -> Run:
    """Simulate where needed, or open the store of ``data.store``; fit, and keep the fitted field.

    The same call resumes an interrupted one; a finished run is left as it is. If ``fit.epochs`` is
    larger than in the run, the fit continues from its last epoch.

    Args:
        settings: The experiment.
        path: The run's folder.
        accelerator: Device to fit on.
        devices: Number of devices.
        num_nodes: Number of machines.
        precision, strategy: As of Lightning's Trainer.
        overwrite: Move a folder that is there aside.
        workers: Processes that simulate.
        finishes: True also runs the stages after the fit, see :func:`sononerf.run.fit.finish`.
        progress: Display of progress.

    Returns:
        run: With ``model.safetensors`` and ``model.json``.

    Raises:
        SonoNerfError: Each kind as its name says; :class:`StoppedError` after a signal, with all
            saved.
    """
    progress = progress or Progress(quiet=True)
    run = Run(path)
    usable_accelerator(accelerator)
    settings = with_store(settings)
    head = head_of(settings)
    module_for(settings, head, None, 1.0)  # unknown names and options are refused at once
    hardware = {
        "accelerator": accelerator,
        "devices": devices,
        "num_nodes": num_nodes,
        "precision": precision,
        "strategy": strategy,
    }
    if not follows():  # what Lightning refuses is told before minutes of simulation
        make_trainer(**hardware, logger=False, enable_checkpointing=False)
    if follows():
        # The first process holds the lock, simulates and writes; the others only compute.
        echoes = Echoes(_wait_for_store(settings, path), head)
        quiet = Progress(quiet=True)
        _fit(settings, run, _prepared(settings, echoes, hardware, quiet), hardware, quiet)
        return run
    if overwrite:
        if path.is_symlink():
            progress.say(f"{path} is a link to {path.readlink()}; the run there is moved aside")
        aside = run.move_aside()
        if aside:
            progress.say(f"moved the old run to {aside}")
    if path.is_dir() and not run.config.is_file():
        run.refuse_foreign()  # before a lock is left there
    created = storage.probe_writable(path)
    try:
        with run.locked():
            run.prolong(settings)
            run.check(settings)
            if not run.is_done("fit"):
                started = time.monotonic()
                echoes = open_or_simulate(settings, workers=workers, progress=progress)
                simulated = time.monotonic() - started
                work = _prepared(settings, echoes, hardware, progress)
                run.begin_fit(settings)
                run.write_provenance(
                    echo_hash=echoes.store.attributes["echo_hash"],
                    **stated_frame(echoes.store.attributes),
                    threads=torch.get_num_threads(),
                )
                if "simulate_s" not in run.read_metrics().get("cost", {}):
                    run.write_metrics("cost", {"simulate_s": simulated}, merge=True)
                _fit(settings, run, work, hardware, progress)
            if finishes and run.is_finished:
                progress.say(f"{path}: is finished; --overwrite fits it anew")
            elif finishes:
                finish(run, accelerator=accelerator, progress=progress)
    finally:
        storage.remove_if_empty(created)  # folders with results stay
    return run


@dataclass(frozen=True)
class _Work:
    """Module, data and number of steps of a fit."""

    echoes: Echoes
    module: EchoModule
    data: EchoDataModule
    steps: int


def _prepared(
    settings: Settings, echoes: Echoes, hardware: dict[str, Any], progress: Progress
) -> _Work:
    """Make field and batches, log warnings, and refuse a fit that is too large."""
    lower, upper = settings.region.lower, settings.region.upper
    if lower is not None and upper is not None:
        echoes = echoes.within((lower, upper))
    with faults_of(settings.source):
        module = EchoModule.for_echoes(
            echoes,
            settings.field.kind,
            settings.renderer.kind,
            region=None if lower is None or upper is None else (lower, upper),
            field_options=settings.field.options,
            renderer_options=settings.renderer.options,
            options=settings.fit,
        )
    corners = (1000 * module.field.region).round().int().tolist()
    progress.say(f"region {corners[0]} to {corners[1]} mm")
    box = module.field.region.double().numpy()
    if echoes.head.call.kind != "impulse":
        long, short = (1e3 * one.resolution for one in (echoes.head, echoes.head.of_impulse()))
        progress.say(
            f"call: the echo of a point is {long:.0f} mm long in range; that of an impulse is "
            f"{short:.0f} mm long. Parts of a body that are nearer to one another merge, and the "
            f"surface will be wrong by about {SWEEP_ERROR * long:.0f} mm. Simulate an impulse; for "
            "recordings set import.compress=true"
        )
    for line in [] if follows() else fit_warnings(echoes, box, is_set=lower is not None):
        logger.warning("%s", line)
    data = EchoDataModule(
        echoes,
        settings.fit,
        whole_poses=module.renderer.whole_poses,
        workers=settings.data.workers,
        memory_bytes=settings.data.memory_bytes,
    )
    total = data.steps_per_epoch * settings.fit.epochs
    total = min(total, settings.fit.max_steps or total)
    if usable_accelerator(hardware["accelerator"]) == "cpu":
        _announce(step_cost(module, data), echoes, settings, total, progress)
    return _Work(echoes, module, data, total)


def _fit(
    settings: Settings, run: Run, work: _Work, hardware: dict[str, Any], progress: Progress
) -> None:
    echoes, module, data = work.echoes, work.module, work.data
    renderer = module.renderer
    keeper = CheckpointCallback(run.path, settings.fit.checkpoint_seconds)
    resumed = run.checkpoint.is_file()
    if not resumed and not follows():
        shutil.rmtree(run.path / "epochs", ignore_errors=True)  # previews of an older fit
    preview = PreviewCallback(
        run.path,
        every_epochs=settings.preview.every_epochs,
        voxels=settings.preview.voxels,
        directions=settings.reconstruction.directions,
    )
    with progress.task("fitting", work.steps) as task, keeper.watching():
        fit_field(
            echoes,
            module,
            data,
            callbacks=[
                ProgressCallback(task),
                preview,
                SpectrogramImages(data.whole("val"), renderer.range, renderer.frequency),
                keeper,
            ],
            logger=RunLogger(run.path),
            folder=run.path,
            checkpoint=run.checkpoint if resumed else None,
            **hardware,
        )
        if module.trainer.is_global_zero:
            _keep(settings, run, echoes, module, keeper.elapsed)
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        # What follows is for the first process alone; metrics would wait for the others.
        torch.distributed.destroy_process_group()
    if keeper.stopped_by is not None:
        raise StoppedError(
            keeper.stopped_by, "stopped after the last step; the same command goes on"
        )


def _announce(
    cost: StepCost, echoes: Echoes, settings: Settings, steps: int, progress: Progress
) -> None:
    """Show the cost of the fit, and refuse it if it needs more memory than there is."""
    store = echoes.store
    each = 4 * store.receivers * len(store.range) * len(store.frequency)
    kept = min(len(store) * each, settings.data.memory_bytes)
    batch = min(settings.fit.batch_poses, len(store))
    progress.say(
        f"fit: about {gigabytes(peak_memory_bytes() + cost.memory + kept)} of memory and "
        f"{duration(steps * cost.seconds)} for {steps} steps, without the surface"
    )
    require_memory(
        cost.memory + kept,
        f"a step of {batch} poses",
        "lower fit.batch_poses, the size of the field, or data.memory_bytes",
    )


def _keep(settings: Settings, run: Run, echoes: Echoes, module: EchoModule, seconds: float) -> None:
    """Write the fitted field and its cost."""
    hull = echoes.hull
    state = {f"field.{k}": v for k, v in module.field.state_dict().items()}
    state |= {f"renderer.{k}": v for k, v in module.renderer.state_dict().items()}
    state |= {f"hull.{name}": _double(getattr(hull, name)) for name in hull.ARRAYS}
    run.write_metrics(
        "cost",
        {
            "fit_s": seconds,
            "steps": module.trainer.global_step,
            "points_evaluated": int(module.renderer.points_evaluated),
            "parameters": sum(p.numel() for p in module.parameters()),
            "device": str(module.trainer.strategy.root_device.type),
            "peak_memory_bytes": peak_memory_bytes(),
        },
        merge=True,
    )
    save_weights(
        run.path,
        state,
        {
            "settings": settings.plain(),
            "reference": echoes.reference,
            "echo_hash": echoes.store.attributes["echo_hash"],
        },
    )


def _double(values: object) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values, dtype=np.float64))


def peak_memory_bytes() -> int:
    """Return the greatest resident memory of this process so far."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else peak * 1024)
