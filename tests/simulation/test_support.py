# SPDX-License-Identifier: MIT
"""Echoes of things on a rigid plane, judged by exact echoes of spheres and their images."""

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError
from sononerf.geometry.poses import Poses, look_at
from sononerf.head.head import Head
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import echo_hash, simulate
from sononerf.simulation.hearing import hearing_of
from sononerf.simulation.low_band import HeadPoses
from sononerf.simulation.simulator import Simulator
from tests.simulation.judges import Case, heard
from tests.simulation.listening import ball

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
