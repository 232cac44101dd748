# SPDX-License-Identifier: MIT
"""Predicted spectrograms, their error in decibels, and what two runs differ in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sononerf.array_types import Floats, Ints, Singles
from sononerf.echoes.echoes import Echoes
from sononerf.errors import NumericalError
from sononerf.evaluation.traced import Traced, mix, trace_poses
from sononerf.field.datamodule import WholePoses
from sononerf.field.fitting import FittedField, render_poses
from sononerf.head.decibels import (
    ACTIVE_DB,
    RANGE_DB,
    compress,
    mae_all_and_active,
    mae_db,
    pose_chunks,
    same_shape,
)
from sononerf.progress import Progress
from sononerf.settings.schema import SimulationSettings
from sononerf.surface.start.volume import Volume

SSIM_WINDOW = 11
"""Side of the window over which SSIM compares, cells; smaller spectrograms have no SSIM."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Spectrograms of poses, (P, E, R, F) linear magnitude.

    Attributes:
        magnitude ((P, E, R, F) float32): The mean of rendered and traced levels.
        rendered ((P, E, R, F) float32): The field's own rendering.
        traced_weight: Mean weight of the traced echoes.
        traced_fault: Why no echoes are traced off the surface.
        reference: Magnitude m0 of the reported decibels.
    """

    magnitude: Singles
    rendered: Singles
    traced_weight: float
    traced_fault: str | None
    reference: float

    def numbers(self, echoes: Echoes, measured: NDArray[np.floating]) -> dict[str, Any]:
        """Compare with what the same poses measured, (P, E, R, F) linear magnitude.

        The mean spectrogram of the training poses and the noise floor of the echoes stand beside.
        """
        store = echoes.store
        train = store.indices("train")
        mean = np.zeros(self.magnitude.shape[1:])
        for index in train:
            mean += compress(store.read_pose(int(index)), self.reference) / len(train)
        level, predicted, alone = (
            compress(part, self.reference) for part in (measured, self.magnitude, self.rendered)
        )
        floor = ("noise_floor_mae_db", "noise_floor_mae_db_active")
        return {
            "poses": len(level),
            **prediction_metrics(level, predicted, mean_db=mean),
            **{key: store.attributes.get(key) for key in floor},
            "rendered_mae_db": mae_db(level, alone),
            "rendered_mae_db_active": mae_db(level, alone, active=True),
            "traced_weight": self.traced_weight,
            "traced_fault": self.traced_fault,
        }


def predict(
    fitted: FittedField,
    traced: Traced | None,
    poses: WholePoses,
    simulation: SimulationSettings,
    *,
    seed: int,
    accelerator: str = "auto",
    progress: Progress,
) -> Prediction:
    """Predict the spectrograms of poses.

    Args:
        fitted: What is rendered.
        traced: Surface that echoes are traced off as well.
        poses: Where to hear.
        simulation: Of the surface's echoes; engine and number of rays are replaced.
        seed: Of the rays.
        accelerator: What to render on.
        progress: Where to show it.
    """
    rendered = render_poses(fitted, poses, accelerator=accelerator, progress=progress)
    reference, magnitude = fitted.module.reference, rendered
    if traced is not None and traced.weight.any():
        found = trace_poses(traced, fitted.head, poses, simulation, seed=seed, progress=progress)
        level = mix(compress(rendered, reference), compress(found, reference), traced.weight)
        magnitude = (reference * (10 ** (level / 20) - 1)).astype(np.float32)
    weight = 0.0 if traced is None else float(traced.weight.mean())
    fault = None if traced is None else traced.fault or None
    return Prediction(magnitude, rendered, weight, fault, reference)


def ranked(measured_db: ArrayLike, predicted_db: ArrayLike) -> Ints:
    """Return the order of poses (P,) from the best predicted to the worst, over all cells.

    Args:
        measured_db, predicted_db ((P, E, R, F), dB): 0 dB is silence.
    """
    measured, predicted = same_shape(measured_db, predicted_db)
    error_db = np.abs(predicted - measured).mean(axis=(1, 2, 3))
    order: Ints = np.argsort(error_db, kind="stable")
    return order


def evenly(order: Ints, count: int) -> Ints:
    """Return so many of an order (P,), evenly spaced from the first to the last."""
    places = np.linspace(0.0, len(order) - 1.0, count)
    chosen: Ints = order[np.floor(places + 0.5).astype(np.int64)]
    return chosen


def prediction_metrics(
    measured_db: ArrayLike,
    predicted_db: ArrayLike,
    *,
    mean_db: ArrayLike,
    active_db: float = ACTIVE_DB,
) -> dict[str, float | None]:
    """Compare predicted spectrograms with measured ones.

    Args:
        measured_db, predicted_db ((P, E, R, F), dB): 0 dB is silence; arrays mapped from a file are
            read a few poses at a time.
        mean_db ((E, R, F), dB): Mean spectrogram of the training poses: what knowing nothing of the
            pose predicts.
        active_db (dB): A cell is active where the measured or the judged spectrogram reaches this.

    Returns:
        metrics: ``mae_db``, ``mae_db_active``, ``mean_predictor_mae_db``,
            ``mean_predictor_mae_db_active``, ``log_spectral_distance_db`` (root mean square over
            frequency, mean over the rest), ``psnr_db`` and ``ssim`` (range 60 dB), ``pearson``.
            None where a figure does not exist: nothing active, a perfect match's PSNR, pictures too
            small for SSIM, no variation.

    Raises:
        ValueError: If the shapes do not fit.
        NumericalError: If a value is not finite.
    """
    measured, predicted = same_shape(measured_db, predicted_db)
    mean = np.asarray(mean_db, dtype=np.float64)
    if measured.ndim != 4:
        raise ValueError(f"measured has shape {measured.shape}, expected (P, E, R, F)")
    if mean.shape != measured.shape[1:]:
        raise ValueError(f"mean_db has shape {mean.shape}, expected {measured.shape[1:]}")
    error, active_error = mae_all_and_active(measured, predicted, active_db)
    expected = np.broadcast_to(mean, measured.shape)
    mean_error, mean_active_error = mae_all_and_active(measured, expected, active_db)
    return {
        "mae_db": error,
        "mae_db_active": active_error,
        "mean_predictor_mae_db": mean_error,
        "mean_predictor_mae_db_active": mean_active_error,
        "log_spectral_distance_db": _log_spectral_distance(measured, predicted),
        **_image_metrics(measured, predicted),
    }


def _log_spectral_distance(
    measured: NDArray[np.floating], predicted: NDArray[np.floating]
) -> float:
    total = sum(
        float(np.sqrt(((a - b) ** 2).mean(axis=-1)).sum())
        for a, b in pose_chunks(measured, predicted)
    )
    return total * measured.shape[-1] / measured.size


def _image_metrics(
    measured: NDArray[np.floating], predicted: NDArray[np.floating]
) -> dict[str, float | None]:
    import torch
    from torchmetrics.image import PeakSignalNoiseRatio, StructuralSimilarityIndexMeasure
    from torchmetrics.regression import PearsonCorrCoef

    psnr = PeakSignalNoiseRatio(data_range=RANGE_DB)
    ssim = StructuralSimilarityIndexMeasure(data_range=RANGE_DB)
    pearson = PearsonCorrCoef().set_dtype(torch.float64)
    large = min(measured.shape[2:]) >= SSIM_WINDOW
    perfect = True
    lowest, highest = np.full(2, np.inf), np.full(2, -np.inf)
    for a, b in pose_chunks(measured, predicted):
        one, two = torch.from_numpy(a), torch.from_numpy(b)
        psnr.update(two, one)
        if large:
            # One picture per ear: convolutions of one channel and single precision are fast.
            ssim.update(*(x.flatten(0, 1).unsqueeze(1).float() for x in (two, one)))
        pearson.update(two.flatten(), one.flatten())
        perfect &= bool((a == b).all())
        lowest = np.minimum(lowest, [a.min(), b.min()])
        highest = np.maximum(highest, [a.max(), b.max()])
    varies = bool((highest - lowest > 1e-6).all())
    return {
        "psnr_db": None if perfect else float(torch.as_tensor(psnr.compute())),
        "ssim": float(torch.as_tensor(ssim.compute())) if large else None,
        "pearson": float(torch.as_tensor(pearson.compute())) if varies else None,
    }


SAME = 1e-6
"""Triangles are the same where their corners' mean lies no farther apart, m."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two volumes over their common maximum, and what remains of one without the other.

    Attributes:
        first, second: 0 to 1, on one grid.
        difference: First without second.
        strongest ((3,) or None, m): Where the difference is greatest; None where it is nowhere
            above zero.
        score: How great it is at most: part of the common maximum.
    """

    first: Volume
    second: Volume
    difference: Volume
    strongest: Floats | None
    score: float


def compare(first: Volume, second: Volume) -> Comparison:
    """Compare two volumes, place by place.

    Args:
        first, second: What is heard from each place, on one grid.

    Raises:
        ValueError: If the grids differ.
        NumericalError: If both are silent.
    """
    alike = first.shape == second.shape and np.allclose(first.origin, second.origin)
    if not alike or first.spacing != second.spacing:
        raise ValueError("the two volumes have different grids")
    most = max(float(first.values.max()), float(second.values.max()))
    if not most > 0:
        raise NumericalError("nothing to compare: both are silent")
    one, other = (volume.with_values(volume.values / most) for volume in (first, second))
    difference = first.with_values(one.values - other.values)
    index = np.unravel_index(int(difference.values.argmax()), difference.shape)
    score = float(difference.values[index])
    # Where nothing is stronger the greatest value lies anywhere, often in a corner.
    strongest = difference.origin + difference.spacing * np.array(index) if score > 0 else None
    return Comparison(one, other, difference, strongest, score)


def added_part(mesh: trimesh.Trimesh, without: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """Return what a true surface has and another one has not; None where that is nothing.

    Args:
        mesh, without: Metres, one world frame; equal parts are equal triangle for triangle.
    """
    if not len(without.faces):
        return mesh
    distance, _ = cKDTree(without.triangles_center).query(mesh.triangles_center)
    added = np.flatnonzero(distance > SAME)
    return mesh.submesh([added], append=True) if len(added) else None
