# SPDX-License-Identifier: MIT
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.integrate import quad

from sononerf.errors import InputError
from sononerf.geometry.poses import Poses, look_at
from sononerf.head.head import Head
from sononerf.scene.material import RIGID, SONOTRACELAB, Material
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import echo_hash, simulate
from sononerf.simulation.hearing import hearing_of
from sononerf.simulation.low_band import HeadPoses
from sononerf.simulation.paths import leave, lobe_exponent, reflection, unfaded
from sononerf.simulation.simulator import Simulator
from tests.simulation.judges import Case, heard
from tests.simulation.listening import ball

SPEED = 343.0


def at(material, *frequency):
    return reflection(material, frequency, speed_of_sound=SPEED)


def gain(found, angle=0.0, detour=0.0, curvature=0.0):
    """Of one hit (F,)."""
    one = (np.array([value], float) for value in (np.cos(angle), detour, curvature))
    return np.broadcast_to(found.heard(*one)[0], found.strength.shape)


def test_values_run_straight_over_the_logarithm_of_frequency_and_stay_beyond():
    found = at(SONOTRACELAB, 5e3, 20e3, np.sqrt(20e3 * 150e3), 150e3, 200e3)
    np.testing.assert_allclose(np.degrees(found.lobe_width), [12, 12, 8, 4, 4])
    np.testing.assert_allclose(np.degrees(found.curved_lobe_width), 70)
    np.testing.assert_allclose(found.strength, [1, 1, 0.85, 0.7, 0.7])
    np.testing.assert_allclose(found.kept, [1, 1, 0.85, 0.7, 0.7])
    np.testing.assert_allclose(found.curved_strength[[1, 3]], [0.0016, 0.002])
    np.testing.assert_allclose(found.diffraction[[1, 3]], [0.8, 1.0])


def test_what_has_no_curve_of_its_own_follows_the_plain_one():
    found = at(Material(lobe_width=(0.2, 0.1), strength=(1.0, 0.5)), 20e3, 150e3)
    np.testing.assert_array_equal(found.curved_lobe_width, found.lobe_width)
    np.testing.assert_array_equal(found.curved_strength, found.strength)
    assert not at(replace(RIGID, diffraction=None), 50e3).diffraction.any()


def test_a_lobe_falls_off_the_mirror_direction_and_knows_no_detour():
    found = at(Material((5e4,), (0.2,), (0.5,), (1.0,), diffraction=None), 30e3, 90e3)
    np.testing.assert_allclose(gain(found), 0.5)
    np.testing.assert_allclose(gain(found, angle=0.2, detour=0.1), 0.5 * math.exp(-0.5), rtol=1e-6)


@pytest.mark.parametrize("frequency", [10e3, 30e3, 80e3])
def test_a_smooth_surface_has_the_level_of_the_whole_integral(frequency):
    """Over Fresnel zones: f gain integral of fade(d) e^{-jkd} is that of e^{-jkd} alone."""
    found = at(RIGID, frequency)
    k = 2 * np.pi * frequency / SPEED

    def part(function):
        end = 25.0 / found.fade[0]
        return quad(lambda d: gain(found, detour=d)[0] * function(k * d), 0.0, end, limit=500)[0]

    _, made_good = unfaded(np.array([frequency]), speed_of_sound=SPEED)
    whole = (part(np.cos) - 1j * part(np.sin)) * made_good[0]
    # 1 / jk times jf; phase and all.
    assert whole == pytest.approx(frequency / k, rel=1e-4)
    # The angle does not count: the shape alone decides.
    np.testing.assert_array_equal(gain(found, angle=1.0), gain(found))
    assert gain(found, detour=8.0 / found.fade[0])[0] < 1e-3 * gain(found)[0]


def test_half_is_curved_at_the_transition():
    """SonoTraceLab's law: 1 / (1 + e^{-8 b (kappa - kappa_0)})."""
    found = at(SONOTRACELAB, 20e3, 150e3)
    share = found.curved_share(np.array([0.0, 900.0, 1000.0, 1100.0, 1e5, 1e9]))
    expected = 1 / (1 + np.exp(-8 * 0.002 * (np.array([0.0, 900.0, 1000.0, 1100.0]) - 1000.0)))
    np.testing.assert_allclose(share[:4], expected)
    np.testing.assert_array_equal(share[4:], 1.0)
    np.testing.assert_allclose(
        gain(found, curvature=1000.0), (found.strength + found.curved_strength) / 2
    )
    np.testing.assert_allclose(gain(found, curvature=1e6), found.curved_strength)
    np.testing.assert_allclose(gain(found), found.strength, rtol=1e-6)
    width = np.radians([(12 + 70) / 2, (4 + 70) / 2])
    lobe = gain(found, angle=0.3, curvature=1000.0) / gain(found, curvature=1000.0)
    np.testing.assert_allclose(lobe, np.exp(-0.5 * (0.3 / width) ** 2), rtol=1e-6)


def test_without_a_transition_nothing_is_curved():
    found = at(RIGID, 50e3)
    np.testing.assert_array_equal(found.curved_share(np.array([0.0, 1e9])), 0.0)


def test_reach_ends_where_the_widest_lobe_is_seventy_decibels_down():
    assert at(RIGID, 50e3).reach == math.pi
    narrow = Material(lobe_width=(0.2, 0.1))
    reach = at(narrow, 20e3, 150e3).reach
    assert 20 * math.log10(math.exp(-0.5 * (reach / 0.2) ** 2)) == pytest.approx(-70, abs=1.0)
    assert at(SONOTRACELAB, 20e3).reach == math.pi  # four times 70 degrees


def test_rays_leave_off_the_surface_and_those_into_it_graze_it():
    flat, points = np.array([[0.0, 0.0, 1.0]] * 2), np.array([[0.1, 0.2, 0.3]] * 2)
    directions = np.array([[0.6, 0.0, 0.8], [0.6, 0.0, -0.8]])
    origins, found = leave(directions, flat, points, 1e-3)
    np.testing.assert_allclose(origins, [[0.1, 0.2, 0.301]] * 2)
    np.testing.assert_array_equal(found[0], directions[0])
    np.testing.assert_allclose(found[1], [1.0, 0.0, 0.0], atol=1e-3)
    assert found[1, 2] > 0.0


def test_lobe_is_a_gaussian_of_the_angle():
    theta, width = np.array([0.0, 0.1, 0.2]), np.array([0.1, 0.4])
    found = np.exp(lobe_exponent(np.cos(theta), width))
    np.testing.assert_allclose(found[:, 0], [1.0, np.exp(-0.5), np.exp(-2.0)], rtol=1e-9)
    np.testing.assert_allclose(found[1, 1], np.exp(-1 / 32), rtol=1e-9)
    assert np.exp(lobe_exponent(np.array([1.0 + 1e-16]), width)).max() == 1.0


TABLE = {"point": (0.0, 0.0, -0.01)}
OPEN = {"directivity": "omnidirectional", "beam_radius": 0.0}
PLACE = np.array([0.25, 0.1, 0.2])
TURN = look_at(PLACE, np.array([0.0, 0.0, 0.01]))
IMAGE = PLACE * np.array([1.0, 1.0, -1.0]) - np.array([0.0, 0.0, 0.02])
BALL, BELOW = ball(0.012, (0.0, 0.0, 0.01)), ball(0.012, (0.0, 0.0, -0.03))


def test_the_beam_of_an_image_is_mirrored():
    """What the image sends to a point is what the emitter sends to the image of the point."""
    head = Head({**OPEN, "emitter": (0.01, 0.0, 0.0), "beam_radius": 0.02}, support=TABLE)
    points = np.random.default_rng(0).uniform((-0.05, -0.05, 0.0), (0.05, 0.05, 0.1), (20, 3))
    hearing = hearing_of(head)
    emitter, ears = hearing.places(PLACE, TURN)
    image, same = hearing.from_image.places(PLACE, TURN)
    np.testing.assert_allclose(image, head.plane.mirrored(emitter), atol=1e-12)
    np.testing.assert_array_equal(ears, same)
    away = points - image
    sent = hearing.from_image.beam(away, TURN)
    np.testing.assert_allclose(
        sent, hearing.beam(head.plane.mirrored(points) - emitter, TURN), rtol=1e-4
    )
    gains = head.tables(np.array([40e3]))
    heads = HeadPoses(emitter[None], ears[None], TURN[None], TURN[None], gains)
    both = heads.with_images(head.plane)
    np.testing.assert_allclose(
        both.beam(points)[1], heads.beam(head.plane.mirrored(points))[0], rtol=1e-6
    )
    np.testing.assert_allclose(both.gain(0, points)[1], heads.gain(0, points)[0])


MICROPHONE = {**OPEN, "emitter": (0.0,) * 3, "receivers": [(0.0, 0.02, 0.0)]}


def error_of(mesh, support, engine, low, high):
    """Mean difference from exact echoes within 20 dB of the loudest cell, dB."""
    head = Head(MICROPHONE, support=support)
    case = Case.load("over_image" if support is None else "on_table")
    simulator = Simulator(Scene(mesh), head, SimulationSettings(engine=engine, rays=60_000))
    rows = (head.frequency >= low) & (head.frequency <= high)
    found, exact = (
        20 * np.log10(np.maximum(each[..., rows], 1e-9))
        for each in (heard(simulator, case), case.spectrograms(head))
    )
    return np.abs(exact - found)[exact > exact.max() - 20].mean()


@pytest.mark.slow
def test_the_wave_equation_knows_the_image():
    assert error_of(BALL, TABLE, "hybrid", 20e3, 30e3) < 0.3


@pytest.mark.slow
def test_rays_are_as_exact_on_a_support_as_off_the_body_and_its_image():
    two = trimesh.util.concatenate([BALL, BELOW])
    assert error_of(BALL, TABLE, "rays", 35e3, 45e3) < 1.3 * error_of(two, None, "rays", 35e3, 45e3)


def test_a_support_is_part_of_what_echoes_depend_on():
    scene, poses = Scene(BALL), Poses(PLACE[None], TURN[None])
    hashes = {
        echo_hash(scene, poses, np.zeros(1, np.int8), Head(support=support), SimulationSettings())
        for support in (None, TABLE, {"point": (0.0, 0.0, -0.02)})
    }
    assert len(hashes) == 3


def test_poses_below_the_support_are_refused_at_once():
    poses = Poses(np.stack([PLACE, IMAGE]), np.stack([TURN, TURN]))
    with pytest.raises(InputError, match=r"1 of 2 poses \(1\) are not above the support; move"):
        simulate(Scene(BALL), poses, Head(support=TABLE))
