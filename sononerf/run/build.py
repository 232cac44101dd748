# SPDX-License-Identifier: MIT
"""Settings into objects: the store's settings, head, simulator, field, renderer, true surface."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from sononerf import storage
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import IncompatibleError, InputError, SettingsError, SonoNerfError
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.field import Field
from sononerf.field.module import EchoModule
from sononerf.field.renderer import Possible, Renderer
from sononerf.head.decibels import ACTIVE_DB
from sononerf.head.head import Head
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings import plugins
from sononerf.settings.loading import faults_of, validate_settings
from sononerf.settings.schema import FILE_SECTIONS, HEAD_SECTIONS, Settings
from sononerf.simulation.simulator import Simulator

OWN_KEYS = ("spectrogram.dynamic_range_db",)
"""Keys of these sections that an experiment may choose: they do not describe the echoes."""


def with_store(settings: Settings) -> Settings:
    """Complete the settings by what the store knows, if the echoes come from a store.

    Settings with a scene are left as they are.

    Args:
        settings: As the user gave them. A key that was not given takes the store's value.

    Returns:
        settings: With air, ears, call and analysis of the store.

    Raises:
        IncompatibleError: If the settings contradict the store.
        InputError: If there is no such store, or it does not say how it was recorded.
    """
    if settings.scene is not None or settings.data.store is None:
        return settings
    path = settings.data.store
    known = EnsembleStore.open(path).attributes.get("settings")
    if not isinstance(known, dict) or not all(
        isinstance(known.get(k), dict) for k in HEAD_SECTIONS
    ):
        raise InputError(
            f"{path}: does not state its head (settings of {', '.join(HEAD_SECTIONS)}); "
            "import the recordings again"
        )
    resolved = settings.plain()
    different = []
    for section in HEAD_SECTIONS:
        # The store's own values are checked like a file's; a newer key takes its default.
        given = getattr(settings, section)
        for key in given.model_fields_set:
            name = f"{section}.{key}"
            if name in OWN_KEYS:
                known[section][key] = resolved[section][key]
            elif key in known[section] and known[section][key] != resolved[section][key]:
                different.append(
                    f"{name}: found {resolved[section][key]}, the store has {known[section][key]}"
                )
        resolved[section] = known[section]
    if different:
        raise IncompatibleError(
            f"{path}: the settings contradict the store; leave these keys out: "
            + "; ".join(sorted(different))
        )
    return with_attached(validate_settings(resolved, settings.source or str(path)), path)


def complete_store(path: Path) -> EnsembleStore:
    """Open a store of which nothing is missing.

    Raises:
        InputError: If a pose is missing, or the store is not finished.
    """
    store = EnsembleStore.open(path)
    missing = store.missing()
    if missing or "reference" not in store.attributes:
        what = f"{len(missing)} poses are missing" if missing else "it is not finished"
        raise InputError(f"{path}: {what}; give the same simulate or import command again")
    return store


FOLDER = "attached"
"""Where the copies are, in the folder of a run or a store."""


def attach(settings: Settings, folder: Path) -> None:
    """Copy the files that settings name into a folder, if they are not there yet.

    Args:
        settings: Of the run or the store.
        folder: Of the run or the store.

    Raises:
        InputError: If a file cannot be read.
        StorageError: If a copy cannot be written.
    """
    for section in FILE_SECTIONS:
        file = getattr(settings, section).file
        if file is None or (copy := _copy_of(file, section, folder)).is_file():
            continue
        try:
            content = file.read_bytes()
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
        storage.make_folder(copy.parent)
        storage.commit_bytes(copy, content)


def with_attached(settings: Settings, folder: Path) -> Settings:
    """Return the settings with the paths of copies in a folder, where there are copies."""
    found = {}
    for section in FILE_SECTIONS:
        own = getattr(settings, section)
        if own.file is not None and (copy := _copy_of(own.file, section, folder)).is_file():
            found[section] = own.model_copy(update={"file": copy})
    return settings.model_copy(update=found) if found else settings


def _copy_of(file: Path, section: str, folder: Path) -> Path:
    return folder / FOLDER / f"{section}{file.suffix}"


def _tensor(values: NDArray[np.floating]) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def head_of(settings: Settings) -> Head:
    """Return the head that settings describe.

    Raises:
        InputError, SettingsError: As :class:`sononerf.head.head.Head`.
    """
    return Head(
        ears=settings.ears,
        call=settings.call,
        air=settings.air,
        analysis=settings.spectrogram,
        noise=settings.noise,
    )


def simulator_of(scene: Scene, settings: Settings) -> Simulator:
    """Return the simulator of a scene that settings describe; raises as :meth:`Simulator.of`."""
    return Simulator.of(scene, head_of(settings), settings.simulation)


def region_of(settings: Settings, echoes: Echoes) -> tuple[Tensor, Possible]:
    """Return the box that is fitted, from the settings or the echoes, and what is possible in it.

    Returns:
        region ((2, 3), m): Lower and upper corner.
        possible: Which places the echoes leave possible, given how far a place speaks for its
            surroundings.

    Raises:
        NumericalError: If no pose heard anything, or no more than noise gives.
    """
    found, wanted = echoes.region, settings.region
    if wanted.lower is not None and wanted.upper is not None:
        box = np.asarray((wanted.lower, wanted.upper))
    else:
        box = found.box()

    def possible(places: Tensor, tolerance: float) -> Tensor:
        left = found.possible(places.cpu().double().numpy(), tolerance)
        if not left.any():
            left[:] = True  # the user's own box is kept whole
        return torch.as_tensor(left, device=places.device)

    return _tensor(box), possible


def field_and_renderer(settings: Settings, head: Head, region: Tensor) -> tuple[Field, Renderer]:
    """Return an unfitted field and its renderer.

    Raises:
        SettingsError: If a kind or an option is not known, or options do not go together.
        InputError: If a plugin returns something else.
    """
    with faults_of(settings.source):
        make_field = plugins.load(plugins.FIELDS, settings.field.kind)
        field_options = plugins.check_options(
            make_field, settings.field.options, where="field.options", given=2
        )
        make_renderer = plugins.load(plugins.RENDERERS, settings.renderer.kind)
        renderer_options = plugins.check_options(
            make_renderer, settings.renderer.options, where="renderer.options", given=2
        )
        torch.manual_seed(settings.fit.seed)
        field = make_field(region, _tensor(head.frequency), **field_options)
        renderer = make_renderer(region, head, **renderer_options)
    for made, kind, name in (
        (field, Field, settings.field.kind),
        (renderer, Renderer, settings.renderer.kind),
    ):
        if not isinstance(made, kind):
            raise InputError(
                f"{name!r} makes a {type(made).__name__}, expected a sononerf {kind.__name__}"
            )
    return field, renderer


def check_plugins(settings: Settings, head: Head) -> None:
    """Refuse unknown kinds and options before anything expensive."""
    region = torch.tensor([[-0.05] * 3, [0.05] * 3])
    _, renderer = field_and_renderer(settings, head, region)
    if settings.fit.silent_share < 1.0 and renderer.whole_poses:
        with faults_of(settings.source):
            raise SettingsError(
                f"fit.silent_share: found {settings.fit.silent_share:g}, but renderer "
                f"{settings.renderer.kind!r} takes whole poses; lower fit.silent_weight instead, "
                "or take a renderer of single slices, such as shell"
            )


def data_for(settings: Settings, store: EnsembleStore, renderer: Renderer) -> EchoDataModule:
    """Return the LightningDataModule that streams an ensemble as a renderer wants it."""
    fit = settings.fit
    return EchoDataModule(
        store,
        whole_poses=renderer.whole_poses,
        batch=fit.batch_poses if renderer.whole_poses else fit.batch_slices,
        batch_frequencies=None if fit.batch_frequencies == "all" else fit.batch_frequencies,
        seed=fit.seed,
        workers=settings.data.workers,
        memory_bytes=settings.data.memory_bytes,
        silent_share=fit.silent_share,
        silent_below=float(store.attributes["reference"]) * (10 ** (ACTIVE_DB / 20) - 1),
    )


def module_for(
    settings: Settings,
    field: Field,
    renderer: Renderer,
    *,
    reference: float,
    possible: Possible | None = None,
    total_steps: int = 1,
    steps_per_epoch: int = 1,
) -> EchoModule:
    """Return the LightningModule around field and renderer."""
    fit = settings.fit
    return EchoModule(
        field,
        renderer,
        reference=reference,
        dynamic_range_db=settings.spectrogram.dynamic_range_db,
        early_range_db=fit.early_range_db,
        early_share=fit.early_share,
        possible=possible,
        learning_rate=fit.learning_rate or field.learning_rate,
        total_steps=total_steps,
        steps_per_epoch=steps_per_epoch,
        schedule=fit.schedule,
        final_rate_factor=fit.final_rate_factor,
        staircase_factor=fit.staircase_factor,
        staircase_epochs=fit.staircase_epochs,
        loss=fit.loss,
        silent_weight=fit.silent_weight,
        seed=fit.seed,
    )


logger = logging.getLogger("sononerf")

MOST_BYTES = 2_000_000_000
"""A larger file is refused before it is read."""
KINDS = (".ply", ".stl", ".obj", ".off", ".glb")


def true_scene(settings: Settings) -> Scene | None:
    """Return the scene of a run; None without one, and with a warning if it cannot be loaded."""
    if settings.scene is None:
        return None
    try:
        return load_scene(settings.scene.name, settings.scene.options)
    except SonoNerfError as error:
        logger.warning(
            "the true surface is unknown: %s; evaluation.truth=FILE names another file of it", error
        )
        return None


def true_mesh(settings: Settings) -> trimesh.Trimesh | None:
    """Return ``evaluation.truth``, or else the scene's own surface; None where neither is known.

    Raises:
        InputError: If the file of ``evaluation.truth`` is no mesh.
    """
    if settings.evaluation.truth is not None:
        return read_truth(settings.evaluation.truth)
    scene = true_scene(settings)
    return None if scene is None else scene.mesh


def read_truth(path: Path) -> trimesh.Trimesh:
    """Read a true surface from a file.

    Raises:
        InputError: If it is missing, of another kind, damaged, empty or not finite.
    """
    if path.suffix.lower() not in KINDS:
        raise InputError(f"{path}: evaluation.truth: expected one of {', '.join(KINDS)}")
    if not path.is_file():
        raise InputError(f"{path}: evaluation.truth: no such file")
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: evaluation.truth: larger than {MOST_BYTES} bytes")
    try:
        mesh = trimesh.load_mesh(path)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        good = isinstance(mesh, trimesh.Trimesh) and len(mesh.faces) > 0
        good = good and bool(np.isfinite(mesh.vertices).all())
    except Exception as error:  # trimesh's readers raise whatever they met first
        raise InputError(f"{path}: evaluation.truth: damaged ({error})") from error
    if not good:
        raise InputError(f"{path}: evaluation.truth: holds no surface of finite triangles")
    return mesh
