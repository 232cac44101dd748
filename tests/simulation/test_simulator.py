# SPDX-License-Identifier: MIT
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
import trimesh

from sononerf.errors import SettingsError
from sononerf.geometry.poses import look_at, rotation_from_euler
from sononerf.head.directivity_files import write_sofa
from sononerf.head.front_end import compress
from sononerf.head.reception import air_absorption
from sononerf.run.simulate import simulator_of
from sononerf.scene.material import RIGID, Material
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.loading import validate_settings
from tests.head.directivity.patterns import pair
from tests.simulation.judges import SMALL, Case, banded, heard, scene_of

POINT_HEAD = {
    "emitter": [0, 0, 0], "left": [0, 0, 0], "beam_radius": 0, "azimuth_deg": 0,
    "elevation_deg": 0, "width_deg": 180, "notch_depth": 0,
}  # fmt: skip
WIDE = Material((1e5,), (math.radians(30),), (1.0,), (1.0,), diffraction=None)
NARROW = Material((1e5,), (math.radians(1),), (1.0,), (1.0,), diffraction=None)
PLAIN = replace(RIGID, diffraction=None)


def simulator(scene, rays=40_000, **sections):
    simulation = {"rays": rays, "sources": 60, **sections.pop("simulation", {})}
    sections["simulation"] = simulation
    settings = validate_settings({"scene": {"name": "test"}, **sections}, "test")
    return simulator_of(scene, settings)


def plate(lower, upper):
    lower, upper = np.array(lower, float), np.array(upper, float)
    box = trimesh.creation.box(upper - lower)
    box.apply_translation((lower + upper) / 2)
    return box


def spectrum(echo, frequency):
    samples = np.arange(echo.shape[-1]) * 1e-6
    return echo @ np.exp(-2j * np.pi * samples[:, None] * frequency)


def active_error(a, b):
    reference = 1e-3 * max(a.max(), b.max())
    a, b = compress(a, reference), compress(b, reference)
    return np.abs(a - b)[(a >= 3) | (b >= 3)].mean()


def test_first_echo_of_a_sphere_comes_from_its_front():
    scene = Scene(load_scene("sphere").mesh, NARROW)
    found = simulator(scene, ears=POINT_HEAD)
    position = np.array([0.4, 0.0, 0.0])
    (echo, _) = found.echo(position, look_at(position, np.zeros(3)), seed=0)
    middle = (np.arange(len(echo)) * echo**2).sum() / (echo**2).sum()
    # 2 (0.4 - 0.015) m; the mesh lies up to 3 um inside the sphere, a sample is 171 um.
    assert middle * 1e-6 * 343.0 / 2 == pytest.approx(0.385, abs=5e-6)
    magnitude = found.spectrogram(position, look_at(position, np.zeros(3)), seed=0)
    peak = found.head.range[magnitude[0, :, 30].argmax()]
    assert abs(peak - 0.385) <= np.diff(found.head.range)[0] / 2 + 5e-6


@pytest.mark.parametrize(("material", "error"), [(PLAIN, 0.02), (WIDE, 0.02)])
def test_a_wide_plate_is_a_mirror(material, error):
    """Image source: pressure 1 / (2 h), air taken off, at any frequency."""
    height, frequency = 0.3, np.array([40e3, 60e3, 90e3])
    scene = Scene(plate([height, -0.25, -0.25], [height + 0.01, 0.25, 0.25]), material)
    air = 10 ** (-air_absorption(frequency, relative_humidity=0.5) * 2 * height / 20)
    found = simulator(scene, 1000, ears=POINT_HEAD, simulation={"rays": 1000, "bounces": 1})
    echo = found.echo(np.zeros(3), np.eye(3), seed=1)
    # Of a lobe, ripples of its width.
    level = np.abs(spectrum(echo[0], frequency))
    np.testing.assert_allclose(level, air / (2 * height), rtol=error)


def test_a_corner_answers_like_the_image_behind_its_edge():
    """Two bounces between plates at right angles: pressure k / (2 d) at twice the distance d."""
    material = Material((1e5,), (math.radians(30),), (1.0,), (0.5,), diffraction=None)
    one = plate([0.2, -0.5, -0.4], [0.21, 0.25, 0.4])
    two = plate([-0.5, 0.25, -0.4], [0.21, 0.26, 0.4])
    scene = Scene(trimesh.util.concatenate([one, two]), material)
    distance = math.hypot(0.2, 0.25)
    turned = rotation_from_euler(math.atan2(0.25, 0.2), 0.0, 0.0)
    echoes = [
        simulator(scene, ears=POINT_HEAD, simulation={"rays": 200_000, "bounces": bounces}).echo(
            np.zeros(3), turned, seed=1
        )[0]
        for bounces in (1, 2)
    ]
    frequency = np.array([40e3, 60e3])
    difference = echoes[1] - echoes[0]
    # The single bounces, at 0.2 and 0.25 m, came from patterns of different density.
    difference[: round(2 * 0.29 / 343e-6)] = 0.0
    double = np.abs(spectrum(difference, frequency))
    # Both orders of bounces meet at the edge, each lit from one side of it: the lobes leave 3 %.
    air = 10 ** (-air_absorption(frequency, relative_humidity=0.5) * 2 * distance / 20)
    np.testing.assert_allclose(double, 0.5 * air / (2 * distance), rtol=0.04)
    loudest = np.abs(difference).argmax()  # a pulse is some six samples, 1 mm, long
    assert loudest * 343e-6 / 2 == pytest.approx(distance, abs=1e-3)


def test_level_does_not_depend_on_the_number_of_rays():
    position = np.array([0.3, 0.2, 0.1])
    rotation = look_at(position, np.zeros(3))
    scene = load_scene("three_spheres")
    few, many = (
        simulator(scene, rays).spectrogram(position, rotation, seed=3) for rays in (30_000, 90_000)
    )
    assert few.max() == pytest.approx(many.max(), rel=5e-3)
    assert active_error(few, many) < 0.4  # what 30,000 rays scatter by, not 20 log10(3) = 9.5


def test_turning_scene_and_head_together_changes_nothing():
    mesh = load_scene("three_spheres").mesh
    position = np.array([0.3, 0.2, 0.1])
    rotation = look_at(position, np.array([0.02, 0.01, 0.0]))
    turn, shift = rotation_from_euler(1.0, 0.5, -0.3), np.array([1.0, -2.0, 0.5])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, shift
    moved = mesh.copy()
    moved.apply_transform(matrix)
    one = simulator(Scene(mesh)).spectrogram(position, rotation, seed=4)
    two = simulator(Scene(moved)).spectrogram(turn @ position + shift, turn @ rotation, seed=4)
    # The ball around the bounding box turns into a slightly different one.
    assert active_error(one, two) < 0.3
    quarter = rotation_from_euler(np.pi / 2, 0.0, 0.0)
    matrix[:3, :3] = quarter
    moved = mesh.copy()
    moved.apply_transform(matrix)
    two = simulator(Scene(moved)).spectrogram(
        quarter @ position + shift, quarter @ rotation, seed=4
    )
    # By a quarter turn the ball stays, and with it every ray.
    assert active_error(one, two) < 0.01


def test_the_mirrored_scene_exchanges_the_ears():
    mesh = load_scene("three_spheres").mesh
    mirrored = trimesh.Trimesh(mesh.vertices * [1, -1, 1], mesh.faces[:, ::-1])
    position = np.array([0.4, 0.0, 0.02])
    rotation = look_at(position, np.array([0.0, 0.0, 0.02]))
    one = simulator(Scene(mesh)).spectrogram(position, rotation, seed=5)
    two = simulator(Scene(mirrored)).spectrogram(position, rotation, seed=6)
    assert active_error(one, two[::-1]) < 0.3  # what so few rays scatter by
    assert active_error(one, two) > 1.0


def test_what_a_plate_hides_is_not_heard():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    ball.apply_translation([0.5, 0.0, 0.0])
    hidden = trimesh.util.concatenate([ball, plate([0.3, -0.3, -0.3], [0.31, 0.3, 0.3])])
    # Without edges: the plate's rim is heard as late as the ball.
    open_, shut = (
        simulator(Scene(mesh, PLAIN), simulation={"rays": 40_000, "bounces": 1})
        for mesh in (ball, hidden)
    )
    beyond = open_.head.range > 0.42
    assert open_.spectrogram(np.zeros(3), np.eye(3), seed=0)[:, beyond].max() > 0
    loud = shut.spectrogram(np.zeros(3), np.eye(3), seed=0)
    assert (
        loud[:, beyond].max() < 1e-3 * loud.max()
    )  # the tail of the plate; of the ball 40 times it


def test_an_ear_behind_a_plate_hears_next_to_nothing_though_the_other_does():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    ball.apply_translation([0.5, 0.0, 0.0])
    before_left_ear = plate([0.2, 0.06, -0.1], [0.21, 0.3, 0.1])
    scene = Scene(trimesh.util.concatenate([ball, before_left_ear]), WIDE)
    apart = {**POINT_HEAD, "left": [0.0, 0.2, 0.0]}
    found = simulator(scene, ears=apart, simulation={"rays": 40_000, "bounces": 1})
    left, right = found.spectrogram(np.zeros(3), np.eye(3), seed=0)
    beyond = found.head.range > 0.45  # the ball's echo comes from (0.47 + 0.51) / 2
    # 60 mm inside the shadow of the plate's edge: a knife edge leaves 0.12 at 20 kHz.
    assert left[beyond].max() < 0.13 * right[beyond].max()


def test_the_left_ear_hears_the_left_first():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.01)
    ball.apply_translation([0.3, 0.3, 0.0])
    found = simulator(Scene(ball))
    left, right = found.echo(np.zeros(3), np.eye(3), seed=0)
    late = [np.abs(e).argmax() for e in (left, right)]
    # Ears 20 mm apart across, sound from 45 degrees: 14 mm of path, 41 samples.
    assert late[1] - late[0] == pytest.approx(0.02 * math.sin(math.pi / 4) / 343e-6, rel=0.1)
    assert (left**2).sum() > 2 * (right**2).sum()


def test_out_of_range_is_silence():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    found = simulator(Scene(ball))
    assert found.spectrogram(np.array([2.0, 0, 0]), np.eye(3), seed=0).max() == 0.0


def test_seed_turns_the_pattern_and_nothing_else():
    found = simulator(load_scene("three_spheres"))
    position = np.array([0.0, 0.4, 0.0])
    pose = position, look_at(position, np.zeros(3))
    one, same, other = (found.spectrogram(*pose, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    assert active_error(one, other) < 0.3


def test_a_pickled_simulator_says_the_same():
    found = simulator(load_scene("sphere"), 5000)
    pose = np.array([0.0, 0.0, 0.4]), look_at([0.0, 0.0, 0.4], np.zeros(3))
    expected = found.spectrogram(*pose, seed=1)
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.spectrogram(*pose, seed=1), expected)


def test_axes_ears_and_speed_are_those_of_the_settings():
    found = simulator(load_scene("sphere"))
    assert found.head.speed_of_sound == 343.0
    assert (len(found.head.range), len(found.head.frequency)) == (875, 47)
    np.testing.assert_array_equal(found.head.gains.frequency, found.head.frequency)
    pose = np.array([0.4, 0, 0]), look_at([0.4, 0, 0], np.zeros(3))
    magnitude = found.spectrogram(*pose, seed=0)
    assert magnitude.shape == (2, 875, 47)
    assert magnitude.dtype == np.float32
    warm = simulator(load_scene("sphere"), air={"temperature_c": 40.0})
    assert warm.head.speed_of_sound == pytest.approx(354.7, abs=0.1)


@pytest.mark.parametrize("body", ["sphere", "three_spheres"])
def test_glints_are_those_of_physical_optics(body):
    scene = load_scene(body, {"radius": 0.0286} if body == "sphere" else {})
    case = Case.load(f"{body}_kirchhoff")
    rays = simulator(scene, simulation={"engine": "rays", "rays": 40_000, "bounces": 1})
    one, two = heard(rays, case)[0], case.spectrograms(rays.head)[0]
    # Kirchhoff's integral itself errs by up to 1 dB for ka above 12 and 2 dB below.
    for a, b in zip(one, two, strict=True):
        level = 20 * np.log10(a.max(axis=0) / b.max(axis=0))
        assert np.abs(level[rays.head.frequency > 40e3]).max() < 1.5
    loudest = one[0].max(axis=1).argmax(), two[0].max(axis=1).argmax()
    assert abs(loudest[0] - loudest[1]) <= 3  # rows of 0.7 mm


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "low", "high", "most"),
    [
        ("three_spheres", 10e3, 25e3, 0.2),
        ("three_spheres", 25e3, 41e3, 0.5),
        ("three_spheres", 41e3, 80e3, 0.5),
        ("balls", 10e3, 25e3, 0.3),
        ("balls", 25e3, 40e3, 0.5),
        ("leaf", 25e3, 40e3, 7.5),
    ],
)
def test_echoes_are_those_of_the_wave_equation(name, low, high, most):
    """Mean error over the cells within 20 dB of the loudest of their pose, dB."""
    small = name != "three_spheres"
    spectrogram = SMALL if small else {"frequency_max": 80e3}
    case, found = (
        Case.load(name),
        simulator(scene_of(name), 60_000, spectrogram=spectrogram, simulation={"sources": 1000}),
    )
    truth = case.spectrograms(found.head)
    magnitude = heard(found, case, band=banded if small else None)
    exact, level = (20 * np.log10(np.maximum(m, 1e-12)) for m in (truth, magnitude))
    cells = exact > exact.max(axis=(1, 2, 3), keepdims=True) - 20
    frequency = found.head.frequency
    cells &= (frequency >= low) & (frequency < high)
    assert np.abs(level - exact)[cells].mean() < most


def test_an_unknown_engine_is_refused():
    with pytest.raises(SettingsError, match=r"simulation\.engine.*hybrid.*rays"):
        simulator(load_scene("sphere"), simulation={"engine": "magic"})
    with pytest.raises(SettingsError, match=r"simulation\.engine.*bem was removed in version 0\.2"):
        simulator(load_scene("sphere"), simulation={"engine": "bem"})


def test_the_call_of_the_settings_is_what_is_emitted():
    scene, position = load_scene("sphere"), np.array([0.35, 0.0, 0.0])
    pose = position, look_at(position, np.zeros(3))
    impulse = simulator(scene, 5000, ears=POINT_HEAD)
    waveform, magnitude = impulse.receive(*pose, seed=1)
    np.testing.assert_array_equal(waveform, impulse.echo(*pose, seed=1)[:, : waveform.shape[1]])
    np.testing.assert_array_equal(magnitude.astype(np.float32), impulse.spectrogram(*pose, seed=1))
    call = {"kind": "hyperbolic", "duration": 1e-3, "frequency_start": 120e3}
    sweep = simulator(scene, 5000, ears=POINT_HEAD, call=call)
    swept, dechirped = sweep.receive(*pose, seed=1)
    expected = scipy.signal.fftconvolve(
        sweep.echo(*pose, seed=1), sweep.head.waveform[None], axes=1
    )
    np.testing.assert_allclose(swept, expected[:, : swept.shape[1]], atol=1e-9)
    # Dechirped, the sphere stands where the impulse shows it.
    rows = [m[0, :, 40].argmax() for m in (magnitude, dechirped)]
    assert abs(sweep.head.range[rows[1]] - impulse.head.range[rows[0]]) < 0.01


def test_the_noise_of_the_settings_is_drawn_from_the_poses_seed():
    scene, position = load_scene("sphere"), np.array([0.35, 0.0, 0.0])
    pose = position, look_at(position, np.zeros(3))
    sections = {"simulation": {"rays": 5000}, "noise": {"snr_db": 20.0, "relative_to": "pose"}}
    quiet, noisy = simulator(scene, 5000), simulator(scene, **sections)
    clean = quiet.receive(*pose, seed=1)[0]
    one, same, other = (noisy.receive(*pose, seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    np.testing.assert_array_equal(noisy.echo(*pose, seed=1), quiet.echo(*pose, seed=1))
    assert np.abs(one - clean).std() > 0.0
    assert (one - clean).std(axis=1).max() < 0.1 * np.abs(clean).max()


def test_hits_are_in_decibels_below_the_strongest():
    found = simulator(load_scene("sphere"), 5000)
    points, level = found.hits(np.array([0.4, 0.0, 0.0]), rotation_from_euler(np.pi, 0, 0))
    assert len(points) == len(level)
    assert level.max() == 0.0
    assert level.min() >= -200.0
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.015, atol=1e-5)


def test_settings_of_the_rays_go_through():
    wanted = {"rays": 1234, "bounces": 2}
    for engine in ("rays", "hybrid"):
        rays = simulator(load_scene("sphere"), simulation={"engine": engine, **wanted}).rays
        assert (rays.rays, rays.bounces) == (1234, 2)


@pytest.mark.parametrize(("highest", "lines"), [(100e3, 0), (150e3, 1)])
def test_a_band_above_the_resolved_frequency_is_told(highest, lines, caplog):
    band = {"frequency_max": highest, "frequency_min": 10e3}
    simulator(load_scene("sphere"), simulation={"engine": "rays"}, spectrogram=band)
    assert len([r for r in caplog.records if "up to 80000 Hz" in r.getMessage()]) == lines


def test_each_of_many_receivers_hears_as_it_does_alone():
    """Eight of them, 0.2 m apart; the pattern of rays differs with what they judge between them."""
    places = [(0.0, 0.03 * n - 0.105, 0.0) for n in range(8)]
    scene = Scene(trimesh.creation.icosphere(subdivisions=5, radius=0.02))
    pose = np.array([-0.4, 0.0, 0.0]), np.eye(3)
    common = {"directivity": "omnidirectional", "beam_radius": 0.0}
    together = simulator(scene, ears={"receivers": places, **common}).spectrogram(*pose, seed=0)
    assert together.shape[0] == 8
    for ear in (0, 5):
        alone = simulator(scene, ears={"receivers": [places[ear]], **common})
        assert active_error(alone.spectrogram(*pose, seed=0)[0], together[ear]) < 0.3


def test_noise_of_two_ears_is_of_two_receivers(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("azimuth_deg,elevation_deg,frequency_hz,gain,receiver\n0,0,5e4,1,0\n")
    scene = Scene(trimesh.creation.icosphere(radius=0.02))
    ears = {"directivity": "file", "file": str(path), "receivers": [(0.0, 0.0, 0.0)]}
    with pytest.raises(SettingsError, match=r"noise\.snr_db: gives 2 levels for 1 ears\.receivers"):
        simulator(scene, ears=ears, noise={"snr_db": (10.0, 20.0)})
    known = replace(pair(), gains=pair().gains[:1], places=np.zeros((1, 3)))
    write_sofa(tmp_path / "a.sofa", known)
    ears = {"directivity": "file", "file": str(tmp_path / "a.sofa")}
    with pytest.raises(SettingsError, match=r"snr_db: gives 2 levels, but .* holds 1 receiver"):
        simulator(scene, ears=ears, noise={"snr_db": (10.0, 20.0)})
