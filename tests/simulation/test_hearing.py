# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.geometry.poses import rotation_from_euler
from sononerf.head.ears import beam_gain, ear_gain, ear_tables
from sononerf.head.front_end import echo_samples
from sononerf.head.head import Head
from sononerf.settings.schema import EarSettings, SpectrogramSettings
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.impulse_response import plan_synthesis

SPEED = 343.0
ANALYSIS = SpectrogramSettings(range_max=0.4)
SYNTHESIS = plan_synthesis(ANALYSIS, echo_samples(ANALYSIS, SPEED))
NODES = SYNTHESIS.nodes
SETTINGS = EarSettings(left=(-0.01, 0.02, 0.03), emitter=(0.01, 0.0, -0.02))
EARS = ear_tables(SETTINGS, NODES)
POSITION = np.array([1.0, -2.0, 0.5])
ROTATION = rotation_from_euler(1.0, 0.3, -0.2)
POINT = POSITION + ROTATION @ np.array([[0.3, 0.05, -0.1]])[0]


def hearing(absorption=0.0):
    head = Absorbing(ears=SETTINGS, spectrogram=ANALYSIS)
    head.__dict__["loss"] = absorption
    return Hearing(head, SYNTHESIS)


class Absorbing(Head):
    """A head in air with the same absorption at all frequencies."""

    def absorption(self, frequency):
        return np.full(len(frequency), self.loss)


def echo_of(head, ear, level=1.0, **options):
    bins = head.silence()
    head.add(
        bins,
        ear,
        POINT[None],
        length=np.array([0.25]),
        spread=np.zeros(1),
        level=np.full((1, 1), level),
        position=POSITION,
        rotation=ROTATION,
    )
    return head.echo(bins, **options)


def spectrum(echo, frequency):
    time = np.arange(echo.shape[-1]) * 1e-6
    return echo @ np.exp(-2j * np.pi * time[:, None] * frequency)


def test_places_turn_with_the_head():
    emitter, ears = hearing().places(POSITION, ROTATION)
    np.testing.assert_allclose(ROTATION.T @ (emitter - POSITION), [0.01, 0.0, -0.02], atol=1e-12)
    in_head = (ears - POSITION) @ ROTATION
    np.testing.assert_allclose(in_head, [[-0.01, 0.02, 0.03], [-0.01, -0.02, 0.03]], atol=1e-12)


def test_gains_are_those_of_the_tables_in_the_heads_frame():
    inside = np.array([[0.8, 0.6, 0.0], [0.6, 0.0, -0.8]])
    outside = inside @ ROTATION.T
    np.testing.assert_allclose(hearing().beam(outside, ROTATION), beam_gain(EARS, inside))
    for ear in range(2):
        expected = ear_gain(EARS, ear, inside)
        np.testing.assert_allclose(hearing().gain(ear, outside, ROTATION), expected)


@pytest.mark.parametrize("ear", [0, 1])
def test_a_point_adds_what_is_promised(ear):
    """(j f / c) a e^{-jk (r1 + r2)} / r2, times the ear; the other ear hears nothing."""
    frequency = NODES[[2, 5, 8]]
    towards = ROTATION.T @ (POINT - POSITION) - EARS.positions[ear]
    distance = np.linalg.norm(towards)
    gain = ear_gain(EARS, ear, towards[None] / distance)[0, [2, 5, 8]]
    phase = np.exp(-2j * np.pi * frequency * (0.25 + distance) / SPEED)
    expected = 0.7j * frequency / SPEED / distance * gain * phase
    echo = echo_of(hearing(), ear, 0.7)
    np.testing.assert_allclose(spectrum(echo[ear], frequency), expected, rtol=0.005)
    assert not echo[1 - ear].any()


def test_air_takes_its_decibels_over_the_whole_path():
    frequency = NODES[[2, 5, 8]]
    with_air, without = (
        np.abs(spectrum(echo_of(hearing(loss), 0)[0], frequency)) for loss in (20.0, 0.0)
    )
    path = 0.25 + np.linalg.norm(POINT - hearing().places(POSITION, ROTATION)[1][0])
    np.testing.assert_allclose(-20 * np.log10(with_air / without), 20.0 * path, rtol=0.003)


def test_what_is_partly_hidden_is_split_into_two_sounds():
    head, passed = hearing(), np.full((1, len(NODES)), 0.6 - 0.3j, dtype=np.complex64)
    sound, turned = head.silence(), head.silence()
    head.add(
        sound,
        0,
        POINT[None].repeat(2, axis=0),
        length=np.array([0.25, 0.25]),
        spread=np.zeros(2),
        level=np.ones((2, 1)),
        position=POSITION,
        rotation=ROTATION,
        shaded=(turned, np.array([1]), passed),
    )
    whole = echo_of(head, 0)
    scale = 1e-5 * np.abs(whole).max()
    np.testing.assert_allclose(head.echo(sound), 1.6 * whole, atol=scale)
    np.testing.assert_allclose(head.echo(turned), -0.3 * whole, atol=scale)
