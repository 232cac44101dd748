# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh
from scipy.special import sph_harm_y, spherical_jn, spherical_yn

from sononerf.errors import InputError, NumericalError
from sononerf.run.build import simulator_of
from sononerf.scene.material import MATERIALS, RIGID
from sononerf.scene.scene import Scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation.reference import spheres as spheres_module
from sononerf.simulation.reference.partial_waves import harmonics, log_outgoing, wigner
from sononerf.simulation.reference.spheres import find_balls
from sononerf.simulation.solved import Heads
from tests.simulation.exact import SPEED, rigid_sphere
from tests.simulation.listening import ball, level_db

pytestmark = pytest.mark.thorough

POINT_HEAD = {
    "emitter": [0, 0, 0], "left": [0, 0, 0], "beam_radius": 0, "azimuth_deg": 0,
    "elevation_deg": 0, "width_deg": 180, "notch_depth": 0,
}  # fmt: skip
SOURCE = np.array([0.3, 0.1, -0.05])


class Everywhere(Heads):
    """Heads that send and hear alike in all directions."""

    def __getitem__(self, some):
        places, turns = (self.emitters[some], self.ears[some]), self.rotations[some]
        return type(self)(*places, turns, self.emitting[some], self.gains)

    def beam(self, points):
        return np.ones((len(self), len(points)))

    def gain(self, ear, points):
        return np.ones((len(self), len(points)))


def spheres(*bodies, frequency_max=100e3):
    """Engine for spheres given as (radius, centre)."""
    mesh = trimesh.util.concatenate([ball(*body, subdivisions=3) for body in bodies])
    wanted = {"engine": "spheres", "frequency_max": frequency_max}
    sections = {"scene": {"name": "t"}, "simulation": wanted, "ears": POINT_HEAD}
    analysis = {"frequency_max": 80e3}
    settings = validate_settings({**sections, "spectrogram": analysis}, "test")
    return simulator_of(Scene(mesh), settings).engine


def heard(engine, frequency, emitter, ear):
    """Pressure at one ear of heads without a pattern, in air without loss."""
    poses = Everywhere(np.array([emitter]), np.array([[ear]]), *[np.eye(3)[None]] * 2, None)
    return engine.respond(complex(2 * np.pi * frequency / SPEED), poses)[0, 0]


@pytest.mark.parametrize("frequency", [500.0, 5e3, 40e3, 120e3])
def test_one_sphere_answers_like_the_exact_series(frequency):
    centre, ear = np.array([0.01, 0.02, -0.03]), np.array([0.2, 0.2, 0.1])
    engine = spheres((0.015, centre))
    found = heard(engine, frequency, SOURCE, ear)
    to, back = SOURCE - centre, ear - centre
    lengths = np.linalg.norm(to), np.linalg.norm(back)
    angle = np.arccos(to @ back / np.prod(lengths))
    expected = rigid_sphere(frequency, engine.balls[0].radius, *lengths, angle)[0]
    assert abs(level_db(found / expected)) < 0.02
    assert abs(np.angle(found / expected)) < 1e-3


CLOSE_PAIR = ((0.01, (0.0, 0.0, 0.0)), (0.01, (0.001, 0.0205, 0.0)))
TRIPLE = ((0.015, (0.0, 0.0, 0.0)), (0.010, (0.002, 0.028, 0.0)), (0.020, (0.03, -0.02, 0.02)))


def emission(wavenumber, points):
    way = np.linalg.norm(points - SOURCE, axis=1)
    return np.exp(-1j * wavenumber * way) / way


def directions(count, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


@pytest.mark.parametrize("bodies", [CLOSE_PAIR, TRIPLE], ids=["pair", "triple"])
@pytest.mark.parametrize("frequency", [10e3, 70e3])
def test_air_at_each_sphere_is_at_rest(bodies, frequency):
    """Normal velocity over that of the loudest plane wave, with air that absorbs."""
    engine, step = spheres(*bodies), 1e-6
    wavenumber = complex(2 * np.pi * frequency / SPEED, -0.3)

    def pressure(points):
        return emission(wavenumber, points) + engine.field(wavenumber, SOURCE, points)

    for body in engine.balls:
        out = directions(100)
        points = body.centre + (1 + 1e-9) * body.radius * out
        near, middle, far = (pressure(points + n * step * out) for n in range(3))
        slope = (-1.5 * near + 2.0 * middle - 0.5 * far) / step
        assert np.abs(slope / wavenumber).max() < 1e-3 * np.abs(near).max()


def test_exchanging_emitter_and_ear_changes_nothing():
    engine, ear = spheres(*TRIPLE), np.array([-0.1, 0.05, 0.2])
    for frequency in (2e3, 30e3, 80e3):
        one, two = heard(engine, frequency, SOURCE, ear), heard(engine, frequency, ear, SOURCE)
        assert abs(one - two) < 1e-3 * abs(one)


@pytest.mark.slow
def test_no_sound_is_lost():
    """Power through a sphere around rigid ones, without absorption: as much in as out."""
    engine, radius, step = spheres(*TRIPLE), 0.08, 1e-6
    wavenumber = 2 * np.pi * 25e3 / SPEED
    node, weight = np.polynomial.legendre.leggauss(40)
    angle = np.arange(80) * np.pi / 40
    level = np.sqrt(1 - node**2)[:, None]
    out = np.stack(
        np.broadcast_arrays(level * np.cos(angle), level * np.sin(angle), node[:, None]), axis=-1
    ).reshape(-1, 3)

    def power(pressure):
        at = [pressure((radius + n * step) * out) for n in (-1, 0, 1)]
        flow = (at[1].conj() * (at[2] - at[0]) / (2 * step * wavenumber)).imag
        return float((flow.reshape(40, 80) * weight[:, None]).sum())

    def scattered(points):
        return engine.field(complex(wavenumber), SOURCE, points)

    total = power(lambda points: emission(wavenumber, points) + scattered(points))
    assert power(scattered) < 0  # outwards the phase falls
    assert abs(total) < 1e-3 * abs(power(scattered))


def test_spheres_far_apart_are_heard_as_each_alone():
    bodies = (0.015, (0.0, 0.0, 0.0)), (0.01, (0.0, 1.5, 0.0))
    ear = np.array([0.25, 0.1, 0.1])
    both = spheres(*bodies)
    alone = sum(heard(spheres(body), 30e3, SOURCE, ear) for body in bodies)
    # What one sends to the other is a / 2 d of it, 0.5 %.
    assert abs(heard(both, 30e3, SOURCE, ear) / alone - 1) < 0.01
    both.orders = 1
    assert abs(heard(both, 30e3, SOURCE, ear) / alone - 1) < 1e-4


def test_orders_of_scattering_add_up_to_the_solution():
    engine, ear = spheres(*TRIPLE), np.array([0.25, 0.1, 0.1])
    whole = heard(engine, 30e3, SOURCE, ear)
    errors = []
    for engine.orders in (1, 2, 4, 12):
        errors.append(abs(heard(engine, 30e3, SOURCE, ear) / whole - 1))
    assert errors[0] > errors[1] > errors[2]
    assert errors[3] < 1e-3


def test_beam_and_ears_are_taken_towards_the_centres():
    bodies = (0.015, (0.0, 0.0, 0.0)), (0.01, (0.0, 1.5, 0.0))
    engine, ear = spheres(*bodies), np.array([0.25, 0.1, 0.1])
    engine.orders = 1

    class Pattern(Everywhere):
        def beam(self, points):
            return np.where(points[:, 1] > 1.0, 0.5, 1.0)[None]

        def gain(self, ear, points):
            return np.where(points[:, 1] > 1.0, 1.0, 0.25)[None]

    poses = Pattern(SOURCE[None], ear[None, None], *[np.eye(3)[None]] * 2, None)
    found = engine.respond(complex(2 * np.pi * 30e3 / SPEED), poses)[0, 0]
    one, two = (heard(spheres(body), 30e3, SOURCE, ear) for body in bodies)
    assert abs(found - (0.25 * one + 0.5 * two)) < 1e-4 * abs(found)


def test_poses_do_not_depend_on_their_batch(monkeypatch):
    engine = spheres(*TRIPLE)
    emitters = 0.3 * directions(5)
    poses = Everywhere(emitters, emitters[:, None] + 0.01, *[np.stack([np.eye(3)] * 5)] * 2, None)
    wavenumber = complex(2 * np.pi * 20e3 / SPEED)
    together = engine.respond(wavenumber, poses)
    monkeypatch.setattr(spheres_module, "BATCH_BYTES", 1.0)
    alone = engine.respond(wavenumber, poses)
    np.testing.assert_allclose(alone, together, atol=3e-4 * np.abs(together).max())


def test_what_does_not_converge_is_refused_by_its_frequency(monkeypatch):
    monkeypatch.setattr(spheres_module, "MOST_ITERATIONS", 1)
    with pytest.raises(NumericalError, match=r"at 30 kHz did not converge.* is left"):
        heard(spheres(*CLOSE_PAIR), 30e3, SOURCE, -SOURCE)


def scene_engine(mesh, material=RIGID, **simulation):
    wanted = {"engine": "spheres", **simulation}
    settings = validate_settings({"scene": {"name": "t"}, "simulation": wanted}, "test")
    return simulator_of(Scene(mesh, material), settings).engine


def box():
    return trimesh.creation.box([0.1, 0.1, 0.1])


def ellipsoid():
    mesh = ball(0.02)
    mesh.apply_scale([1.0, 1.0, 1.02])
    return mesh


def bowl():
    mesh = ball(0.02, subdivisions=3)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.triangles_center[:, 2] < 0.0])


def turned_in():
    mesh = ball(0.02, subdivisions=3)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def pair(gap, radius=0.02):
    return trimesh.util.concatenate([ball(0.02), ball(radius, (0.02 + radius + gap, 0.0, 0.0))])


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (box, r"body 0 .* encloses 37 % of the sphere"),
        (ellipsoid, r"body 0 .* is no sphere: .* % of the radius off"),
        (bowl, r"body 0 .* is not closed"),
        (turned_in, r"body 0 .* is inside out"),
        (lambda: ball(0.02, subdivisions=1), r"encloses \d+ % of the sphere .*finer"),
        (lambda: pair(0.0), r"bodies 0 and 1 are too close: .* mm lie between"),
        (lambda: pair(1e-4), r"bodies 0 and 1 are too close: 0.1 mm"),
        (lambda: pair(-0.01), r"bodies 0 and 1 overlap or enclose one another: -10 mm"),
        (lambda: pair(-0.035, 0.01), r"bodies 0 and 1 overlap or enclose"),
        (lambda: ball(2.0), r"1 spheres need \d+ partial waves at"),
    ],
)
def test_what_is_no_set_of_spheres_is_refused_in_one_line(mesh, message):
    with pytest.raises(InputError, match=message) as caught:
        scene_engine(mesh())
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("name", ["sonotracelab", "leaf"])
def test_surfaces_that_are_not_rigid_are_refused(name):
    with pytest.raises(InputError, match="rigid surfaces alone"):
        scene_engine(ball(0.02), MATERIALS[name])


def test_spheres_are_found_with_centre_and_radius():
    # One whose vertices are so uneven that their mean is not its centre.
    one = ball(0.01)
    one.vertices += [0.0, 0.0, 0.005]
    one.vertices *= 0.01 / np.linalg.norm(one.vertices, axis=1)[:, None]
    one.apply_translation([0.1, 0.2, 0.3])
    scene = Scene(trimesh.util.concatenate([one, ball(0.02)]))
    first, second = sorted(find_balls(scene), key=lambda body: body.radius)
    np.testing.assert_allclose(first.centre, [0.1, 0.2, 0.3], atol=1e-9)
    np.testing.assert_allclose(second.centre, 0.0, atol=1e-9)
    assert (first.radius, second.radius) == pytest.approx((0.01, 0.02), rel=1e-9)


def test_a_head_inside_a_sphere_is_refused():
    with pytest.raises(InputError, match="inside a sphere"):
        heard(spheres((0.02, (0.0, 0.0, 0.0))), 1e3, np.array([0.01, 0.0, 0.0]), SOURCE)


def test_hankel_functions_are_those_of_scipy():
    argument = np.array([0.3 - 0.01j, 5.0, 40.0 - 0.1j])
    logarithm, slope = log_outgoing(20, argument)
    n = np.arange(21)[:, None]
    expected = spherical_jn(n, argument) - 1j * spherical_yn(n, argument)
    derivative = spherical_jn(n, argument, True) - 1j * spherical_yn(n, argument, True)
    np.testing.assert_allclose(np.exp(logarithm), expected, rtol=1e-10)
    np.testing.assert_allclose(slope, derivative / expected, rtol=1e-10)


def test_harmonics_are_those_of_scipy():
    out = directions(7)
    polar, azimuth = np.arccos(out[:, 2]), np.arctan2(out[:, 1], out[:, 0])
    found = harmonics(12, out)
    for n in range(13):
        for m in range(-n, n + 1):
            expected = sph_harm_y(n, m, polar, azimuth)
            np.testing.assert_allclose(found[n * (n + 1) + m], expected, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 30])
def test_wigners_matrices_turn_harmonics(degree):
    """Harmonics of turned directions are the matrix times those of the directions."""
    angle, rows = 0.7, slice(degree**2, (degree + 1) ** 2)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    (matrix,) = wigner(degree, [angle])
    out = directions(9)
    found = matrix.T @ harmonics(degree, out)[rows]
    np.testing.assert_allclose(found, harmonics(degree, out @ turn)[rows], atol=1e-10)


def test_the_cost_grows_with_poses_and_frequency():
    engine, finer = spheres(*TRIPLE), spheres(*TRIPLE, frequency_max=200e3)
    memory, seconds = engine.estimate(10)
    assert engine.estimate(100)[1] == pytest.approx(10 * seconds)
    assert finer.estimate(10)[0] > memory
    assert finer.estimate(10)[1] > 4 * seconds
