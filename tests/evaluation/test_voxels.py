# SPDX-License-Identifier: MIT
from types import SimpleNamespace

import numpy as np
import pytest

from sononerf.errors import NumericalError
from sononerf.evaluation.baseline import voxel_fit
from sononerf.geometry.poses import Poses

EMITTER = np.array([0.0, 0.0, -0.01])
EARS = np.array([[-0.01, 0.01, 0.005], [-0.01, -0.01, 0.005]])
RANGES = np.linspace(0.2, 0.6, 400)
BOX = [-0.05] * 3, [0.05] * 3, 0.005
# Voxels of that box, far enough apart to be told from one another, and their powers.
SCENE = {(0.01, -0.02, 0.015): 2.0, (-0.03, 0.03, -0.02): 0.5, (0.035, 0.03, 0.0): 1.0}
WIDTH = 0.004
WINDOW_STEP = 0.0002
WINDOW = np.exp(-((WINDOW_STEP * np.arange(-60, 61) / WIDTH) ** 2))


def poses(count=60, seed=0):
    generator = np.random.default_rng(seed)
    positions = generator.normal(size=(count, 3))
    # Near and far, so that spreading tells.
    positions *= generator.uniform(0.3, 0.5, (count, 1)) / np.linalg.norm(
        positions, axis=1, keepdims=True
    )
    return positions, np.linalg.qr(generator.normal(size=(count, 3, 3)))[0]


def echoes(positions, rotations):
    """Energies of the scene's echoes by a slow loop, as magnitudes of three frequencies."""
    for position, rotation in zip(positions, rotations, strict=True):
        energy = np.zeros((2, len(RANGES)))
        for place, power in SCENE.items():
            out = np.linalg.norm(place - (position + rotation @ EMITTER))
            for ear in range(2):
                back = np.linalg.norm(place - (position + rotation @ EARS[ear]))
                shape = np.exp(-(((RANGES - (out + back) / 2) / WIDTH) ** 2))
                energy[ear] += power * shape / (out * back) ** 2
        yield np.sqrt(energy[..., None] * [0.2, 0.5, 0.3])


def run(spectrograms, positions, rotations, ranges=RANGES, window=WINDOW, **options):
    def places(at, turn):
        return at + turn @ EMITTER, at[:, None] + EARS @ turn.swapaxes(1, 2)

    head = SimpleNamespace(
        range=ranges,
        places=places,
        window=np.sqrt(window)[None],
        sampling_rate=343.0 / (2 * WINDOW_STEP),
        speed_of_sound=343.0,
    )
    return voxel_fit(spectrograms, Poses(positions, rotations), head, *BOX, **options)


@pytest.fixture(scope="module")
def fitted():
    positions, rotations = poses()
    return run(echoes(positions, rotations), positions, rotations, passes=20)


def test_a_scene_of_voxels_is_found_with_its_powers(fitted):
    points, power = fitted.points(), fitted.values.ravel()
    for place, expected in SCENE.items():
        near = np.linalg.norm(points - place, axis=1) < 1.5 * BOX[2]
        found = points[near][power[near].argmax()]
        np.testing.assert_allclose(found, place, atol=1e-9)
        # A voxel's depth widens the window by a tenth, and linear slices round it.
        assert power[near].sum() == pytest.approx(expected, rel=0.1)
    assert power.sum() == pytest.approx(sum(SCENE.values()), rel=0.1)


def test_no_power_is_negative_and_every_one_is_finite(fitted):
    assert np.isfinite(fitted.values).all()
    assert (fitted.values >= 0).all()


def test_silence_has_no_power():
    positions, rotations = poses(3)
    assert (run(np.zeros((3, 2, 400, 1)), positions, rotations).values == 0).all()


def test_what_lies_beyond_the_recording_has_no_power():
    positions, rotations = poses(3)
    for beyond in (np.linspace(2.0, 3.0, 500), np.linspace(0.01, 0.1, 500)):
        volume = run(np.ones((3, 2, 500, 1)), positions, rotations, beyond, window=np.ones(61))
        assert (volume.values == 0).all()


def test_wrong_input_is_refused():
    positions, rotations = poses(3)
    good = np.zeros((3, 2, 400, 1))
    with pytest.raises(ValueError, match="one for each of 3 poses"):
        run(good[:2], positions, rotations)
    with pytest.raises(ValueError, match="spectrogram 0"):
        run(good[:, :, 1:], positions, rotations)
    with pytest.raises(NumericalError, match="pose 0"):
        run(np.full_like(good, np.nan), positions, rotations)
