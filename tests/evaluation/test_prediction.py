# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import NumericalError
from sononerf.evaluation.prediction import prediction_metrics
from sononerf.head.front_end import mae_db


@pytest.fixture(scope="module")
def measured():
    return np.random.default_rng(0).uniform(0, 40, (5, 2, 20, 12))


def test_a_constant_error_is_read_back(measured):
    found = prediction_metrics(measured, measured + 2, mean_db=measured.mean(axis=0))
    assert found["mae_db"] == pytest.approx(2)
    assert found["mae_db_active"] == pytest.approx(2)
    assert found["log_spectral_distance_db"] == pytest.approx(2)
    assert found["psnr_db"] == pytest.approx(20 * np.log10(60 / 2), rel=1e-5)
    assert found["pearson"] == pytest.approx(1)
    assert 0.9 < found["ssim"] < 1
    assert found["mean_predictor_mae_db"] == pytest.approx(
        np.abs(measured - measured.mean(axis=0)).mean()
    )


def test_log_spectral_distance_is_a_root_mean_square_over_frequency():
    measured = np.zeros((1, 1, 2, 4))
    predicted = measured.copy()
    predicted[0, 0, 0, 0] = 6.0
    # One slice of two has the error 6 in one of four cells: sqrt(36 / 4) = 3, mean 1.5.
    found = prediction_metrics(measured, predicted, mean_db=measured[0])
    assert found["log_spectral_distance_db"] == pytest.approx(1.5)
    assert found["mae_db"] == pytest.approx(6 / 8)


def test_a_cell_is_active_where_either_reaches_three_decibels():
    measured = np.array([0.0, 3.0, 0.0, 2.9]).reshape(1, 4)
    predicted = np.array([0.0, 0.0, 5.0, 0.0]).reshape(1, 4)
    assert mae_db(measured, predicted, active=True) == pytest.approx(4)
    assert mae_db(measured, predicted) == pytest.approx(10.9 / 4)
    assert mae_db(measured * 0, predicted * 0, active=True) is None


def test_the_mean_predictor_is_judged_on_its_own_prediction():
    measured, predicted = np.zeros((2, 1, 3, 4)), np.zeros((2, 1, 3, 4))
    mean = np.zeros((1, 3, 4))
    mean[0, 0, 0] = 10.0
    found = prediction_metrics(measured, predicted, mean_db=mean)
    assert found["mae_db_active"] is None
    assert found["mean_predictor_mae_db_active"] == pytest.approx(10)


def test_what_does_not_exist_is_none(measured):
    found = prediction_metrics(measured, measured, mean_db=measured.mean(axis=0))
    assert found["psnr_db"] is None
    assert found["ssim"] == pytest.approx(1)
    silent = np.zeros((2, 2, 5, 5))
    found = prediction_metrics(silent, silent, mean_db=silent[0])
    assert found["pearson"] is found["ssim"] is found["mae_db_active"] is None
    assert found["mae_db"] == 0


def test_wrong_input_is_refused(measured):
    with pytest.raises(ValueError, match="differ in shape"):
        mae_db(measured, measured[1:])
    with pytest.raises(ValueError, match="nothing to compare"):
        mae_db(measured[:0], measured[:0])
    broken = measured.copy()
    broken[3, 0, 0, 0] = np.nan
    with pytest.raises(NumericalError, match="predicted spectrogram 3"):
        mae_db(measured, broken)
