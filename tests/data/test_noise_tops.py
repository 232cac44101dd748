# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.data.noise_tops import noise_tops

EVEN_DB = 4.0


def noise(poses=200, ranges=875):
    """Means of five independent frequencies, as the analysis window makes of a band."""
    return np.random.default_rng(0).gamma(5.0, 0.2, size=(poses, ranges))


def test_noise_is_known_and_never_reaches_its_tops():
    heard = noise()
    tops, noisy = noise_tops(heard, EVEN_DB)
    assert noisy.all()
    assert (heard.max(axis=1) < tops).all()
    # And these are no farther off than an echo 20 dB louder would be.
    assert (tops < 10 * heard.mean(axis=1)).all()


def test_echoes_in_noise_do_not_raise_it():
    heard = noise()
    heard[:, 300:800] *= 1000.0  # more than half of all ranges
    tops, noisy = noise_tops(heard, EVEN_DB)
    assert noisy.all()
    assert (tops < 20.0).all()


@pytest.mark.parametrize("db", [20.0, 60.0, 120.0])
def test_an_echo_that_fades_is_no_noise(db):
    fading = 10 ** (-db / 10 * np.linspace(0, 1, 875))
    assert not noise_tops(fading, EVEN_DB)[1]


def test_it_scales_with_what_is_heard():
    heard = noise(3)
    tops, noisy = noise_tops(heard, EVEN_DB)
    louder, still = noise_tops(1e6 * heard, EVEN_DB)
    np.testing.assert_allclose(louder, 1e6 * tops)
    np.testing.assert_array_equal(still, noisy)
