# SPDX-License-Identifier: MIT
import pickle
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.integrate import quad

from sononerf.geometry.poses import look_at, rotation_from_euler
from sononerf.head.decibels import compress
from sononerf.head.ears import Ears, beam_gain, ear_gain, ear_tables
from sononerf.head.spectrogram import echo_samples, spectrogram
from sononerf.scene.material import Material
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.schema import EarSettings, SpectrogramSettings
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.impulse_response import plan_synthesis
from sononerf.simulation.reference.kirchhoff import Kirchhoff
from tests.simulation.exact import SPEED, disc_on_axis, image_source, rigid_sphere
from tests.simulation.listening import TableHead

pytestmark = pytest.mark.thorough

ANALYSIS = SpectrogramSettings()
SYNTHESIS = plan_synthesis(ANALYSIS, echo_samples(ANALYSIS, SPEED))
NODES = SYNTHESIS.nodes
BAND = np.linspace(20e3, 100e3, 81)
LOW_BAND = np.linspace(25e3, 55e3, 31)


def hearing(emitter=(0.0, 0.0, 0.0), ears=((0.0, 0.0, 0.0),), head=None):
    """Points that send and hear alike in all directions, or a head, in air without loss."""
    if head is None:
        grid = (len(NODES), 3, 5)
        head = Ears(
            np.linspace(-np.pi, np.pi, 5),
            np.linspace(-np.pi / 2, np.pi / 2, 3),
            NODES,
            np.ones(grid, np.float32),
            np.ones((len(ears), *grid), np.float32),
            np.array(emitter, dtype=float),
            np.array(ears, dtype=float),
        )
    return Hearing(TableHead(head), SYNTHESIS)


def kirchhoff(mesh, head=None, material=None, **options):
    scene = mesh if isinstance(mesh, Scene) else Scene(mesh, material or Material())
    options = {"frequency_max": 110e3, **options}
    return Kirchhoff(scene, head or hearing(), **options)


def echoes(engine, position=(0.0, 0.0, 0.0), rotation=None):
    rotation = np.eye(3) if rotation is None else rotation
    return engine.echo(np.array(position, dtype=float), rotation, seed=0)


def spectrum(echo, frequency, until=np.inf):
    """Of what comes from ranges below ``until``, m."""
    time = np.arange(echo.shape[-1]) * 1e-6
    echo = np.where(time * SPEED / 2 < until, echo, 0.0)
    return echo @ np.exp(-2j * np.pi * time[:, None] * frequency)


def level_db(pressure):
    return 20.0 * np.log10(np.abs(pressure))


def sphere(radius, middle=(0.0, 0.0, 0.0)):
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    ball.apply_translation(middle)
    return ball


def wall(distance, lower, upper):
    """Two triangles square to x."""
    (y0, z0), (y1, z1) = lower, upper
    corners = [[distance, y, z] for y, z in ((y0, z0), (y1, z0), (y1, z1), (y0, z1))]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def disc(radius, distance):
    angle = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    rim = np.stack([0.0 * angle, radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    index = np.arange(len(angle))
    faces = np.stack([np.full(len(angle), len(angle)), index, np.roll(index, -1)], axis=1)
    corners = np.array([distance, 0.0, 0.0]) + np.vstack([rim, np.zeros(3)])
    return trimesh.Trimesh(corners, faces, process=False)


def active_error(a, b):
    reference = 1e-3 * b.max()
    a, b = compress(a, reference), compress(b, reference)
    return np.abs(a - b)[(a >= 3) | (b >= 3)].mean()


@pytest.mark.parametrize("angle", [0.0, 1.0, 3.0])
def test_the_series_keeps_the_air_at_the_rigid_sphere_at_rest(angle):
    """The boundary's condition, which the series' terms hold one by one, holds for their sum."""
    frequency, radius, source, step = np.array([5e3, 60e3, 100e3]), 0.0286, 0.3, 1e-7
    wavenumber = 2 * np.pi * frequency / SPEED

    def pressure(distance):
        way = np.sqrt(distance**2 + source**2 - 2 * distance * source * np.cos(angle))
        scattered = rigid_sphere(frequency, radius, source, distance, angle)
        return scattered + np.exp(-1j * wavenumber * way) / way

    slope = (pressure(radius + step) - pressure(radius - step)) / (2 * step)
    # What differences over 0.1 um leave.
    assert np.abs(slope / wavenumber).max() < 1e-6 * np.abs(pressure(radius)).max()


def test_the_series_has_rayleighs_limit():
    """Far and small: (k^2 a^3 / 3) (1 + 3/2) / r^2 straight back (Lord Rayleigh, 1872)."""
    wavenumber = 2 * np.pi * 1e3 / SPEED
    (found,) = np.abs(rigid_sphere(1e3, 1e-3, 20.0, 20.0))
    # 1 / kr, 0.3 %, is squared.
    assert found == pytest.approx(5 / 6 * wavenumber**2 * 1e-9 / 400, rel=1e-3)


def test_the_closed_form_of_the_disc_is_its_integral():
    wavenumber, distance, rim = 2 * np.pi * 60e3 / SPEED, 0.3, np.hypot(0.3, 0.03)
    real, imaginary = (
        quad(lambda r, p=part: p(np.exp(-2j * wavenumber * r)) / r**2, distance, rim)[0]
        for part in (np.real, np.imag)
    )
    expected = 1j * wavenumber * distance * (real + 1j * imaginary)
    np.testing.assert_allclose(disc_on_axis(60e3, 0.03, distance), expected, rtol=1e-9)


@pytest.mark.parametrize("distance", [0.3, 0.45])
@pytest.mark.parametrize("radius", [0.015, 0.0286])
def test_a_sphere_answers_like_the_exact_series(radius, distance):
    size = np.linspace(5.0, min(50.0, 2 * np.pi * 100e3 * radius / SPEED), 200)  # ka
    frequency = size * SPEED / (2 * np.pi * radius)
    (echo,) = echoes(kirchhoff(sphere(radius)), [distance, 0.0, 0.0])
    ratio = spectrum(echo, frequency) / rigid_sphere(frequency, radius, distance, distance)
    error = level_db(ratio)
    assert np.abs(error[size >= 12]).max() < 1.0
    assert np.sqrt((error[size >= 12] ** 2).mean()) < 0.25
    # Here physical optics itself is off by up to 2 dB.
    assert np.sqrt((error[size < 12] ** 2).mean()) < 0.8
    assert np.abs(error).max() < 2.0
    # The ripple is what creeps round the sphere, later; the glint's delay is in the mean phase
    # and in its slope.
    large = size >= 12
    phase, wavenumber = np.angle(ratio[large]), 2 * np.pi * frequency[large] / SPEED
    assert abs(np.mean(phase / wavenumber)) / 2 < 5e-5
    assert abs(np.polyfit(wavenumber, phase, 1)[0]) / 2 < 1e-4  # m of range


def test_an_ear_apart_from_the_emitter_hears_the_exact_series_too():
    """Emitter and ear 60 mm apart, as seen from the sphere 11 degrees."""
    head = hearing((0.0, 0.03, 0.0), ((0.0, -0.03, 0.0), (0.02, -0.03, 0.0)))
    found = echoes(kirchhoff(sphere(0.0286, (0.3, 0.0, 0.0)), head))
    frequency = np.linspace(25e3, 95e3, 141)
    for echo, ear in zip(found, head.ears.positions, strict=True):
        source, listener = head.ears.emitter - [0.3, 0.0, 0.0], ear - [0.3, 0.0, 0.0]
        lengths = np.linalg.norm(source), np.linalg.norm(listener)
        angle = np.arccos(source @ listener / np.prod(lengths))
        exact = rigid_sphere(frequency, 0.0286, *lengths, angle)
        ratio = spectrum(echo, frequency) / exact
        assert np.abs(level_db(ratio)).max() < 1.0
        assert abs(np.angle(ratio).mean()) < 0.1


def test_a_wall_is_a_mirror():
    """Image source, before the rim is heard from 0.4 m."""
    plate = wall(0.3, (-0.27, -0.3), (0.31, 0.28))
    (echo,) = echoes(kirchhoff(plate, frequency_max=60e3))
    found, expected = spectrum(echo, LOW_BAND, 0.38), image_source(LOW_BAND, 0.3)
    # Terms of 1 / kh, up to 0.7 % and square to the rest, are left out; laying echoes into bins
    # takes or adds up to 0.1 %; the gate ripples by 0.5 %.
    np.testing.assert_allclose(np.abs(found), np.abs(expected), rtol=0.007)
    np.testing.assert_allclose(found, expected, rtol=0.012)


@pytest.mark.parametrize("radius", [0.015, 0.03])
def test_a_disc_answers_on_its_axis_like_the_closed_form(radius):
    (echo,) = echoes(kirchhoff(disc(radius, 0.3)))
    expected = disc_on_axis(BAND, radius, 0.3)
    # Pieces at the rim are flat in phase; 0.3 % comes of laying echoes into bins.
    error = np.abs(spectrum(echo, BAND) - expected)
    assert error.max() < 0.005 * np.abs(expected).max()


def test_exchanging_emitter_and_ear_changes_nothing():
    """Reciprocity (Lord Rayleigh, Theory of Sound, section 294), with shadows in play."""
    head = hearing((0.0, 0.05, 0.02), ((-0.03, -0.06, 0.0),))
    back = hearing((-0.03, -0.06, 0.0), ((0.0, 0.05, 0.02),))
    scene = load_scene("three_spheres")
    position = np.array([0.05, 0.05, 0.3])
    rotation = look_at(position, np.zeros(3))
    one, two = (echoes(kirchhoff(scene, way), position, rotation) for way in (head, back))
    # Gains are in single precision.
    np.testing.assert_allclose(one, two, atol=1e-6 * np.abs(one).max())


def test_turning_scene_and_head_together_changes_nothing():
    head = hearing(head=ear_tables(EarSettings(), NODES))
    position = np.array([0.3, 0.2, 0.1])
    rotation = look_at(position, np.array([0.02, 0.01, 0.0]))
    turn, shift = rotation_from_euler(1.0, 0.5, -0.3), np.array([1.0, -2.0, 0.5])
    mesh = load_scene("three_spheres").mesh
    moved = trimesh.Trimesh(mesh.vertices @ turn.T + shift, mesh.faces, process=False)
    one = echoes(kirchhoff(mesh, head), position, rotation)
    two = echoes(kirchhoff(moved, head), turn @ position + shift, turn @ rotation)
    # Rounding decides which of two equal edges is cut, and what a border hides.
    np.testing.assert_allclose(one, two, atol=2e-3 * np.abs(one).max())
    assert np.abs(one[0] - two[1]).max() > 0.1 * np.abs(one).max()


@pytest.mark.slow
def test_finer_pieces_say_the_same():
    coarse, fine = (
        echoes(kirchhoff(sphere(0.0286), elements_per_wavelength=parts), [0.3, 0.0, 0.0])[0]
        for parts in (4.0, 8.0)
    )
    assert np.abs(level_db(spectrum(coarse, BAND) / spectrum(fine, BAND))).max() < 0.1
    position = np.array([0.28, 0.28, 0.05])
    coarse, fine = (
        spectrogram(
            echoes(
                kirchhoff(load_scene("three_spheres"), elements_per_wavelength=parts),
                position,
                look_at(position, np.zeros(3)),
            ),
            ANALYSIS,
            SPEED,
        )
        for parts in (4.0, 8.0)
    )
    assert active_error(coarse, fine) < 0.1


def test_the_mesh_does_not_matter_where_it_is_flat():
    """A slanting wall of two triangles, and of 2048: only its rim is heard."""
    slanting = wall(0.3, (-0.05, -0.04), (0.06, 0.05))
    slanting.apply_transform(trimesh.transformations.rotation_matrix(0.5, [0, 0, 1], [0.3, 0, 0]))
    fine = slanting.copy()
    for _ in range(5):
        fine = fine.subdivide()
    one, two = (
        echoes(kirchhoff(mesh, elements_per_wavelength=6.0))[0] for mesh in (slanting, fine)
    )
    one, two = spectrum(one, BAND), spectrum(two, BAND)
    assert np.abs(one - two).max() < 0.01 * np.abs(two).max()


def test_pieces_are_fine_where_the_surface_runs_along_the_sound():
    across = wall(0.3, (-0.02, -0.02), (0.02, 0.02))
    along = trimesh.Trimesh(across.vertices[:, [1, 2, 0]] + [0.3, 0, -0.29], across.faces)
    engines = [kirchhoff(mesh) for mesh in (across, along)]
    counts = [len(engine.hits(np.zeros(3), np.eye(3), seed=0)[0]) for engine in engines]
    size = engines[0].wavelength
    assert 2 * (0.04 / size) ** 2 <= counts[0] < 8 * (0.04 / size) ** 2
    # The way varies by 80 mm, 26 wavelengths.
    assert counts[1] > 4 * counts[0]


def test_what_a_plate_hides_is_not_heard():
    ball = sphere(0.03, (0.5, 0.0, 0.0))
    plate = wall(0.3, (-0.06, -0.06), (0.06, 0.06))
    heard, hidden, alone = (
        echoes(kirchhoff(mesh))[0]
        for mesh in (ball, trimesh.util.concatenate([ball, plate]), plate)
    )
    np.testing.assert_array_equal(hidden, alone)
    assert np.abs(heard).max() > 0.02 * np.abs(alone).max()


@pytest.mark.slow
def test_each_ear_sees_for_itself():
    """Before the left ear, at y = 0.2, stands a plate; the emitter sees past it."""
    ball = sphere(0.03, (0.5, 0.0, 0.0))
    before_left_ear = wall(0.2, (0.06, -0.1), (0.3, 0.1))
    head = hearing(ears=((0.0, 0.2, 0.0), (0.0, -0.2, 0.0)))
    both = trimesh.util.concatenate([ball, before_left_ear])
    found, plate, free = (echoes(kirchhoff(m, head)) for m in (both, before_left_ear, ball))
    left, right = found - plate
    loudest = np.abs(free).max()
    np.testing.assert_allclose(right, free[1], atol=1e-3 * loudest)
    assert np.abs(left).max() < 1e-3 * loudest


def test_a_wall_lit_by_half_answers_by_half():
    """A screen whose edge crosses the axis hides half of all Fresnel zones; its middle counts."""
    lit, screen = wall(0.3, (-0.27, -0.3), (0.31, 0.28)), wall(0.15, (0.0, -0.2), (0.2, 0.2))
    both = trimesh.util.concatenate([lit, screen])
    # The screen's own far rim sounds as late as the wall.
    found, alone = (echoes(kirchhoff(mesh, frequency_max=60e3))[0] for mesh in (both, screen))
    half = np.abs(spectrum(found - alone, LOW_BAND, 0.38))
    np.testing.assert_allclose(half, np.abs(image_source(LOW_BAND, 0.3)) / 2, rtol=0.01)


def test_a_sheet_is_the_same_from_both_sides():
    one = wall(0.3, (-0.05, -0.06), (0.04, 0.05))
    two = trimesh.Trimesh(one.vertices, one.faces[:, ::-1], process=False)
    np.testing.assert_allclose(echoes(kirchhoff(one)), echoes(kirchhoff(two)), atol=1e-6)


def test_level_follows_the_strength_of_each_part():
    """One plate before the other, twice as far: gated apart, each by its own material."""
    near, far = wall(0.25, (-0.05, -0.05), (0.05, 0.05)), wall(0.5, (-0.15, -0.15), (0.15, 0.15))
    mesh = trimesh.util.concatenate([near, far])
    materials = (
        replace(Material(), frequency=(20e3, 80e3), strength=(0.2, 0.6)),
        replace(Material(), strength=(0.5, 0.5)),
    )
    frequency = np.array([20e3, 40e3, 80e3, 95e3])
    plain = echoes(kirchhoff(mesh))[0]
    mixed = echoes(kirchhoff(Scene(mesh, materials, np.array([0, 0, 1, 1]))))[0]
    first = spectrum(mixed, frequency, 0.4) / spectrum(plain, frequency, 0.4)
    expected = np.interp(np.log(frequency), np.log([20e3, 80e3]), [0.2, 0.6])
    # The strength has a bend at both ends, which the nodes' interpolation rounds off.
    np.testing.assert_allclose(first, expected, atol=7e-3)
    last = spectrum(mixed[2332:], frequency) / spectrum(plain[2332:], frequency)
    np.testing.assert_allclose(last, 0.5, atol=1e-3)


def test_hits_show_the_glint():
    scene = trimesh.util.concatenate([sphere(0.03, (0.3, 0.0, 0.0)), sphere(0.02, (0.4, 0, 0))])
    points, strength = kirchhoff(scene).hits(np.zeros(3), np.eye(3), seed=0)
    assert points.shape == (len(strength), 3)
    assert points[:, 0].max() < 0.3  # neither backs nor what is hidden
    best = points[strength.argmax()]
    np.testing.assert_allclose(best, [0.27, 0.0, 0.0], atol=2e-3)
    off = np.degrees(np.arccos((0.3 - points[:, 0]) / 0.03))
    assert strength[off > 45].max() < 0.1 * strength.max()
    assert strength[off < 5].min() > 0.7 * strength.max()


def test_nothing_in_reach_is_silence():
    assert np.abs(echoes(kirchhoff(sphere(0.03)), [2.0, 0.0, 0.0])).max() == 0.0
    edgewise = trimesh.Trimesh([[0.3, 0, 0], [0.4, 0, 0], [0.4, 0.1, 0]], [[0, 1, 2]])
    assert np.abs(echoes(kirchhoff(edgewise))).max() == 0.0
    points, strength = kirchhoff(edgewise).hits(np.zeros(3), np.eye(3), seed=0)
    assert (points.shape, strength.shape) == ((0, 3), (0,))


def test_a_triangle_without_area_is_passed_over():
    plate = wall(0.3, (-0.05, -0.06), (0.04, 0.05))
    faces = np.vstack([plate.faces, [[0, 1, 1]]])
    odd = trimesh.Trimesh(plate.vertices, faces, process=False)
    np.testing.assert_allclose(echoes(kirchhoff(odd)), echoes(kirchhoff(plate)), atol=1e-12)


def test_a_pickled_engine_says_the_same():
    engine = kirchhoff(sphere(0.015, (0.3, 0.0, 0.0)))
    expected = echoes(engine)
    sent = pickle.dumps(engine)
    np.testing.assert_array_equal(echoes(pickle.loads(sent)), expected)


def test_beam_and_ears_weigh_what_comes_from_a_direction():
    """A small plate up to the left: the level of points, times beam and ear towards it."""
    wanted = EarSettings(emitter=(0.0, 0.0, 0.0), left=(0.0, 0.0, 0.0))
    head = ear_tables(wanted, NODES)
    towards = np.array([[0.3, 0.12, 0.08]])
    plate = wall(0.0, (-0.003, -0.003), (0.003, 0.003))
    plate.vertices = plate.vertices @ look_at(towards[0], np.zeros(3)).T + towards
    engine, plain = kirchhoff(plate, hearing(head=head)), kirchhoff(plate)
    towards /= np.linalg.norm(towards)
    frequency = NODES[2:9]
    expected = beam_gain(head, towards)[0, 2:9]
    point = spectrum(echoes(plain)[0], frequency)
    for ear, echo in enumerate(echoes(engine)):
        found = np.abs(spectrum(echo, frequency) / point)
        # Over the plate, 1 degree wide, gains change little.
        np.testing.assert_allclose(
            found, expected * ear_gain(head, ear, towards)[0, 2:9], rtol=0.02
        )
