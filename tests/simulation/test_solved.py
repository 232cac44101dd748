# SPDX-License-Identifier: MIT
import logging
import pickle

import numpy as np
import pytest

from sononerf.errors import ResourceError, SettingsError
from sononerf.geometry.poses import Poses, look_at
from sononerf.head.air import air_absorption
from sononerf.head.ears import beam_gain, ear_gain
from sononerf.run.build import simulator_of
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation import solved as solved_module
from sononerf.simulation import workers as workers_module
from sononerf.simulation.ensemble import simulate_ensemble
from sononerf.simulation.solved import Heads, Solved
from tests.simulation.exact import SPEED, rigid_sphere
from tests.simulation.listening import ball, level_db, spectrum

POINT_HEAD = {
    "emitter": [0, 0, 0], "left": [0, 0, 0], "beam_radius": 0, "azimuth_deg": 0,
    "elevation_deg": 0, "width_deg": 180, "notch_depth": 0,
}  # fmt: skip
POSITION = np.array([0.4, 0.0, 0.0])
POSE = POSITION, look_at(POSITION, np.zeros(3))


def above(frequency):
    """Share of what is sent back; a pulse of some 30 us takes the rest."""
    return 1 - np.exp(-((frequency / 10e3) ** 2))


class Glint(Solved):
    """A point in front of the scene that sends all but the lowest frequencies back."""

    point = np.array([0.015, 0.0, 0.0])
    poses = 0
    seconds = 0.0
    memory = 0.0

    def respond(self, wavenumber, poses):
        self.poses += len(poses)
        out = np.linalg.norm(poses.emitters - self.point, axis=1)[:, None]
        back = np.linalg.norm(poses.ears - self.point, axis=2)
        kept = above(wavenumber.real * SPEED / (2 * np.pi))
        return kept * np.exp(-1j * wavenumber * (out + back)) / (out * back)

    def estimate(self, poses):
        return self.memory, self.seconds


def simulator(scene=None, head=POINT_HEAD, frequency_max=None, analysis=None, **sections):
    wanted = {"engine": "spheres", "frequency_max": frequency_max}
    sections = {"simulation": wanted, "ears": head, "spectrogram": analysis or {}, **sections}
    settings = validate_settings({"scene": {"name": "test"}, **sections}, "test")
    return simulator_of(scene or load_scene("sphere"), settings)


def glint(scene=None, **options):
    found = simulator(scene, **options)
    engine = found.engine
    found.engine = Glint(
        engine.scene,
        engine.hearing,
        frequency_max=engine.frequency_max,
    )
    return found


@pytest.mark.parametrize("shift", [0.0, 61e-6])  # m, a third of a sample there and back
def test_an_echo_arrives_when_sound_does_between_two_samples_too(shift):
    found = glint()
    position = POSITION + np.array([shift, 0.0, 0.0])
    (echo, _) = found.echo(position, POSE[1], seed=0)
    frequency = np.linspace(5e3, 125e3, 61)
    path = 2 * (0.385 + shift)
    air = 10 ** (-air_absorption(frequency, relative_humidity=0.5) * path / 20)
    expected = above(frequency) * air / (path / 2) ** 2
    expected = expected * np.exp(-2j * np.pi * frequency * path / SPEED)
    found = spectrum(echo, frequency)
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())
    loudest = np.abs(echo).argmax()
    assert loudest == round(path / SPEED * 1e6)


def test_nothing_is_heard_before_the_nearest_point():
    (echo, _) = glint().echo(*POSE, seed=0)
    first = round(2 * 0.385 / SPEED * 1e6)
    before = np.abs(echo[: first - 100])
    assert before.max() < 10 ** (-55 / 20) * np.abs(echo).max()
    engine = glint().engine
    assert not echo[
        : first - round(5 / (engine.frequency_max - engine.frequency_full) * 1e6) - 2
    ].any()


def test_the_band_is_whole_and_falls_as_a_raised_cosine():
    found = glint(frequency_max=115e3, analysis={"frequency_max": 80e3})
    engine = found.engine
    assert engine.frequency_full == pytest.approx(100e3)
    assert engine.frequency[0] == pytest.approx(1e6 / engine.period)
    np.testing.assert_allclose(np.diff(engine.frequency), engine.frequency[0])
    assert engine.frequency[-1] < 115e3 <= engine.frequency[-1] + engine.frequency[0] * (1 + 1e-9)
    (echo, _) = found.echo(*POSE, seed=0)
    frequency = np.array([30e3, 60e3, 99e3, 107.5e3, 116e3, 200e3])
    air = 10 ** (-air_absorption(frequency, relative_humidity=0.5) * 2 * 0.385 / 20)
    level = np.abs(spectrum(echo, frequency)) * 0.385**2 / air
    np.testing.assert_allclose(level, [1, 1, 1, 0.5, 0, 0], atol=0.01)


def test_the_band_reaches_a_window_beyond_the_analysis_and_half_the_rate_at_most():
    engine = simulator(analysis={"frequency_max": 80e3}).engine
    assert engine.frequency_full == pytest.approx(80e3 + 1.81e6 / 64)
    engine = simulator(analysis={"frequency_max": 95e3, "sampling_rate": 200e3}).engine
    assert engine.frequency_max == 100e3
    with pytest.raises(SettingsError, match=r"simulation\.frequency_max is 120000 Hz, above half"):
        simulator(frequency_max=120e3, analysis={"frequency_max": 80e3, "sampling_rate": 200e3})


def test_a_band_below_the_analysis_is_warned_of(caplog):
    simulator(frequency_max=92e3)
    (line,) = [r.getMessage() for r in caplog.records if "frequency_max" in r.getMessage()]
    assert "fades from 80000 Hz on" in line


def test_a_sphere_is_heard_like_the_exact_series():
    scene = Scene(ball(0.015))
    found = simulator(scene)
    (echo, _) = found.echo(*POSE, seed=0)
    frequency = np.linspace(2e3, 125e3, 201)
    air = 10 ** (-air_absorption(frequency, relative_humidity=0.5) * 2 * 0.385 / 20)
    expected = air * rigid_sphere(frequency, 0.015, 0.4, 0.4)
    ratio = spectrum(echo, frequency) / expected
    # The air's loss over the way to the mirror point is that of the glint alone.
    assert np.abs(level_db(ratio)[frequency > 20e3]).max() < 0.05
    assert np.abs(np.angle(ratio)).max() < 0.02
    glinted = np.abs(echo).argmax() / 1e6 * SPEED / 2
    assert glinted == pytest.approx(0.385, abs=1.5e-4)


def test_the_head_is_that_of_the_settings():
    found = simulator(head={})
    engine = found.engine
    position = np.array([[0.4, 0.02, 0.01], [0.1, 0.3, 0.2]])
    turns = np.stack([look_at(place, np.array([0.0, 0.05, 0.0])) for place in position])
    gains = engine.hearing.head.tables(np.array([50e3]))
    emitters = position + turns @ gains.emitter
    ears = position[:, None] + np.einsum("pij,ej->pei", turns, gains.positions)
    heads = Heads(emitters, ears, turns, turns, gains)
    points = np.array([[0.0, 0.0, 0.0], [0.01, 0.1, -0.1], [0.0, -0.2, 0.0]])
    for pose in range(2):
        away = (points - emitters[pose]) @ turns[pose]
        np.testing.assert_allclose(heads.beam(points)[pose], beam_gain(gains, away)[:, 0])
        for ear in range(2):
            away = (points - ears[pose, ear]) @ turns[pose]
            expected = ear_gain(gains, ear, away)[:, 0]
            np.testing.assert_allclose(heads.gain(ear, points)[pose], expected)
    np.testing.assert_allclose(heads[1:].beam(points), heads.beam(points)[1:])


@pytest.mark.thorough
def test_poses_are_solved_once_and_kept_by_what_they_are():
    found, said = glint(), []
    engine = found.engine
    poses = np.stack([POSITION, POSITION + 0.1, POSITION])
    turns = np.stack([POSE[1]] * 3)
    engine.prepare(poses, turns, lambda *done: said.append(done))
    count = len(engine.frequency)
    assert engine.poses == 2 * count
    assert said[-1] == (count, count)
    one = found.echo(*POSE, seed=0)
    assert engine.poses == 2 * count
    np.testing.assert_array_equal(one, glint().echo(*POSE, seed=5))
    again = pickle.loads(pickle.dumps(simulator()))
    np.testing.assert_array_equal(
        again.echo(*POSE, seed=0), pickle.loads(pickle.dumps(again)).echo(*POSE, seed=1)
    )


def test_far_and_near_poses_are_cut_to_the_record():
    found = glint()
    assert not found.echo(np.array([2.0, 0.0, 0.0]), np.eye(3), seed=0).any()
    near = found.echo(np.array([0.03, 0.0, 0.0]), np.eye(3), seed=0)
    assert np.abs(near[0]).argmax() == round(0.03 / SPEED * 1e6)


def test_what_takes_too_much_is_refused_before_it_starts(monkeypatch):
    found = glint()
    found.engine.seconds = 1e7
    with pytest.raises(ResourceError, match=r"1 poses at \d+ frequencies .* 1.2e\+02 days"):
        found.echo(*POSE, seed=0)
    found.engine.seconds, found.engine.memory = 0.0, 5e9
    monkeypatch.setattr(solved_module, "available_memory", lambda: 1_000_000_000)
    with pytest.raises(ResourceError, match=r"need about 5 GB of memory, 1 GB are free"):
        found.echo(*POSE, seed=0)
    assert found.engine.poses == 0


def test_an_ensemble_is_prepared_here_and_at_once(caplog, monkeypatch):
    monkeypatch.setattr(workers_module, "computed", None)
    found, written = glint(), {}
    poses = Poses(np.stack([POSITION, POSITION + 0.1, POSITION + 0.2]), np.stack([POSE[1]] * 3))
    with caplog.at_level(logging.WARNING):
        simulate_ensemble(
            found,
            poses,
            [0, 2],
            written.__setitem__,
            seed_of=lambda _: 0,
            workers=4,
        )
    assert sorted(written) == [0, 2]
    count = len(found.engine.frequency)
    assert found.engine.poses == 2 * count
    (line,) = [r.getMessage() for r in caplog.records if "at once" in r.getMessage()]
    assert line.startswith("Glint solves for all poses at once")


def test_hits_lie_on_the_surface_towards_the_head():
    points, level = simulator(Scene(ball(0.015))).hits(*POSE, seed=0)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.015, rtol=1e-3)
    assert points[level.argmax()][0] > 0.0149
    assert level.max() == 0.0


@pytest.mark.slow
def test_what_wraps_around_is_below_80_db():
    found = simulator(load_scene("three_spheres"), head={}, analysis={"frequency_max": 80e3})
    rng = np.random.default_rng(1)
    places = rng.normal(size=(12, 3))
    places *= 0.4 / np.linalg.norm(places, axis=1)[:, None]
    turns = np.stack([look_at(place, np.zeros(3)) for place in places])
    found.engine.prepare(places, turns)
    for _, response in found.engine._known.values():
        loudest = np.abs(response).max(axis=1)
        assert (np.abs(response[:, -500:]).max(axis=1) < 1e-4 * loudest).all()


def test_a_pose_that_is_no_number_is_left_out_and_refused_by_itself():
    found = glint()
    places = np.stack([POSE[0], np.full(3, np.nan)])
    found.engine.prepare(places, np.stack([POSE[1], POSE[1]]))
    assert found.echo(*POSE, seed=0).any()
    with pytest.raises(ValueError, match="no finite number"):
        found.echo(places[1], POSE[1], seed=0)
