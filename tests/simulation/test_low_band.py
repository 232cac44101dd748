# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.echoes.store import EnsembleStore, chunk_path
from sononerf.geometry.poses import look_at
from sononerf.head.ears import Ears
from sononerf.progress import Progress
from sononerf.run.simulate import simulate, simulator_of
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation import simulator as module
from sononerf.simulation.hearing import Arrival
from sononerf.simulation.low_band import (
    HeadPoses,
    LowBand,
    low_band,
    resolved_frequency,
    sources_worth,
)
from sononerf.simulation.simulator import ensemble_poses, settle_rays
from tests.simulation.exact import SPEED, rigid_sphere
from tests.simulation.judges import Case
from tests.simulation.listening import ball, hearing, spectrum

PLACE = np.array([0.35, 0.0, 0.0])
EARS = ((0.0, 0.0, 0.0), (0.0, 0.1, 0.0))


def band_of(mesh, most=400):
    scene = Scene(mesh)
    return LowBand(scene, hearing(ears=EARS), Arrival(scene), most=most)


def poses_at(count, frequency):
    """Return heads that send and hear alike in all directions, with two ears."""
    angles = np.linspace(-np.pi, np.pi, 5), np.linspace(-np.pi / 2, np.pi / 2, 3)
    whole = np.ones((1, 3, 5), np.float32)
    places = np.zeros(3), np.array(EARS)
    gains = Ears(*angles, np.array([frequency]), whole, np.stack([whole] * 2), *places)
    places = PLACE + 0.02 * np.random.default_rng(0).standard_normal((count, 3))
    turns = np.tile(np.eye(3), (count, 1, 1))
    return HeadPoses(places, places[:, None] + np.array(EARS), turns, turns, gains)


def wavenumber(frequency):
    return complex(2 * np.pi * frequency / SPEED)


@pytest.mark.parametrize("ka", [0.3, 1.0, np.pi, 4.4934, 7.0, 9.5])
def test_a_sphere_is_that_of_the_series(ka):
    """At the resonances of its inside (pi, 4.49), too."""
    radius = 0.015
    frequency = ka * SPEED / (2 * np.pi * radius)
    band, poses = band_of(ball(radius)), poses_at(1, frequency)
    assert frequency < band.frequency_max
    distance = float(np.linalg.norm(poses.emitters[0]))
    expected = rigid_sphere(frequency, radius, distance, distance)[0]
    assert abs(band.respond(wavenumber(frequency), poses)[0, 0] / expected - 1) < 0.02
    (error,) = band.error.values()
    assert error < 0.02


@pytest.mark.parametrize("shift", [0.0, 61e-6])  # m, a third of a sample there and back
def test_an_echo_arrives_when_sound_does_between_two_samples_too(shift):
    band, place = band_of(ball(0.015)), PLACE + shift * np.eye(3)[0]
    echo = band.echo(place, np.eye(3))[0]
    frequency = np.linspace(8e3, 0.98 * band.frequency_full, 40)
    expected = rigid_sphere(frequency, 0.015, *[0.35 + shift] * 2)
    error = np.abs(spectrum(echo, frequency) - expected).max()
    assert error < 0.03 * np.abs(expected).max()


def test_the_band_falls_as_a_raised_cosine():
    band = band_of(ball(0.015))
    middle = (band.frequency_full + band.frequency_max) / 2
    ends = np.array([5e3, band.frequency_full, middle, band.frequency_max, 2 * band.frequency_max])
    np.testing.assert_allclose(band.taper(ends), [1, 1, 0.5, 0, 0], atol=1e-9)
    assert band.frequency[-1] < band.frequency_max <= band.frequency[-1] + band.frequency[0] * 1.001


def test_far_and_near_poses_are_cut_to_the_record():
    band = band_of(ball(0.015))
    assert not band.echo(np.array([2.0, 0.0, 0.0]), np.eye(3)).any()
    assert band.echo(np.array([0.05, 0.0, 0.0]), np.eye(3)).any()


def test_poses_are_solved_once_and_kept():
    band, solved = band_of(ball(0.015), most=100), []
    turns = np.stack([np.eye(3)] * 3)
    band.prepare(np.stack([PLACE, PLACE + 0.1, PLACE]), turns, lambda: solved.append(1))
    assert len(solved) == len(band.frequency)
    one = band.echo(PLACE, np.eye(3))
    np.testing.assert_array_equal(one, band_of(ball(0.015), most=100).echo(PLACE, np.eye(3)))
    band.prepare(PLACE[None], turns[:1], lambda: solved.append(1))
    assert len(solved) == len(band.frequency)


def test_the_inside_of_the_sources_does_not_resonate():
    """A resonance of it is a fraction of a percent wide: the error jumps at single frequencies."""
    band = band_of(ball(0.015), most=200)
    for ka in np.linspace(5.94, 6.04, 40):
        frequency = ka * SPEED / (2 * np.pi * 0.015)
        band.respond(wavenumber(frequency), poses_at(1, frequency))
    error = np.array(list(band.error.values()))
    assert np.max(error[1:-1] / np.maximum(error[:-2], error[2:])) < 1.1


def test_a_pose_does_not_depend_on_the_others():
    band, many = band_of(ball(0.015), most=60), poses_at(70, 9e3)
    together = band.respond(wavenumber(9e3), many)[40:41]
    np.testing.assert_array_equal(together, band.respond(wavenumber(9e3), many[slice(40, 41)]))


def test_too_few_sources_show_in_the_error():
    coarse, fine = band_of(ball(0.015), most=60), band_of(ball(0.015), most=400)
    assert max(coarse.trial(), fine.trial()) < 0.1  # each at its own highest frequency
    k = wavenumber(fine.frequency[-1])
    for band in (coarse, fine):
        band.respond(k, poses_at(2, fine.frequency[-1]))
    (of_coarse,), (of_fine,) = coarse.error.values(), fine.error.values()
    assert of_coarse > 0.3
    assert of_fine < 0.03


def test_four_times_the_sources_reach_twice_the_frequency():
    scene = Scene(ball(0.015))
    one, two = (resolved_frequency(scene, most, speed_of_sound=SPEED) for most in (100, 400))
    assert two == pytest.approx(2 * one)
    both = Scene(trimesh.util.concatenate([ball(0.015), ball(0.015, (0.1, 0.0, 0.0))]))
    assert sources_worth(both) == pytest.approx(2 * sources_worth(scene), abs=1)


def test_kept_equations_answer_further_poses_alike(monkeypatch):
    plain, keeping = (band_of(ball(0.015), most=200) for _ in range(2))
    keeping.keeps = True
    k, poses = wavenumber(20e3), poses_at(3, 20e3)
    for pose in range(3):
        some = poses[slice(pose, pose + 1)]
        np.testing.assert_allclose(keeping.respond(k, some), plain.respond(k, some), rtol=1e-4)


def simulator(scene, **simulation):
    simulation = {"rays": 30_000, "sources": 300, **simulation}
    settings = {"scene": {"name": "sphere"}, "simulation": simulation}
    return simulator_of(scene, validate_settings(settings, "test"))


POSE = np.array([0.35, 0.05, -0.02]), look_at([0.35, 0.05, -0.02], np.zeros(3))


def levels(magnitude):
    return 20 * np.log10(np.maximum(magnitude, 1e-3 * magnitude.max()))


def test_it_is_closer_to_the_truth_than_rays_at_low_frequencies():
    """A sphere half behind another: creeping, shadow, and sound back and forth."""
    scene = Scene(trimesh.util.concatenate([ball(0.012), ball(0.012, (-0.04, 0.006, 0.0))]))
    default, rays = simulator(scene), simulator(scene, engine="rays")
    highest = default.low.frequency_full
    assert highest > 15e3
    exact = levels(Case.load("half_hidden").spectrograms(default.head)[0])
    loud = exact > exact.max() - 30
    loud[..., default.head.frequency > 0.6 * highest] = False
    of_default, of_rays = (
        np.abs(levels(each.spectrogram(*POSE, seed=0)) - exact)[loud].mean()
        for each in (default, rays)
    )
    assert of_default < 0.5
    assert of_rays > 5.0


def test_high_frequencies_are_those_of_the_rays():
    scene = Scene(ball(0.015))
    default = simulator(scene)
    both, alone = (
        levels(each.spectrogram(*POSE, seed=0))
        for each in (default, simulator(scene, engine="rays"))
    )
    high = default.head.frequency > default.low.frequency_max + 40e3  # beyond the window's lobe
    loud = (alone > alone.max() - 20) & high
    assert loud.any()
    np.testing.assert_allclose(both[loud], alone[loud], atol=0.3)


def half_open():
    half = ball(0.015)
    half.update_faces(half.triangles_center[:, 0] > 0.0)
    return Scene(half)


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        (Scene(trimesh.creation.box((0.06, 0.05, 3e-4))), "too thin"),
        (Scene(ball(0.3)), "so large"),
        (load_scene("sphere", {"material": "sonotracelab"}), "not rigid"),
        (half_open(), "open"),
    ],
)
def test_rays_do_all_where_the_low_band_cannot_be_solved(scene, reason):
    default = simulator(scene)
    assert default.low is None
    assert reason in default.note
    assert low_band(scene, default.hearing, default.arrival, sources=300, frequency_min=1e3) != ""


QUIET = Progress(quiet=True)
NOISE = {"snr_db": 10}


def settings(noise=None, **simulation):
    return validate_settings(
        {
            "scene": {"name": "torus"},
            "simulation": {"engine": "rays", "noise_floor_poses": 4, **simulation},
            "poses": {"count": 8, "validation": 0, "heldout": 4},
            "noise": noise or {},
        },
        "test",
    )


def settled(wanted, progress=QUIET):
    scene = load_scene(wanted.scene.name, wanted.scene.options)
    simulator, poses = simulator_of(scene, wanted), ensemble_poses(wanted.poses)[0]
    return settle_rays(simulator, poses, wanted.simulation, progress), simulator


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(module, "FIRST_RAYS", 500)


@pytest.mark.slow
def test_the_accuracy_is_reached_and_costs_rays(few, tmp_path):
    rays = []
    for wanted in (2.0, 1.0):
        store = simulate(settings(accuracy_db=wanted), output=tmp_path / str(wanted), workers=1)
        # At four other poses than those of the trials.
        assert store.attributes["noise_floor_mae_db_active"] < 1.5 * wanted
        rays.append(store.attributes["rays"])
    assert 500 <= rays[0] < rays[1] < simulator.MOST


def test_noise_of_the_ears_asks_for_no_more_rays(few):
    quiet, noisy = (settled(settings(noise, accuracy_db=2.0))[0] for noise in (None, NOISE))
    assert quiet == noisy


def test_a_number_of_rays_is_taken_as_it_is():
    rays, simulator = settled(settings(rays=777))
    assert rays == simulator.rays.rays == 777


@pytest.mark.slow
def test_a_number_that_a_damaged_store_names_is_not_taken(few, tmp_path):
    wanted = settings(accuracy_db=3.0)
    store = simulate(wanted, output=tmp_path / "store", workers=1)
    rays = store.attributes["rays"]
    for damaged in ("many", 10**12, -1):
        chunk_path(store.path, "spectrogram", (3, 0, 0, 0)).unlink()
        EnsembleStore.open(store.path, mode="r+").update_attributes(rays=damaged)
        again = simulate(wanted, output=tmp_path / "store", workers=1)
        assert again.attributes["rays"] == rays
