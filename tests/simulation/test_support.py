# SPDX-License-Identifier: MIT
"""Echoes of things on a rigid plane, judged by exact echoes of spheres and their images."""

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError, SettingsError
from sononerf.geometry.poses import Poses, look_at
from sononerf.head.head import Head
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.ensemble import echo_hash, simulate
from sononerf.simulation.hearing import hearing_of
from sononerf.simulation.simulator import Simulator
from sononerf.simulation.solved import Heads
from tests.simulation.listening import ball

TABLE = {"point": (0.0, 0.0, -0.01)}
OPEN = {"directivity": "omnidirectional", "beam_radius": 0.0}
PLACE = np.array([0.25, 0.1, 0.2])
TURN = look_at(PLACE, np.array([0.0, 0.0, 0.01]))
IMAGE = PLACE * np.array([1.0, 1.0, -1.0]) - np.array([0.0, 0.0, 0.02])
BALL, BELOW = ball(0.012, (0.0, 0.0, 0.01)), ball(0.012, (0.0, 0.0, -0.03))


def heard(mesh, head, engine, turn=TURN, place=PLACE, **options):
    options = {"frequency_max": 40e3} if engine == "spheres" else {"rays": 60_000, **options}
    simulator = Simulator.of(Scene(mesh), head, SimulationSettings(engine=engine, **options))
    return simulator.echo(place, turn, seed=0)


def ears(emitter, *receivers):
    """Places in the head frame of the pose PLACE, TURN."""
    inside = [((np.asarray(each) - PLACE) @ TURN).tolist() for each in (emitter, *receivers)]
    return {**OPEN, "emitter": inside[0], "receivers": inside[1:]}


@pytest.mark.slow
def test_echoes_are_those_of_the_body_and_its_image_for_the_emitter_and_its_image():
    ear = PLACE + np.array([0.0, 0.03, 0.02])
    on_table = heard(BALL, Head(ears(PLACE, ear), support=TABLE), "spheres")
    two = trimesh.util.concatenate([BALL, BELOW])
    parts = [heard(two, Head(ears(emitter, ear)), "spheres") for emitter in (PLACE, IMAGE)]
    error = np.abs(on_table - sum(parts)).max()
    assert error < 1e-3 * np.abs(on_table).max()
    assert np.abs(on_table - parts[0]).max() > 0.1 * np.abs(on_table).max()


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
    heads = Heads(emitter[None], ears[None], TURN[None], TURN[None], gains)
    both = heads.with_images(head.plane)
    np.testing.assert_allclose(
        both.beam(points)[1], heads.beam(head.plane.mirrored(points))[0], rtol=1e-6
    )
    np.testing.assert_allclose(both.gain(0, points)[1], heads.gain(0, points)[0])


POSES = np.array([[0.25, 0.1, 0.2], [0.05, 0.1, 0.3], [-0.3, 0.0, 0.08]])
TURNS = np.stack([look_at(place, np.array([0.0, 0.0, 0.01])) for place in POSES])
MICROPHONE = {**OPEN, "emitter": (0.0,) * 3, "receivers": [(0.0, 0.02, 0.0)]}


def error_of(mesh, support, engine, low, high, **options):
    """Mean difference from exact echoes within 20 dB of the loudest cell, dB."""
    head = Head(MICROPHONE, support=support)
    heard = []
    for name, given in (("spheres", {"frequency_max": 60e3}), (engine, {"rays": 60_000})):
        simulator = Simulator.of(Scene(mesh), head, SimulationSettings(engine=name, **given))
        simulator.engine.prepare(POSES, TURNS)
        rows = (head.frequency >= low) & (head.frequency <= high)
        heard.append(
            [
                simulator.spectrogram(place, turn, seed=0)[..., rows]
                for place, turn in zip(POSES, TURNS, strict=True)
            ]
        )
    exact, found = (20 * np.log10(np.maximum(each, 1e-9)) for each in heard)
    return np.abs(exact - found)[exact > exact.max() - 20].mean()


@pytest.mark.slow
@pytest.mark.thorough
def test_the_wave_equation_knows_the_image():
    assert error_of(BALL, TABLE, "hybrid", 20e3, 30e3) < 0.3


@pytest.mark.slow
@pytest.mark.thorough
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


def test_engines_without_images_say_so():
    with pytest.raises(SettingsError, match="kirchhoff knows no support"):
        heard(BALL, Head(support=TABLE), "kirchhoff")


def test_poses_below_the_support_are_refused_at_once():
    poses = Poses(np.stack([PLACE, IMAGE]), np.stack([TURN, TURN]))
    with pytest.raises(InputError, match=r"1 of 2 poses \(1\) are not above the support; move"):
        simulate(Scene(BALL), poses, Head(support=TABLE))
