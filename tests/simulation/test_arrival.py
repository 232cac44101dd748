# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.run.build import simulator_of
from sononerf.scene.scene import Scene, load_scene
from sononerf.simulation.hearing import Arrival, silence_before
from tests.simulation.listening import ball, wall


def test_the_shortest_way_over_a_large_triangle_is_that_over_its_middle():
    arrival = Arrival(Scene(wall(0.0, (-0.2, -0.2), (0.2, 0.2))))
    place = np.array([[0.3, 0.01, 0.02]])
    assert arrival.shortest(place, place[:, None])[0, 0] == pytest.approx(0.6, abs=1e-3)


def test_each_ear_has_a_way_of_its_own():
    arrival = Arrival(Scene(ball(0.02)))
    emitters = np.array([[0.4, 0.0, 0.0], [0.0, 0.3, 0.0]])
    ears = np.array([[[0.4, 0.0, 0.0], [0.5, 0.0, 0.0]], [[0.0, 0.3, 0.0], [0.0, -0.3, 0.0]]])
    found = arrival.shortest(emitters, ears)
    # What stands in the way is not looked at: no sound can be earlier than on the straight line.
    expected = [[0.76, 0.86], [0.56, 0.6]]
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_nothing_is_left_before_the_first_arrival_and_all_behind_it():
    echo = np.ones((2, 400))
    found = silence_before(echo, np.array([200e-6, 300e-6]), sampling_rate=1e6)
    for row, first in zip(found, (200, 300), strict=True):
        assert not row[: first - 27].any()
        assert (row[first - 25 :] == 1.0).all()


@pytest.mark.parametrize("scene", ["ua", "leaf", "three_spheres"])
def test_no_scene_is_heard_more_than_10_mm_before_its_nearest_point(scene, heard_near):
    assert heard_near(load_scene(scene)) < 1.0


@pytest.fixture
def heard_near():
    """Return the highest level (dB above m0) of two poses more than 10 mm before the scene."""
    from sononerf.geometry.poses import look_at
    from sononerf.head.decibels import compress
    from sononerf.settings.loading import validate_settings

    def level(scene):
        options = {"scene": {"name": "sphere"}, "simulation": {"rays": 30_000, "sources": 200}}
        found = simulator_of(scene, validate_settings(options, "test"))
        places = np.array([[0.4, 0.02, 0.01], [0.1, -0.25, 0.3]])
        turns = look_at(places, np.zeros((2, 3)))
        found.low and found.low.prepare(places, turns)
        magnitudes = np.stack(
            [found.spectrogram(*pose, seed=0) for pose in zip(places, turns, strict=True)]
        )
        levels = compress(magnitudes, 1e-3 * magnitudes.max())
        worst = 0.0
        for pose in range(2):
            emitter, ears = found.hearing.places(places[pose], turns[pose])
            nearest = found.arrival.shortest(emitter[None], ears[None])[0] / 2
            for ear in range(2):
                early = found.head.range < nearest[ear] - 0.010
                worst = max(worst, levels[pose, ear][early].max())
        return worst

    return level
