# SPDX-License-Identifier: MIT
"""How far traced echoes are believed: what is known beforehand is found again."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.acoustics.spectrogram import compress
from sononerf.reconstruction.retrace import SHARES, best_share, blend, calmed, gain_db

SHAPE = (3, 2, 20, 5)  # poses, ears, ranges, frequencies
OFFSETS = np.array([-3.0, -0.25, 0.0, 1.5, 4.0])  # dB; sums with quarters are exact
REFERENCE = 2e-4


def levels(seed=0, low=25, high=60):
    """Levels that are whole quarters of a decibel."""
    return np.random.default_rng(seed).integers(4 * low, 4 * high, SHAPE) / 4


def magnitudes(seed, loudest_db=40):
    level = np.random.default_rng(seed).uniform(0, loudest_db, SHAPE)
    return REFERENCE * (10 ** (level / 20) - 1)


# Gain.


def test_a_known_gain_is_found_exactly():
    traced = levels()
    np.testing.assert_array_equal(gain_db(traced + OFFSETS, traced), OFFSETS)


@pytest.mark.parametrize("quiet", ["measured", "traced", "both"])
def test_cells_that_are_quiet_in_either_tell_nothing(quiet):
    traced = levels()
    measured = traced + OFFSETS
    # More than half of the cells, so that no median is safe from them.
    measured[:, :, 7:] = 40 if quiet == "traced" else 2
    traced[:, :, 7:] = 60 if quiet == "measured" else 1
    np.testing.assert_array_equal(gain_db(measured, traced), OFFSETS)


def test_a_few_cells_that_are_far_off_move_nothing():
    traced = levels()
    measured = traced + OFFSETS
    measured[0, 0, :5] += 30
    np.testing.assert_array_equal(gain_db(measured, traced), OFFSETS)


def test_a_frequency_at_which_nothing_is_loud_has_no_gain():
    traced = levels()
    measured = traced + OFFSETS
    measured[..., 3] = 12
    expected = OFFSETS.copy()
    expected[3] = 0
    np.testing.assert_array_equal(gain_db(measured, traced), expected)
    np.testing.assert_array_equal(gain_db(np.zeros(SHAPE), np.zeros(SHAPE)), np.zeros(5))


# Blend.


@pytest.mark.parametrize(("share", "expected"), [(0.0, 1), (1.0, 2)])
def test_the_ends_of_a_blend_are_its_parts(share, expected):
    parts = {1: magnitudes(1), 2: magnitudes(2)}
    found = blend(parts[1], parts[2], share, REFERENCE)
    np.testing.assert_allclose(found, parts[expected], rtol=1e-10, atol=1e-12 * REFERENCE)


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_a_blend_is_a_mean_in_decibels(share):
    rendered, traced = magnitudes(1), magnitudes(2)
    found = compress(blend(rendered, traced, share, REFERENCE), REFERENCE)
    expected = (1 - share) * compress(rendered, REFERENCE) + share * compress(traced, REFERENCE)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    # On paper: 20 and 40 dB above silence meet at 30 dB.
    one, other = (REFERENCE * (10 ** (level / 20) - 1) for level in (20, 40))
    assert blend(one, other, 0.5, REFERENCE) == pytest.approx(REFERENCE * (10**1.5 - 1))


@pytest.mark.parametrize("share", SHARES)
def test_silence_blends_to_silence_and_nothing_is_negative(share):
    assert (blend(np.zeros(SHAPE), np.zeros(SHAPE), share, REFERENCE) == 0).all()
    faint = 1e-12 * magnitudes(1)
    assert (blend(faint, np.zeros(SHAPE), share, REFERENCE) >= 0).all()


# Share.


def test_truth_is_believed_whole_and_noise_not_at_all():
    truth, noise = magnitudes(1), magnitudes(2)
    near = blend(truth, magnitudes(3), 0.05, REFERENCE)  # as a good rendering is
    assert best_share(truth, near, truth, REFERENCE) == 1
    assert best_share(truth, near, noise, REFERENCE) == 0
    assert best_share(truth, truth, near, REFERENCE) == 0


@pytest.mark.parametrize("share", SHARES)
def test_the_share_that_made_a_mixture_is_found(share):
    rendered, traced = magnitudes(1), magnitudes(2)
    assert best_share(blend(rendered, traced, share, REFERENCE), rendered, traced, REFERENCE) == (
        share
    )


def test_faint_cells_count_in_decibels_as_loud_ones_do():
    # The rendering is right in the many faint cells, the trace in the few loud ones, which hold
    # nearly all of the pressure.
    truth = magnitudes(1, loudest_db=10)
    rendered, traced = truth.copy(), np.zeros(SHAPE)
    truth[:, :, 0] = rendered[:, :, 0] = traced[:, :, 0] = 1e3 * REFERENCE
    rendered[:, :, 0] *= 1.1
    assert best_share(truth, rendered, traced, REFERENCE) == 0


def test_where_tracing_gains_nothing_it_has_no_share():
    silence = np.zeros(SHAPE)
    assert best_share(magnitudes(1), silence, silence, REFERENCE) == 0


def test_the_shares_reach_from_nothing_to_all():
    assert (SHARES[0], SHARES[-1]) == (0, 1)
    assert list(SHARES) == sorted(SHARES)


# Surface.


def rippled():
    """A sphere of 20 mm with ripples of 0.3 mm, from each vertex to the next."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    ripple = np.random.default_rng(0).normal(0, 0.3e-3, len(sphere.vertices))
    radius = 1 + ripple[:, None] / 0.02
    return trimesh.Trimesh(sphere.vertices * radius, sphere.faces, process=False)


def roughness(mesh):
    return np.linalg.norm(mesh.vertices, axis=1).std()


def test_ripples_are_calmed_and_the_volume_is_kept():
    rough = rippled()
    calm = calmed(rough)
    assert roughness(calm) < 0.5 * roughness(rough)
    # Taubin's pass band ends above the sphere's own curvature; 0.5 % of the volume are 0.03 mm of
    # the radius, a hundredth of the shortest wavelength. Smoothing that only shrinks loses 4 %.
    assert calm.volume == pytest.approx(rough.volume, rel=5e-3)
    np.testing.assert_array_equal(calm.faces, rough.faces)


def test_calming_leaves_the_argument_as_it_was():
    rough = rippled()
    vertices, faces = rough.vertices.copy(), rough.faces.copy()
    calm = calmed(rough)
    np.testing.assert_array_equal(rough.vertices, vertices)
    np.testing.assert_array_equal(rough.faces, faces)
    calm.vertices[:] = 0
    np.testing.assert_array_equal(rough.vertices, vertices)
