# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.head.ears import Ears
from sononerf.scene.scene import Scene
from sononerf.simulation import equivalent_sources
from sononerf.simulation.equivalent_sources import Sources, resolved_frequency, sources_worth
from sononerf.simulation.reference.spheres import Spheres
from tests.simulation.exact import SPEED, rigid_sphere
from tests.simulation.listening import ball, hearing, level_db

PLACE = np.array([0.35, 0.0, 0.0])
EARS = ((0.0, 0.0, 0.0), (0.0, 0.1, 0.0))


def gains(frequency):
    """Return a head that sends and hears alike in all directions, with two ears."""
    grid = (len(frequency), 3, 5)
    angles = np.linspace(-np.pi, np.pi, 5), np.linspace(-np.pi / 2, np.pi / 2, 3)
    whole = np.ones(grid, np.float32)
    return Ears(*angles, frequency, whole, np.stack([whole] * 2), np.zeros(3), np.array(EARS))


def sources(mesh, most=400, **options):
    head = hearing(ears=EARS)
    return Sources(Scene(mesh), head, most=most, fall=1.3, **options)


def heads(count, frequency):
    from sononerf.simulation.solved import Heads

    places = PLACE + 0.02 * np.random.default_rng(0).standard_normal((count, 3))
    turns = np.tile(np.eye(3), (count, 1, 1))
    ears = places[:, None] + np.array(EARS)
    return Heads(places, ears, turns, turns, gains(np.array([frequency])))


def wavenumber(frequency):
    return complex(2 * np.pi * frequency / SPEED)


@pytest.mark.parametrize("ka", [0.3, 1.0, np.pi, 4.4934, 7.0, 9.5])
def test_a_sphere_is_that_of_the_series(ka):
    """At the resonances of its inside (pi, 4.49), too."""
    radius = 0.015
    frequency = ka * SPEED / (2 * np.pi * radius)
    engine = sources(ball(radius))
    assert frequency < engine.frequency_max
    found = engine.respond(wavenumber(frequency), heads(1, frequency))[0, 0]
    place = heads(1, frequency).emitters[0]
    distance = float(np.linalg.norm(place))
    expected = rigid_sphere(frequency, radius, distance, distance)[0]
    assert abs(found / expected - 1) < 0.02
    (error,) = engine.error.values()
    assert error < 0.02


@pytest.mark.slow
def test_spheres_that_shade_each_other_are_those_of_multiple_scattering():
    mesh = trimesh.util.concatenate(
        [ball(0.015), ball(0.012, (-0.035, 0.004, 0.0)), ball(0.01, (0.0, 0.03, 0.01))]
    )
    engine = sources(mesh, most=900)
    exact = Spheres(Scene(mesh), hearing(ears=EARS), frequency_max=40e3)
    for frequency in (8e3, 20e3, 0.95 * engine.frequency_max):
        k, places = wavenumber(frequency), heads(5, frequency)
        found, expected = engine.respond(k, places), exact.respond(k, places)
        assert np.abs(found - expected).max() < 0.03 * np.abs(expected).max()
        assert np.abs(level_db(found) - level_db(expected)).mean() < 0.15


def test_the_inside_of_the_sources_does_not_resonate():
    """A resonance of it is a fraction of a percent wide: the error jumps at single frequencies."""
    engine = sources(ball(0.015), most=200)
    for ka in np.linspace(5.94, 6.04, 40):
        frequency = ka * SPEED / (2 * np.pi * 0.015)
        engine.respond(wavenumber(frequency), heads(1, frequency))
    error = np.array(list(engine.error.values()))
    assert np.max(error[1:-1] / np.maximum(error[:-2], error[2:])) < 1.1


def test_a_pose_does_not_depend_on_the_others():
    engine = sources(ball(0.015), most=60)
    many, one = heads(70, 9e3), heads(70, 9e3)[slice(40, 41)]
    found = engine.respond(wavenumber(9e3), many)[40:41]
    np.testing.assert_array_equal(found, engine.respond(wavenumber(9e3), one))


def test_the_error_tells_of_too_few_sources():
    errors = [sources(ball(0.015), most=most).trial() for most in (60, 400)]
    coarse, fine = sources(ball(0.015), most=60), sources(ball(0.015), most=400)
    k = wavenumber(fine.frequency[-1])
    for engine in (coarse, fine):
        engine.respond(k, heads(2, fine.frequency[-1]))
    (of_coarse,), (of_fine,) = coarse.error.values(), fine.error.values()
    assert of_coarse > 0.3
    assert of_fine < 0.03
    assert max(errors) < 0.1  # each is asked about its own highest frequency


def test_a_sheet_is_too_thin_and_a_ball_is_not():
    sheet = trimesh.creation.box((0.06, 0.05, 3e-4))
    assert sources(sheet).thin > 0.9
    assert sources(ball(0.015)).thin == 0.0


def test_four_times_the_sources_reach_twice_the_frequency():
    scene = Scene(ball(0.015))
    one, two = (resolved_frequency(scene, most, speed_of_sound=SPEED) for most in (100, 400))
    assert two == pytest.approx(2 * one)
    # Of a sphere as many are worth it as reach ka = 12.
    most = sources_worth(scene)
    highest = resolved_frequency(scene, most, speed_of_sound=SPEED)
    assert 2 * np.pi * highest / SPEED * 0.015 == pytest.approx(12.0, rel=0.01)
    both = Scene(trimesh.util.concatenate([ball(0.015), ball(0.015, (0.05, 0.0, 0.0))]))
    assert sources_worth(both) == pytest.approx(2 * most, abs=1)


def test_kept_equations_answer_further_poses_alike(monkeypatch):
    made = []
    real = equivalent_sources._System

    def counted(*given):
        made.append(given)
        return real(*given)

    monkeypatch.setattr(equivalent_sources, "_System", counted)
    plain, keeping = (sources(ball(0.015), most=200) for _ in range(2))
    keeping.keeps = True
    k, poses = wavenumber(20e3), heads(3, 20e3)
    for pose in range(3):
        some = poses[slice(pose, pose + 1)]
        wanted, found = plain.respond(k, some), keeping.respond(k, some)
        np.testing.assert_allclose(found, wanted, rtol=1e-4)
    assert len(made) == 3 + 1
    keeping._kept.clear()
    monkeypatch.setattr(equivalent_sources, "available_memory", lambda: 1000)
    keeping.respond(k, poses)
    assert not keeping._kept  # it has no room
