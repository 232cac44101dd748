# SPDX-License-Identifier: MIT
import logging
import pickle

import numpy as np
import pytest
import trimesh
from scipy.linalg import solve
from scipy.special import eval_legendre, spherical_jn, spherical_yn

from sononerf.errors import InputError, ResourceError
from sononerf.geometry.poses import look_at
from sononerf.head.ears import Ears
from sononerf.run.build import simulator_of
from sononerf.scene.material import MATERIALS, RIGID
from sononerf.scene.scene import Scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation.reference import boundary
from sononerf.simulation.reference.boundary import Boundary, excitation, radiated
from sononerf.simulation.reference.boundary_mesh import halved
from sononerf.simulation.reference.boundary_near import Panels
from sononerf.simulation.reference.boundary_operators import Operators
from sononerf.simulation.solved import Heads
from tests.simulation.exact import SPEED, disc_on_axis, rigid_sphere
from tests.simulation.listening import ball, box, echoes, hearing, level_db, spectrum, wall

pytestmark = pytest.mark.thorough

RADIUS = 0.02


def gains(frequency, ears=1):
    grid = (len(frequency), 3, 5)
    return Ears(
        np.linspace(-np.pi, np.pi, 5),
        np.linspace(-np.pi / 2, np.pi / 2, 3),
        frequency,
        np.ones(grid, np.float32),
        np.ones((ears, *grid), np.float32),
        np.zeros(3),
        np.zeros((ears, 3)),
    )


def engine(mesh, head=None, material=RIGID, **options):
    scene = mesh if isinstance(mesh, Scene) else Scene(mesh, material)
    options = {"frequency_max": 30e3, **options}
    return Boundary(scene, head or hearing(), **options)


def operators(mesh):
    return Operators(Panels.of(mesh.vertices, mesh.faces))


def round_ball(subdivisions):
    """A polyhedron with the volume of the sphere."""
    mesh = ball(RADIUS, subdivisions=subdivisions)
    mesh.apply_scale(np.cbrt(4 / 3 * np.pi * RADIUS**3 / mesh.volume))
    return mesh


def solved(found, wavenumber, source):
    """Pressure at the vertices (V,) for a point source."""
    one = np.ones((1, len(found.panels.points)))
    load = excitation(found.panels, wavenumber, np.array([source]), one)
    return solve(found.matrix(wavenumber), load.astype(np.complex64))[:, 0]


def heard(found, wavenumber, source, ear):
    pressure = found.panels.halves @ solved(found, wavenumber, source)
    return radiated(found.panels, wavenumber, pressure[None], np.array([ear]))[0]


def on_the_sphere(wavenumber, distance, cosine):
    """Pressure on a rigid sphere: the series' sum of both waves, by the Wronskian (10.50.1)."""
    x = wavenumber * RADIUS
    n = np.arange(int(x + 8 * np.cbrt(x)) + 12)[:, None]
    arriving = spherical_jn(n, wavenumber * distance) - 1j * spherical_yn(n, wavenumber * distance)
    rise = spherical_jn(n, x, True) - 1j * spherical_yn(n, x, True)
    terms = (2 * n + 1) * arriving / rise * eval_legendre(n, cosine)
    return -wavenumber * terms.sum(axis=0) / x**2


BALL = operators(round_ball(3))


# Where Neumann's and Dirichlet's problems inside have solutions: the plain equation fails there.
@pytest.mark.parametrize("ka", [0.5, np.pi, 4.4934, 2.0816, 7.0])
def test_a_rigid_sphere_has_the_pressure_and_the_echoes_of_the_series(ka):
    wavenumber, distance = ka / RADIUS, 0.3
    source = np.array([distance, 0.0, 0.0])
    found = solved(BALL, wavenumber, source)
    vertices = BALL.panels.vertices
    cosine = vertices[:, 0] / np.linalg.norm(vertices, axis=1)
    exact = on_the_sphere(wavenumber, distance, cosine)
    # Linear pressure on triangles with edges of 1/6 wavelength, at the highest ka.
    assert np.linalg.norm(found - exact) < 0.07 * np.linalg.norm(exact)
    frequency = wavenumber * SPEED / (2 * np.pi)
    angles = np.array([0.0, 1.0, 2.5, np.pi])
    ears = distance * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    echo = np.array([heard(BALL, wavenumber, source, ear) for ear in ears])
    series = [rigid_sphere(frequency, RADIUS, distance, distance, angle)[0] for angle in angles]
    assert np.abs(echo - series).max() < 0.01 * np.abs(series).max()
    assert abs(echo[0] - series[0]) < 0.01 * abs(series[0])


def test_the_echo_converges_with_the_size_of_the_elements():
    wavenumber, source = 3.0 / RADIUS, np.array([0.3, 0.0, 0.0])
    (exact,) = rigid_sphere(wavenumber * SPEED / (2 * np.pi), RADIUS, 0.3, 0.3)
    errors = [
        abs(heard(operators(round_ball(level)), wavenumber, source, source) - exact) / abs(exact)
        for level in (1, 2, 3)
    ]
    # Second order at least; each level halves the edges.
    assert errors[1] < errors[0] / 3.5
    assert errors[2] < errors[1] / 3.5
    assert errors[2] < 2e-3


@pytest.mark.parametrize("wavenumber", [150.0, 400.0, 400.0 - 0.3j])
def test_source_and_ear_may_be_exchanged(wavenumber):
    found = operators(halved(box((-0.015, -0.01, -0.002), (0.01, 0.012, 0.004)), 0.003))
    one, other = np.array([0.2, 0.05, 0.0]), np.array([-0.05, 0.15, 0.1])
    forth = heard(found, wavenumber, one, other)
    assert abs(heard(found, wavenumber, other, one) - forth) < 0.02 * abs(forth)


def thin_disc(radius, thickness, edge):
    mesh = trimesh.creation.cylinder(radius=radius, height=thickness, sections=48)
    mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], [1, 0, 0]))
    return halved(mesh, edge)


@pytest.mark.slow
def test_a_thin_disc_has_its_limit_at_low_frequency():
    """The added mass of a disc is 8/3 a^3 times the density (H. Lamb, 1932, section 102).

    A fixed body adds its own volume to that, and a monopole for the compression that it prevents
    (Lord Rayleigh, 1872).
    """
    radius, thickness, distance, wavenumber = 0.02, 3e-4, 2.0, 5.0
    found = operators(thin_disc(radius, thickness, 0.0025))
    place = np.array([distance, 0.0, 0.0])
    volume = np.pi * radius**2 * thickness
    wave = np.exp(-1j * wavenumber * distance) / distance
    dipole = (1j * wavenumber + 1 / distance) * wave
    exact = (8 / 3 * radius**3 + volume) * dipole**2 - volume * (wavenumber * wave) ** 2
    exact /= 4 * np.pi
    echo = heard(found, wavenumber, place, place)
    # At the rim pressure rises as a root, which linear elements of an eighth of the radius miss.
    assert abs(echo - exact) < 0.03 * abs(exact)


@pytest.mark.slow
def test_a_thin_disc_reflects_as_physical_optics_says_at_high_frequency():
    radius, distance = 0.02, 0.3
    found = operators(thin_disc(radius, 3e-4, 0.0027))
    for frequency in (20e3, 30e3):
        place = np.array([distance + 1.5e-4, 0.0, 0.0])
        echo = heard(found, 2 * np.pi * frequency / SPEED, place, place)
        (optics,) = disc_on_axis(frequency, radius, distance)
        # ka is 7 and 11; diffraction at the rim is some 1 / ka.
        assert abs(echo - optics) < 0.15 * abs(optics)


@pytest.mark.slow
def test_the_engine_hears_a_sphere_as_the_series_does():
    head = hearing(ears=((0.0, 0.02, 0.0), (0.0, -0.02, 0.0)))
    one = Boundary(
        Scene(round_ball(4), RIGID),
        head,
        frequency_max=20e3,
    )
    position = np.array([0.3, 0.0, 0.0])
    found = echoes(one, position, look_at(position, np.zeros(3)))
    band = np.linspace(5e3, 17e3, 25)
    angle = np.arctan2(0.02, 0.3)
    exact = rigid_sphere(band, RADIUS, 0.3, np.hypot(0.3, 0.02), angle)
    for ear in found:
        assert np.abs(level_db(spectrum(ear, band)) - level_db(exact)).max() < 0.2
    again = pickle.loads(pickle.dumps(one))
    np.testing.assert_array_equal(echoes(again, position, look_at(position, np.zeros(3))), found)


@pytest.mark.slow  # nine seconds
def test_meshes_are_coarser_at_lower_frequencies():
    one = engine(round_ball(4), frequency_max=40e3)
    counts = [
        len(one._operators(2 * np.pi * frequency / SPEED).panels.vertices)
        for frequency in (40e3, 21e3, 1e3)
    ]
    assert counts[0] > 1.5 * counts[1] > 2 * counts[2] > 2 * 0.5 * boundary.FEWEST
    assert one.unknowns == counts[0]


def test_what_cannot_be_solved_is_refused():
    with pytest.raises(InputError, match="needs closed bodies"):
        engine(wall(0.3, (-0.1, -0.1), (0.1, 0.1)))
    close = trimesh.util.concatenate([ball(0.02, subdivisions=3), ball(0.02, (0.03, 0, 0), 3)])
    with pytest.raises(InputError, match="lie apart"):
        engine(close, frequency_max=10e3)


def test_too_many_unknowns_are_refused_with_the_band_that_would_do(monkeypatch):
    monkeypatch.setattr(boundary, "available_memory", lambda: 20e6)
    with pytest.raises(ResourceError, match=r"unknowns up to 60 kHz .*up to (\d+) kHz") as caught:
        engine(ball(RADIUS, subdivisions=3), frequency_max=60e3)
    able = float(str(caught.value).rpartition("=")[2])
    assert 20e3 < able < 60e3
    engine(ball(RADIUS, subdivisions=3), frequency_max=0.9 * able)


def test_roughness_and_lobes_are_said_to_be_left_out(caplog):
    caplog.set_level(logging.WARNING, "sononerf")
    engine(ball(RADIUS, subdivisions=2), frequency_max=5e3)
    assert not caplog.records
    engine(ball(RADIUS, subdivisions=2), material=MATERIALS["leaf"], frequency_max=5e3)
    assert "takes surfaces as smooth and rigid" in caplog.text


def test_settings_choose_the_engine():
    settings = validate_settings(
        {"scene": {"name": "sphere"}, "simulation": {"engine": "bem", "frequency_max": 8e3}}, "here"
    )
    one = simulator_of(Scene(ball(RADIUS, subdivisions=2), RIGID), settings)
    assert isinstance(one.engine, Boundary)
    assert one.engine.frequency_max == 8e3


@pytest.mark.slow
def test_three_spheres_sound_as_by_partial_waves():
    """At most half a decibel over the cells within 30 dB of the loudest, up to 40 kHz."""
    places = ((0.01, (0, 0, 0)), (0.008, (0.022, 0.004, 0)), (0.006, (0.006, 0.02, 0.01)))
    scene = Scene(trimesh.util.concatenate([ball(*place) for place in places]), RIGID)
    levels = []
    for name in ("spheres", "bem"):
        data = {
            "scene": {"name": "sphere"},
            "simulation": {"engine": name, "frequency_max": 48e3},
            "spectrogram": {"frequency_max": 40e3, "range_max": 0.6},
        }
        simulator = simulator_of(scene, validate_settings(data, "here"))
        positions = 0.35 * np.array([[1.0, 0.0, 0.0], [0.0, 0.8, 0.6], [-0.6, 0.0, -0.8]])
        rotations = np.stack([look_at(position, np.zeros(3)) for position in positions])
        simulator.engine.prepare(positions, rotations)
        heard = [
            simulator.spectrogram(*pose, seed=0) for pose in zip(positions, rotations, strict=True)
        ]
        levels.append(level_db(np.maximum(np.stack(heard), 1e-12)))  # silence before echoes
    exact, found = levels
    cells = exact > exact.max(axis=(1, 2, 3), keepdims=True) - 30.0
    cells &= simulator.head.frequency >= 10e3
    assert np.abs(found - exact)[cells].mean() < 0.25


def test_the_engine_solves_as_the_equation_says_and_weighs_by_beam_and_ear():
    body = box((-0.015, -0.01, -0.002), (0.01, 0.012, 0.004))
    one, wavenumber = engine(body, frequency_max=20e3), 2 * np.pi * 18e3 / SPEED
    source, ear = np.array([0.2, 0.05, 0.0]), np.array([0.1, 0.15, 0.1])
    tables = gains(np.array([18e3]))
    tables.beam[:] = 3.0
    tables.ears[:] = 0.5
    heads = Heads(source[None], ear[None, None], np.eye(3)[None], np.eye(3)[None], tables)
    expected = 1.5 * heard(one._operators(wavenumber), wavenumber, source, ear)
    found = one.respond(wavenumber, heads)
    assert abs(found[0, 0] - expected) < 1e-4 * abs(expected)
