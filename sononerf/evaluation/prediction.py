# SPDX-License-Identifier: MIT
"""How close predicted spectrograms are to measured ones, in decibels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.head.decibels import (
    ACTIVE_DB,
    RANGE_DB,
    mae_all_and_active,
    pose_chunks,
    same_shape,
)

SSIM_WINDOW = 11
"""Side of the window over which SSIM compares, cells; smaller spectrograms have no SSIM."""


def prediction_metrics(
    measured_db: ArrayLike,
    predicted_db: ArrayLike,
    *,
    mean_db: ArrayLike,
    active_db: float = ACTIVE_DB,
) -> dict[str, float | None]:
    """Compare predicted spectrograms with measured ones.

    Parameters
    ----------
    measured_db, predicted_db : (P, E, R, F) float, dB
        0 dB is silence; arrays mapped from a file are read a few poses at a time.
    mean_db : (E, R, F) float, dB
        Mean spectrogram of the training poses: what knowing nothing of the pose predicts.
    active_db : float, dB
        A cell is active where the measured or the judged spectrogram reaches this.

    Returns
    -------
    metrics : dict
        ``mae_db``, ``mae_db_active``, ``mean_predictor_mae_db``, ``mean_predictor_mae_db_active``,
        ``log_spectral_distance_db`` (root mean square over frequency, mean over the rest),
        ``psnr_db`` and ``ssim`` (range 60 dB), ``pearson``. None where a figure does not exist:
        nothing active, a perfect match's PSNR, pictures too small for SSIM, no variation.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    NumericalError
        If a value is not finite.
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
