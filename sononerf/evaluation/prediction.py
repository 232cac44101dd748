# SPDX-License-Identifier: MIT
"""Predicted spectrograms, and their error in decibels.

In: a fitted field, perhaps a surface, poses. Out: magnitudes (P, E, R, F), and the interval that
holds the measured level with a probability of 90 %. Echoes that the simulator traces off the
surface are mixed with the field's, by a weight that validation poses give. Section 6 of
``docs/method.md``.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.display import NotebookRepr
from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError, expect
from sononerf.evaluation.traced import Traced, covered, interval_db, learn_traced, mix, trace_poses
from sononerf.field.fitting import render_poses
from sononerf.field.module import EchoModule
from sononerf.geometry.poses import Poses
from sononerf.head.front_end import (
    ACTIVE_DB,
    RANGE_DB,
    compress,
    mae_all_and_active,
    mae_db,
    pose_chunks,
    same_shape,
)
from sononerf.numerics import Floats, Ints, Singles
from sononerf.progress import Progress
from sononerf.settings.loading import checked_section
from sononerf.settings.schema import SimulationSettings
from sononerf.start.surface import Surface

logger = logging.getLogger("sononerf")

SSIM_WINDOW = 11
"""Side of the window over which SSIM compares, cells; smaller spectrograms have no SSIM."""


@dataclass(frozen=True, eq=False)
class Prediction(NotebookRepr):
    """Predicted spectrograms of poses, (P, E, R, F) linear magnitude.

    Attributes:
        poses: P of them.
        magnitude ((P, E, R, F) float32): The mean of rendered and traced levels.
        rendered ((P, E, R, F) float32): The field's own rendering.
        range ((R,), m): Range of the slices.
        frequency ((F,), Hz): Frequencies of the bins.
        traced_weight: Mean weight of the traced echoes.
        traced_fault: Why no echoes are traced off the surface.
        reference: Magnitude m0 of the reported decibels.
        error_db ((P, E, R, F) float32, dB): Distance from the predicted level within which 90 % of
            the measured ones lie, over active cells; None where the surface's echoes have no weight
            that was learned on validation poses.
    """

    poses: Poses
    magnitude: Singles
    rendered: Singles
    range: Floats
    frequency: Floats
    traced_weight: float
    traced_fault: str | None
    reference: float
    error_db: Singles | None = None

    @property
    def level_db(self) -> Floats:
        """The predicted levels (P, E, R, F) in reported decibels; 0 is silence."""
        return compress(self.magnitude, self.reference)


def predict(
    model: EchoModule,
    surface: Surface | Traced | None,
    poses: Poses,
    *,
    options: SimulationSettings | Mapping[str, Any] | None = None,
    accelerator: str = "auto",
    progress: Progress | None = None,
) -> Prediction:
    """Predict the spectrograms of poses, heard or not.

    The field is rendered. With a surface, echoes are traced off it too, and both are averaged in
    decibels, with weights that the validation poses decide.

    Args:
        model: Fitted.
        surface: Reconstructed from echoes; one whose weights are known already; or None.
        poses: P of them.
        options: Options of the simulator that traces: keys of the section ``simulation`` of the
            settings; engine and number of rays are replaced.
        accelerator: Device to render on: ``auto``, ``cpu`` or ``gpu``.
        progress: Display of progress; on stderr by default.

    Raises:
        InputError: If the surface does not know its echoes, or a pose is too far from the region
            for anything to be heard.
        SettingsError: If an option is not allowed.
        ResourceError: If ``accelerator`` is ``gpu`` and there is none.
    """
    progress = progress or Progress()
    expect(model, EchoModule, "model")
    expect(poses, Poses, "poses")
    simulation = checked_section(SimulationSettings, options or {}, "simulation")
    how: dict[str, Any] = {"accelerator": accelerator, "progress": progress}
    renderer, reference = model.renderer, model.reference
    ranges, frequency = (
        part.cpu().double().numpy() for part in (renderer.range, renderer.frequency)
    )
    check_hearing(model, poses)
    lower, upper = _corners(model)
    within = np.flatnonzero(((poses.positions >= lower) & (poses.positions <= upper)).all(axis=1))
    if len(within):
        numbers = ", ".join(map(str, within[:10])) + (" ..." if len(within) > 10 else "")
        logger.warning("poses %s lie within the fitted region, where none was trained", numbers)
    traced = surface
    if isinstance(surface, Surface):
        traced = traced_of(model, surface, simulation, **how)
    rendered = render_poses(model, poses, **how)
    magnitude, weight, fault = rendered, 0.0, None
    if isinstance(traced, Traced):
        weight, fault = float(traced.weight.mean()), traced.fault or None
        if traced.weight.any():
            assert model.head is not None  # the surface was heard by one
            found = trace_poses(
                traced, model.head, poses, simulation, seed=model.options.seed, progress=progress
            )
            level = mix(compress(rendered, reference), compress(found, reference), traced.weight)
            magnitude = (reference * (10 ** (level / 20) - 1)).astype(np.float32)
    error = None
    if isinstance(traced, Traced) and traced.half_db is not None:
        level = compress(magnitude, reference)
        error = interval_db(level, traced.half_db).astype(np.float32)
    return Prediction(
        poses, magnitude, rendered, ranges, frequency, weight, fault, reference, error
    )


def check_hearing(model: EchoModule, poses: Poses) -> None:
    """Refuse poses that can hear nothing of the region."""
    lower, upper = _corners(model)
    ranges = model.renderer.range.cpu().double().numpy()
    below, above = lower - poses.positions, poses.positions - upper
    with np.errstate(over="ignore"):  # a distance that overflows is too far
        nearest = np.linalg.norm(np.maximum(np.maximum(below, above), 0), axis=1)
        farthest = np.linalg.norm(np.maximum(-below, -above), axis=1)
    deaf = np.flatnonzero((nearest > ranges[-1]) | (farthest < ranges[0]))
    if len(deaf):
        worst = deaf[0]
        where = f"{nearest[worst]:.3g} to {farthest[worst]:.3g} m"
        raise InputError(
            f"from pose {worst} (the first is 0) the fitted region lies {where} away, and what is "
            f"heard is {ranges[0]:.3g} to {ranges[-1]:.3g} m; positions are in metres"
        )


def _corners(model: EchoModule) -> tuple[Floats, Floats]:
    lower, upper = model.field.region.cpu().double().numpy()
    return lower, upper


TRACED: WeakKeyDictionary[Surface, WeakKeyDictionary[EchoModule, Traced]] = WeakKeyDictionary()
"""Surfaces with the weight of their echoes beside what a model renders, as long as both live."""


def traced_of(
    model: EchoModule, surface: Surface, options: SimulationSettings, **how: Any
) -> Traced:
    """Return a surface with the weight of its echoes; learned once for each model and surface."""
    of_surface = TRACED.setdefault(surface, WeakKeyDictionary())
    if model in of_surface:
        return of_surface[model]
    if surface.echoes is None:
        raise InputError(
            "the surface does not know the echoes that it was made from; take one from reconstruct "
            "or refine, Surface(mesh, echoes=...), or None"
        )
    seed = model.options.seed
    of_surface[model] = learn_traced(model, surface.echoes, surface.mesh, options, seed=seed, **how)
    return of_surface[model]


def prediction_numbers(
    prediction: Prediction, echoes: Echoes, measured: NDArray[np.floating]
) -> dict[str, Any]:
    """Compare a prediction with the measurement of its poses, (P, E, R, F) linear magnitude.

    The mean spectrogram of the training poses and the noise floor of the echoes stand beside.
    """
    store, reference = echoes.store, prediction.reference
    train = store.indices("train")
    mean = np.zeros(prediction.magnitude.shape[1:])
    for index in train:
        mean += compress(store.read_pose(int(index)), reference) / len(train)
    level, predicted, alone = (
        compress(part, reference) for part in (measured, prediction.magnitude, prediction.rendered)
    )
    floor = ("noise_floor_mae_db", "noise_floor_mae_db_active", "noise_floor_of")
    active_db = echoes.active_db
    return {
        "poses": len(level),
        **prediction_metrics(level, predicted, mean_db=mean, active_db=active_db),
        **{key: store.attributes.get(key) for key in floor},
        "rendered_mae_db": mae_db(level, alone),
        "rendered_mae_db_active": mae_db(level, alone, active=True, active_db=active_db),
        "interval_coverage": None
        if prediction.error_db is None
        else covered(level, predicted, prediction.error_db, active_db),
        "traced_weight": prediction.traced_weight,
        "traced_fault": prediction.traced_fault,
    }


def ranked(measured_db: ArrayLike, predicted_db: ArrayLike) -> Ints:
    """Return the order of poses (P,) from the best predicted to the worst, over all cells.

    In: measured_db, predicted_db ((P, E, R, F), dB).
    """
    measured, predicted = same_shape(measured_db, predicted_db)
    error_db = np.abs(predicted - measured).mean(axis=(1, 2, 3))
    return np.argsort(error_db, kind="stable")


def evenly(order: Ints, count: int) -> Ints:
    """Return ``count`` of an order (P,), evenly spaced from the first to the last."""
    places = np.linspace(0.0, len(order) - 1.0, count)
    return order[np.floor(places + 0.5).astype(np.int64)]


def prediction_metrics(
    measured_db: ArrayLike,
    predicted_db: ArrayLike,
    *,
    mean_db: ArrayLike,
    active_db: float | Floats = ACTIVE_DB,
) -> dict[str, float | None]:
    """Compare predicted spectrograms with measured ones.

    In: measured_db, predicted_db ((P, E, R, F), dB), mean_db ((E, R, F), dB), active_db (dB).
    """
    measured, predicted = same_shape(measured_db, predicted_db)
    mean = np.asarray(mean_db, dtype=np.float64)
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
