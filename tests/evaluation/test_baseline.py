# SPDX-License-Identifier: MIT
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.evaluation.baseline import backprojection, best_level_surface
from sononerf.geometry.lattice import grid_over, volume_from_function
from sononerf.geometry.poses import Poses

EMITTER = np.array([0.0, 0.0, -0.01])
EARS = np.array([[-0.01, 0.01, 0.005], [-0.01, -0.01, 0.005]])
RANGES = np.linspace(0.2, 0.6, 200)
TARGET = np.array([0.01, -0.02, 0.015])
BOX = [-0.05] * 3, [0.05] * 3, 0.005


def poses(count=40, seed=0):
    generator = np.random.default_rng(seed)
    positions = generator.normal(size=(count, 3))
    positions *= 0.4 / np.linalg.norm(positions, axis=1, keepdims=True)
    rotations = np.linalg.qr(generator.normal(size=(count, 3, 3)))[0]
    return positions, rotations


def echoes(positions, rotations):
    """Half-way ranges of the echo of one point, by a slow loop, as narrow pulses."""
    for position, rotation in zip(positions, rotations, strict=True):
        out = np.linalg.norm(TARGET - (position + rotation @ EMITTER))
        spectrogram = np.zeros((2, len(RANGES), 3))
        for ear in range(2):
            back = np.linalg.norm(TARGET - (position + rotation @ EARS[ear]))
            pulse = np.exp(-(((RANGES - (out + back) / 2) / 0.003) ** 2))
            spectrogram[ear] = pulse[:, None] * [1.0, 2.0, 0.5]
        yield spectrogram


def listener(ranges=RANGES, ears=EARS):
    """What the baselines ask of a head."""

    def places(positions, rotations):
        return positions + rotations @ EMITTER, positions[:, None] + ears @ rotations.swapaxes(1, 2)

    return SimpleNamespace(range=np.asarray(ranges), places=places)


def run(spectrograms, positions, rotations, ranges=RANGES, ears=EARS):
    return backprojection(spectrograms, Poses(positions, rotations), listener(ranges, ears), *BOX)


def test_a_point_is_found_where_it_is_with_its_energy():
    positions, rotations = poses()
    volume = run(echoes(positions, rotations), positions, rotations)
    peak = volume.points()[volume.values.argmax()]
    np.testing.assert_allclose(peak, TARGET, atol=BOX[2] / 2 + 1e-9)
    # Both ears hear 1 + 4 + 1/4 there; linear interpolation on 2 mm flattens the pulse a little.
    assert volume.values.max() == pytest.approx(2 * 5.25, rel=0.15)


def test_one_ear_and_silence():
    positions, rotations = poses(3)
    volume = run(np.zeros((3, 1, 200, 4)), positions, rotations, ears=EARS[:1])
    assert (volume.values == 0).all()


def test_what_lies_beyond_the_recording_adds_nothing():
    positions, rotations = poses(3)
    beyond = np.linspace(2.0, 3.0, 50)
    volume = run(np.ones((3, 2, 50, 1)), positions, rotations, beyond)
    assert (volume.values == 0).all()


def test_wrong_input_is_refused():
    positions, rotations = poses(3)
    with pytest.raises(ValueError, match="one for each of 3 poses"):
        run(np.zeros((2, 2, 200, 1)), positions, rotations)
    with pytest.raises(ValueError, match="spectrogram 0"):
        run(np.zeros((3, 2, 199, 1)), positions, rotations)
    with pytest.raises(NumericalError, match="pose 0"):
        run(np.full((3, 2, 200, 1), np.nan), positions, rotations)


def test_the_best_level_is_that_of_the_true_surface():
    truth = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    volume = volume_from_function(lambda x: np.exp(-np.linalg.norm(x, axis=1) / 0.02), *BOX)
    mesh, level = best_level_surface(volume, truth)
    # Any level within 5 mm of the surface scores full marks.
    assert 0.025 < np.linalg.norm(mesh.vertices, axis=1).mean() < 0.035
    assert np.exp(-0.035 / 0.02) < level < np.exp(-0.025 / 0.02)


def test_a_constant_volume_has_no_best_level():
    with pytest.raises(NumericalError, match="no level"):
        best_level_surface(grid_over(*BOX), trimesh.creation.box())
