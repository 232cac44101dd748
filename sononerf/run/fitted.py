# SPDX-License-Identifier: MIT
"""A fitted field and its traced echoes read back from a run, and the echoes it was fitted to."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
import trimesh
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from sononerf import storage
from sononerf.checksums import require_recorded
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.free_space import EchoHull
from sononerf.errors import IncompatibleError, InputError, SettingsError
from sononerf.evaluation.traced import Traced
from sononerf.field.checkpoint_io import DESCRIPTION_NAME, load_weights, model_checksum
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.run.build import head_of, module_for, with_attached
from sononerf.run.simulate import default_store, open_ensemble
from sononerf.settings.loading import validate_settings
from sononerf.settings.schema import Settings
from sononerf.simulation.simulator import ensemble_poses


@dataclass(frozen=True)
class Fitted:
    """A fitted field as its run's two files describe it.

    Attributes:
        module: Field and renderer.
        hull: Free space in front of the onsets of the training poses.
        settings: Settings of the experiment.
        echo_hash: Echo hash of the echoes that were fitted to.
        folder: The run's.
    """

    module: EchoModule
    hull: EchoHull
    settings: Settings
    echo_hash: str
    folder: Path

    @property
    def head(self) -> Head:
        """Head that heard the echoes."""
        assert self.module.head is not None  # it was made with one
        return self.module.head


def load_fitted(path: Path) -> Fitted:
    """Read a fitted field from ``model.safetensors`` and ``model.json`` alone; runs no code.

    Raises:
        InputError: If they are missing or damaged.
        IncompatibleError: If they do not fit together or need a newer version.
    """
    if not (path / DESCRIPTION_NAME).is_file():
        raise InputError(
            f"{path}: no fitted run (no {DESCRIPTION_NAME}); make or finish one with `sononerf fit`"
        )
    state, description = load_weights(path)
    try:
        settings = validate_settings(description["settings"], str(path / "model.json"))
        reference = float(description["reference"])
        echoes = str(description["echo_hash"])
        region = state["field.region"]
        hull = _hull(state)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: incomplete ({error}); repeat the fit") from None
    except SettingsError as error:
        raise IncompatibleError(f"settings of another version: {error}") from None
    if not 0.0 < reference < math.inf:  # JSON as Python reads it knows NaN
        raise InputError(
            f"{path / DESCRIPTION_NAME}: reference is {reference}, expected a finite number above "
            "0; fetch the run again, or repeat the fit with --overwrite"
        )
    settings = with_attached(settings, path)
    head = head_of(settings)
    hull = replace(hull, plane=head.plane)
    module = module_for(settings, head, region, reference)
    for part, prefix in ((module.field, "field."), (module.renderer, "renderer.")):
        own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        try:
            part.load_state_dict(own)
        except RuntimeError as error:
            raise IncompatibleError(
                f"{path / 'model.safetensors'}: does not fit {settings.field.kind} and "
                f"{settings.renderer.kind} of this version: {str(error).splitlines()[-1].strip()}"
            ) from None
    module.eval()
    return Fitted(module, hull, settings, echoes, path)


def _hull(state: dict[str, torch.Tensor]) -> EchoHull:
    read: dict[str, Any] = {
        name: state[f"hull.{name}"].double().numpy() for name in EchoHull.ARRAYS
    }
    return EchoHull(**{**read, "within": float(read["within"])})


def echoes_of(fitted: Fitted) -> Echoes:
    """Open the echoes that a field was fitted to.

    Raises:
        InputError: If they are not where the settings say.
        IncompatibleError: If others lie there.
    """
    settings = fitted.settings
    stated = settings.data.store or default_store(settings, fitted.echo_hash)
    # The fit may have been started elsewhere: above its run the store lies as it did from there.
    places = [stated, *(folder / stated for folder in fitted.folder.absolute().parents)]
    path = next((place for place in places if (place / "zarr.json").is_file()), stated)
    if not path.exists():
        again = (
            "import the recordings again"
            if settings.scene is None
            else "make it again with `sononerf simulate RUN/config.yaml`"
        )
        raise InputError(
            f"{path}: the ensemble of this run is not there; {again}, or predict poses of your "
            "own with --poses"
        )
    store = open_ensemble(settings, path)
    if store.attributes.get("echo_hash") != fitted.echo_hash:
        raise IncompatibleError(f"{path}: holds other echoes than those of this run")
    return Echoes(store, fitted.head, fitted.hull)


def all_poses(fitted: Fitted) -> tuple[Poses, NDArray[np.int8]]:
    """Return the poses of a run's ensemble and the use of each (P,): 0 train, 1 val, 2 test."""
    if fitted.settings.scene is not None:
        return ensemble_poses(fitted.settings.poses)
    store = echoes_of(fitted).store
    return Poses(store.positions, store.rotations), store.split


NAME = "traced.safetensors"


def save_traced(path: Path, traced: Traced) -> None:
    """Write the traced surface of a run, with its gain and weight."""
    tensors = {
        "vertices": torch.as_tensor(np.array(traced.mesh.vertices, dtype=np.float64)),
        "faces": torch.as_tensor(np.array(traced.mesh.faces, dtype=np.int64)),
        "gain_db": torch.as_tensor(traced.gain_db),
        "weight": torch.as_tensor(traced.weight),
        # Not in the metadata: several entries are written in any order, and the file differs.
        "fault": torch.tensor(list(traced.fault.encode()), dtype=torch.uint8),
    }
    if traced.half_db is not None:
        tensors["half_db"] = torch.as_tensor(traced.half_db)
    data = safetensors.torch.save(tensors, metadata={"model": model_checksum(path)})
    storage.commit_bytes(path / NAME, data)


def load_traced(path: Path) -> Traced | None:
    """Read ``RUN/traced.safetensors``; None if there is none, or it belongs to another fit.

    Raises:
        InputError: If it is damaged.
    """
    file = path / NAME
    if not file.is_file():
        return None
    require_recorded(path, file, "remove it, and `sononerf fit` makes it again")
    try:
        with safe_open(str(file), "pt") as opened:
            found = {name: opened.get_tensor(name).numpy() for name in opened.keys()}
            model = (opened.metadata() or {}).get("model")
        if model != model_checksum(path):
            return None
        faces, vertices = found["faces"], found["vertices"]
        gain, weight = found["gain_db"], found["weight"]
        if not (np.isfinite(vertices).all() and np.isfinite(gain).all()):
            raise ValueError("numbers that are not finite")
        if not ((weight >= 0) & (weight <= 1)).all():
            raise ValueError("weights outside 0 to 1")
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
            raise ValueError("a triangle names a vertex that is not there")
        fault = found["fault"].tobytes().decode() if "fault" in found else ""  # older files
        half = found.get("half_db")
        if half is not None and not (np.isfinite(half) & (half >= 0)).all():
            raise ValueError("intervals that are negative or not finite")
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return Traced(mesh, gain, weight, fault, half)
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise InputError(
            f"{file}: damaged ({error}); remove it, and `sononerf fit` makes it again"
        ) from None
