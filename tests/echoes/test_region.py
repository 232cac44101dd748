# SPDX-License-Identifier: MIT
from types import SimpleNamespace

import numpy as np
import pytest

from sononerf.echoes.detection import find_onsets
from sononerf.echoes.free_space import EchoHull, weighted
from sononerf.echoes.region import EchoRegion
from sononerf.errors import NumericalError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.poses import look_at
from sononerf.head.ears import ear_tables
from sononerf.head.head import PointEcho
from sononerf.settings.schema import EarSettings

STEP = 0.001
RANGE = 0.15 + STEP * np.arange(601)
EARS = ear_tables(EarSettings(), np.array([40e3, 70e3]))
HALF = 0.0054
SAMPLES = np.linspace(-1, 1, 65)
ECHO = PointEcho((0.54 + 0.46 * np.cos(np.pi * SAMPLES)) ** 4, HALF / 32, looks=4.0)
PLACES = np.array([[0.03, -0.02, 0.01], [-0.02, 0.03, -0.02], [0.0, -0.03, 0.03]])


def echoes(position, rotation, places, level=1.0):
    """Each place heard by each ear at half of its path, as long as the analysis window."""
    emitter = position + rotation @ EARS.emitter
    heard = np.zeros((2, len(RANGE), 2))
    for ear, offset in enumerate(EARS.positions):
        for place in places:
            there = np.linalg.norm(place - emitter)
            back = np.linalg.norm(place - position - rotation @ offset)
            away = (RANGE - (there + back) / 2) / HALF
            window = np.where(np.abs(away) < 1, 0.54 + 0.46 * np.cos(np.pi * away), 0.0) ** 2
            heard[ear] += level * window[:, None] / (there * back)
    return heard


def region_of(positions, rotations, spectrograms, scale=1.0):
    store = SimpleNamespace(
        range=scale * RANGE,
        indices=lambda split: {"train": np.arange(len(positions))}[split],
        read_pose=lambda index: spectrograms[index],
    )
    echo = PointEcho(ECHO.window, scale * ECHO.spacing, ECHO.looks)
    heard = find_onsets(store, echo)
    hull = EchoHull(
        scale * (positions + rotations @ EARS.emitter),
        scale * (positions[:, None] + np.einsum("pij,ej->pei", rotations, EARS.positions)),
        heard.first,
        rotations[:, :, 0],
    )
    return EchoRegion(heard, weighted(hull, echo.resolution), EARS, rotations, echo.resolution)


def around(count=60, radius=0.4):
    positions = radius * fibonacci_sphere(count)
    return positions, look_at(positions, np.zeros(3))


def of_places(positions, rotations, places):
    heard = [echoes(p, r, places) for p, r in zip(positions, rotations, strict=True)]
    return region_of(positions, rotations, heard)


def holds(box, places):
    return bool((box[0] <= places.min(axis=0)).all() and (box[1] >= places.max(axis=0)).all())


@pytest.mark.parametrize("count", [12, 25, 100])
def test_the_box_holds_the_places_and_hardly_more(count):
    box = of_places(*around(count), PLACES).box()
    assert holds(box, PLACES)
    spare = np.concatenate((PLACES.min(axis=0) - box[0], box[1] - PLACES.max(axis=0)))
    assert spare.max() < (0.040 if count == 12 else 0.030)


def test_a_world_three_times_as_large_is_found_three_times_as_large():
    """The same arrays on longer axes."""
    positions, rotations = around(40)
    heard = [echoes(p, r, PLACES) for p, r in zip(positions, rotations, strict=True)]
    one, three = (region_of(positions, rotations, heard, scale) for scale in (1.0, 3.0))
    np.testing.assert_allclose(three.hull.first, 3 * one.hull.first, rtol=1e-9)
    np.testing.assert_array_equal(three.hull.weight, one.hull.weight)
    np.testing.assert_allclose(three.box(), 3 * one.box(), rtol=1e-6)
    places = np.random.default_rng(0).uniform(-0.05, 0.05, (500, 3))
    np.testing.assert_array_equal(three.possible(3 * places, 0.006), one.possible(places, 0.002))


def test_what_is_possible_is_free_of_no_pose_and_was_heard():
    region = of_places(*around(), PLACES)
    towards = 0.06 * fibonacci_sphere(50)
    assert region.possible(PLACES, 0.002).all()
    assert not region.possible(towards, 0.002).any()


def test_noise_and_clutter_far_behind_are_left_out():
    """A wall 0.2 m behind the body, always as far from the pose, 20 dB fainter; noise at 30 dB."""
    positions, rotations = around(80)
    generator = np.random.default_rng(0)
    heard = []
    for position, rotation in zip(positions, rotations, strict=True):
        wall = position + 0.65 * rotation[:, 0]
        power = echoes(position, rotation, PLACES) ** 2
        power = power + echoes(position, rotation, [wall], 0.3) ** 2
        heard.append(np.sqrt(power + generator.gamma(2.0, 0.01, power.shape)))
    box = region_of(positions, rotations, heard).box()
    assert holds(box, PLACES)
    assert np.ptp(box, axis=0).max() < 0.13


@pytest.mark.slow
def test_a_faint_part_in_front_is_in_the_box():
    """A ground 30 dB louder than what stands on it: the onsets know it."""
    ground = np.array([[x, y, -0.08] for x in (-0.09, 0.0, 0.09) for y in (-0.09, 0.0, 0.09)])
    faint = np.array([[0.0, 0.0, 0.05]])
    positions, rotations = around(70)
    heard = [
        echoes(p, r, ground) + echoes(p, r, faint, 10**-1.5)
        for p, r in zip(positions, rotations, strict=True)
    ]
    box = region_of(positions, rotations, heard).box()
    assert holds(box, ground)
    assert 0.04 < box[1, 2] < 0.08


def test_nothing_but_noise_is_one_clear_line():
    positions, rotations = around(20)
    generator = np.random.default_rng(3)
    heard = np.sqrt(generator.gamma(4.0, 0.25, (20, 2, len(RANGE), 1)))
    with pytest.raises(NumericalError, match=r"^no pose received an echo .*set region\.lower"):
        region_of(positions, rotations, heard).box()


@pytest.mark.slow
def test_as_few_onsets_as_noise_gives_are_one_clear_line():
    """Two poses confirm each other, but among 2,000 ears noise gives as many."""
    positions, rotations = around(1000)
    one = np.zeros((2, len(RANGE), 1))
    loud = [
        echoes(p, r, PLACES[:1])[..., :1] for p, r in zip(positions[:2], rotations, strict=False)
    ]
    line = (
        r"^no pose received an echo: an onset at 4 of 2000 ears is no more than noise alone gives"
    )
    with pytest.raises(NumericalError, match=line):
        region_of(positions, rotations, [*loud, *[one] * 998])
    region_of(positions[:20], rotations[:20], [*loud, *[one] * 18])  # among 40 it does not


def test_echoes_of_one_pose_alone_are_one_clear_line():
    positions, rotations = around(4)
    heard = np.zeros((4, 2, len(RANGE), 2))
    heard[0] = echoes(positions[0], rotations[0], PLACES)
    with pytest.raises(NumericalError, match=r"no pose received an echo that another one confirms"):
        region_of(positions, rotations, heard).box()


@pytest.mark.slow
@pytest.mark.parametrize("looks", ["at", "along"])
def test_poses_on_a_line(looks):
    place = np.array([[0.3, 0.1, 0.02]])
    positions = np.linspace([0.0, -0.2, 0.0], [0.0, 0.4, 0.0], 25)
    towards = place[0] if looks == "at" else positions + np.eye(3)[0]
    box = of_places(positions, look_at(positions, towards * [1, 1, 0]), place).box()
    assert holds(box, place)


@pytest.mark.slow
def test_poses_on_one_side():
    positions, rotations = around(100)
    ahead = positions[:, 0] > 0.2
    box = of_places(positions[ahead], rotations[ahead], PLACES).box()
    assert holds(box, PLACES)
    assert np.ptp(box, axis=0).max() < 0.2
