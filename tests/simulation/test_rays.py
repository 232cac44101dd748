# SPDX-License-Identifier: MIT
import pickle
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.poses import look_at
from sononerf.head.ears import ear_tables
from sononerf.run.simulate import simulator_of
from sononerf.scene.material import RIGID, Material
from sononerf.scene.scene import Scene, load_scene
from sononerf.settings.schema import EarSettings
from sononerf.simulation.footprint import Footprint, emit_bundles, land, onto
from sononerf.simulation.hearing import Arrival, Hearing, silence_before
from tests.simulation.exact import SPEED, rigid_sphere
from tests.simulation.listening import (
    NODES,
    SYNTHESIS,
    TableHead,
    ball,
    box,
    echoes,
    hearing,
    level_db,
    rays,
    spectrum,
    wall,
)

PLAIN = replace(RIGID, diffraction=None)
BAND = np.linspace(20e3, 100e3, 81)


def group_delay(pressure, frequency, expected):
    """Range (m) from the slope of the phase, against an expected one."""
    turned = pressure * np.exp(4j * np.pi * frequency * expected / SPEED)
    return -np.polyfit(frequency, np.unwrap(np.angle(turned)), 1)[0] * SPEED / (4 * np.pi)


def bat():
    head = ear_tables(EarSettings(), NODES)
    return Hearing(TableHead(head), SYNTHESIS)


def difference(one, two, frequency=BAND):
    """Of spectra, relative to the loudest."""
    a, b = spectrum(one, frequency), spectrum(two, frequency)
    return np.abs(a - b).max() / np.abs(b).max()


@pytest.mark.parametrize("distance", [0.25, 0.45])
@pytest.mark.parametrize("radius", [0.015, 0.0286])
def test_a_sphere_answers_as_geometrical_acoustics_says(radius, distance):
    """a / (2 r (r - a)) for ka above 5; Morse and Ingard, Theoretical Acoustics, 8.2."""
    frequency = BAND[2 * np.pi * BAND * radius / SPEED > 5.0]
    (echo,) = echoes(rays(ball(radius), RIGID, rays=10_000), [distance, 0.0, 0.0])
    found = spectrum(echo, frequency)
    # Out on a small sphere the detour is no longer of second order: the fade takes a little more.
    expected = radius / (2 * distance * (distance - radius))
    assert np.abs(level_db(found) - level_db(expected)).max() < 0.7
    assert abs(group_delay(found, frequency, distance - radius)) < 1e-4
    exact = rigid_sphere(frequency, radius, distance, distance)
    # What creeps round the sphere ripples the exact level by 1 dB at ka 5.
    assert np.sqrt(np.mean((level_db(found) - level_db(exact)) ** 2)) < 0.7


@pytest.mark.parametrize(
    ("distance", "emitter", "ear"),
    [
        (0.3, (0.0, 0.03, 0.0), (0.02, -0.03, 0.02)),
        (0.15, (0.0, 0.0, -0.01), (-0.01, 0.01, 0.005)),
        (0.3, (0.0, 0.1, 0.0), (0.05, -0.12, 0.03)),
        (0.1, (0.0, 0.0, 0.0), (0.0, 0.1, 0.0)),
    ],
)
def test_emitter_and_ear_apart_hear_a_plate_over_the_mirrored_path(distance, emitter, ear):
    plate = wall(distance, (-0.5, -0.5), (0.5, 0.5))
    (echo,) = echoes(rays(plate, PLAIN, hearing(emitter, (ear,)), rays=160_000))
    length = np.linalg.norm(np.array([2 * distance, 0, 0]) + np.multiply(emitter, [-1, 1, 1]) - ear)
    frequency = np.linspace(25e3, 95e3, 71)
    found = spectrum(echo, frequency)
    assert np.abs(level_db(found) - level_db(1 / length)).max() < 0.4
    assert abs(group_delay(found, frequency, length / 2)) < 1e-4


def test_ears_far_apart_are_both_heard_for():
    plate, head = wall(0.1, (-0.5, -0.5), (0.5, 0.5)), hearing(ears=((0, 0.1, 0), (0, -0.1, 0)))
    (alone,) = echoes(rays(plate, PLAIN, rays=160_000))
    frequency = np.linspace(25e3, 95e3, 15)
    straight = level_db(spectrum(alone, frequency)) - level_db(1 / 0.2)
    for echo in echoes(rays(plate, PLAIN, head, rays=160_000)):
        level = level_db(spectrum(echo, frequency)) - level_db(1 / np.hypot(0.2, 0.1))
        np.testing.assert_allclose(level, straight, atol=0.3)


def glint(source, listener, middle, radius):
    """Path (m) and pressure of a sphere's mirror point, by the width of the bundle [1]_.

    References
    ----------
    .. [1] M. Born and E. Wolf, Principles of Optics, section 4.6: Coddington's equations.
    """
    one, two = source - middle, listener - middle
    one, two = one / np.linalg.norm(one), two / np.linalg.norm(two)
    square = two - (two @ one) * one
    square /= np.linalg.norm(square)
    angle = np.linspace(0.0, np.arccos(one @ two), 200_001)[:, None]
    points = middle + radius * (np.cos(angle) * one + np.sin(angle) * square)
    ways = [np.linalg.norm(place - points, axis=1) for place in (source, listener)]
    best = (ways[0] + ways[1]).argmin()
    d1, d2 = ways[0][best], ways[1][best]
    cosine = (points[best] - middle) @ (source - points[best]) / (radius * d1)
    width = (d1 + d2 + 2 * d1 * d2 / (radius * cosine)) * (d1 + d2 + 2 * d1 * d2 * cosine / radius)
    return d1 + d2, 1 / np.sqrt(width)


def test_a_sphere_in_a_mirror_answers_like_its_image():
    """Plate, sphere, ear and sphere, plate, ear: each as if from the mirrored head."""
    middle = np.array([0.12, 0.25, 0.0])
    both = trimesh.util.concatenate([wall(0.3, (-0.1, -0.25), (0.45, 0.25)), ball(0.02, middle)])
    length, pressure = glint(np.zeros(3), np.array([0.6, 0.0, 0.0]), middle, 0.02)
    gate = {"since": length / 2 - 0.02, "until": length / 2 + 0.02}
    frequency = np.linspace(25e3, 95e3, 71)
    (single,) = echoes(rays(both, PLAIN, bounces=1))
    assert (
        np.abs(spectrum(single, frequency, **gate)).max() < 0.02 * pressure
    )  # what the gate lets in
    for bounces in (2, 3):
        (echo,) = echoes(rays(both, PLAIN, rays=80_000, bounces=bounces))
        found = spectrum(echo, frequency, **gate)
        assert np.abs(level_db(found) - level_db(2 * pressure)).max() < 0.5
        assert abs(group_delay(found, frequency, length / 2)) < 1e-4


def test_few_rays_find_the_mirror_points_of_second_bounces():
    middle = np.array([0.12, 0.25, 0.0])
    both = trimesh.util.concatenate([wall(0.3, (-0.1, -0.25), (0.45, 0.25)), ball(0.02, middle)])
    length, pressure = glint(np.zeros(3), np.array([0.6, 0.0, 0.0]), middle, 0.02)
    gate = {"since": length / 2 - 0.02, "until": length / 2 + 0.02}
    for seed in (0, 1, 2):
        (echo,) = echoes(rays(both, PLAIN, rays=20_000, bounces=2), seed=seed)
        found = spectrum(echo, np.linspace(25e3, 95e3, 71), **gate)
        assert np.abs(level_db(found) - level_db(2 * pressure)).max() < 1.0


def test_more_bounces_only_add():
    position = np.array([0.3, 0.0, 0.0])
    rotation = look_at(position, np.zeros(3))
    scene = load_scene("three_spheres")
    one, three, silent = (
        echoes(rays(found, None, bounces=bounces), position, rotation)[0]
        for found, bounces in (
            (scene, 1),
            (scene, 3),
            (Scene(scene.mesh, replace(RIGID, reflection=(0.0, 0.0))), 3),
        )
    )
    # Another bounce draws rays away from the first: noise of some tenths of a per cent.
    assert difference(silent, one) < 0.02
    assert difference(three, one) > 0.02


@pytest.mark.parametrize("body", ["three_spheres", "box"])
def test_exchanging_emitter_and_ear_changes_nothing(body):
    """Reciprocity (Lord Rayleigh, Theory of Sound, section 294), up to the rays' noise."""
    mesh = box([-0.03] * 3, [0.03] * 3) if body == "box" else load_scene(body).mesh
    one, two = (0.0, 0.05, 0.02), (-0.03, -0.06, 0.0)
    position = np.array([0.3, 0.02, 0.01])
    rotation = look_at(position, np.zeros(3))
    there, back = (
        echoes(rays(mesh, RIGID, hearing(a, (b,))), position, rotation, seed)[0]
        for a, b, seed in ((one, two, 1), (two, one, 2))
    )
    assert difference(there, back) < 0.02


def test_each_ear_sees_for_itself():
    """Before the left ear, at y = 0.2, stands a plate; the emitter sees past it."""
    target, before = ball(0.03, (0.5, 0.0, 0.0)), wall(0.2, (0.06, -0.1), (0.3, 0.1))
    head = hearing(ears=((0.0, 0.2, 0.0), (0.0, -0.2, 0.0)))
    both = trimesh.util.concatenate([target, before])
    found, free = (echoes(rays(m, PLAIN, head, bounces=1)) for m in (both, target))
    # Both ears hear the ball at (0.47 + 0.51) / 2.
    left, right = (np.abs(spectrum(echo, BAND, since=0.45)) for echo in found)
    # The way to the left ear passes 60 mm beside the plate's edge, in its shadow. At 20 kHz that
    # is 1.9 of Fresnel's units: a knife edge leaves 0.225 / 1.9.
    assert left.max() < 0.13 * right.max()
    assert left[BAND > 80e3].max() < 0.08 * right.max()
    np.testing.assert_allclose(right, np.abs(spectrum(free[1], BAND)), rtol=0.05)


def test_each_part_answers_by_its_material():
    """One plate before the other, twice as far: gated apart, each by its own strength."""
    near, far = wall(0.25, (-0.05, -0.05), (0.05, 0.05)), ball(0.1, (0.6, 0.0, 0.2))
    mesh = trimesh.util.concatenate([near, far])
    part = np.repeat([0, 1], [len(near.faces), len(far.faces)])
    loud, soft = PLAIN, replace(PLAIN, strength=(0.25, 0.25))
    gates = {"near": {"until": 0.4}, "far": {"since": 0.45}}

    def levels(*materials):
        (echo,) = echoes(rays(Scene(mesh, materials, part), None))
        return [np.abs(spectrum(echo, BAND, **gate)) for gate in gates.values()]

    both = levels(loud, loud)
    np.testing.assert_allclose(
        both[0], np.abs(spectrum(echoes(rays(mesh, loud))[0], BAND, until=0.4))
    )
    for materials, factors in (((soft, loud), (0.25, 1.0)), ((loud, soft), (1.0, 0.25))):
        for found, plain, factor in zip(levels(*materials), both, factors, strict=True):
            # What of the other's tail gets through the gates.
            np.testing.assert_allclose(found, factor * plain, rtol=0.01)


def test_a_part_weakens_what_bounces_off_it_first():
    """A corner of two materials: each order of bounces keeps what its first plate keeps."""
    plates = [box((0.2, -0.5, -0.4), (0.21, 0.25, 0.4)), box((-0.5, 0.25, -0.4), (0.21, 0.26, 0.4))]
    corner = trimesh.util.concatenate(plates)
    part = np.repeat([0, 1], [len(plate.faces) for plate in plates])
    keen, dull = replace(PLAIN, reflection=(1.0, 1.0)), replace(PLAIN, reflection=(0.2, 0.2))
    mute = replace(dull, strength=(0.0, 0.0))
    # Both orders share the mirror point at the edge alike; of a mute plate only one is heard.
    for second, expected in ((dull, (1.0 + 0.2) / 2), (mute, 0.2 / 2)):
        (echo,) = echoes(rays(Scene(corner, (keen, second), part), None, bounces=2))
        found = level_db(spectrum(echo, np.linspace(25e3, 95e3, 71), since=0.29))
        assert np.abs(found - level_db(expected / (2 * np.hypot(0.2, 0.25)))).max() < 1.0


def test_a_rough_part_is_weaker_at_high_frequencies_and_lobes_widen():
    flat = wall(0.3, (-0.27, -0.3), (0.31, 0.28))
    lobed = Material((1e5,), (0.5,), (1.0,), (1.0,), diffraction=None)
    frequency = np.array([30e3, 60e3, 90e3])
    (smooth,), (wide,) = (echoes(rays(flat, m, rays=160_000)) for m in (PLAIN, lobed))
    # A lobe much wider than the first Fresnel zone is as good as none.
    error = level_db(spectrum(smooth, frequency)) - level_db(spectrum(wide, frequency))
    assert np.abs(error).max() < 0.6
    strong = replace(PLAIN, frequency=(20e3, 100e3), strength=(1.0, 0.1))
    (rough,) = echoes(rays(flat, strong, rays=160_000))
    expected = np.interp(np.log(frequency), np.log([20e3, 100e3]), [1.0, 0.1])
    ratio = np.abs(spectrum(rough, frequency) / spectrum(smooth, frequency))
    # Strengths run straight over frequency between nodes 11 kHz apart, the material's over its log.
    np.testing.assert_allclose(ratio, expected, rtol=0.02)


def test_the_air_takes_its_part_over_the_whole_path():
    mesh = ball(0.0286)
    (without,), (found,) = (
        echoes(rays(mesh, PLAIN, hearing(absorption=a)), [0.3, 0.0, 0.0]) for a in (0.0, 3.0)
    )
    ratio = np.abs(spectrum(found, BAND) / spectrum(without, BAND))
    np.testing.assert_allclose(ratio, 10 ** (-3.0 * 2 * (0.3 - 0.0286) / 20), rtol=2e-3)


def test_hits_lie_on_the_surface_and_are_strongest_at_the_glint():
    engine = rays(ball(0.0286), RIGID)
    points, strength = engine.hits(np.array([0.3, 0.0, 0.0]), np.eye(3))
    assert (len(points), strength.min() >= 0.0) == (len(strength), True)
    # Chords of the triangles lie up to 9 um inside.
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.0286, atol=1e-5)
    np.testing.assert_allclose(points[strength.argmax()], [0.0286, 0.0, 0.0], atol=1e-3)
    angle = np.arccos(np.clip(points[:, 0] / 0.0286, -1, 1))
    assert strength[angle > 0.5].max() < 0.05 * strength.max()
    rings = [
        np.median(strength[(angle >= a) & (angle < a + 0.05)]) for a in np.arange(0, 0.4, 0.05)
    ]
    assert (np.diff(rings) < 0.0).all()


def test_a_seed_says_the_same_each_time_and_pickled():
    engine = rays(load_scene("three_spheres"), None, bat(), rays=5000, bounces=2)
    position = np.array([0.0, 0.4, 0.0])
    pose = position, look_at(position, np.zeros(3))
    one, two, other = (echoes(engine, *pose, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)
    again = pickle.loads(pickle.dumps(engine))
    np.testing.assert_array_equal(echoes(again, *pose, seed=1), one)


NO_BEND = np.zeros((1, 4, 3), np.float32)


def products(one, other):
    """Scalar products of the first vector with the first, second with second, first with second."""
    one, other = (np.asarray(part, float).reshape(-1, 2, 3) for part in (one, other))
    return np.einsum("hkd,hld->hkl", one, other).reshape(-1, 4)[:, [0, 3, 1]]


def test_bundles_are_turned_about_two_vectors_square_to_any_direction():
    """Also to those along the axes, where other frames break down."""
    axes = np.concatenate([np.eye(3), -np.eye(3), [[1e-9, 0, -1]], fibonacci_sphere(200)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    bundles = emit_bundles(axes, np.full(len(axes), 0.5))
    turn = bundles[:, 6:]
    np.testing.assert_allclose(bundles[:, :6], 0.5 * turn)
    np.testing.assert_allclose(products(turn, turn), [[1, 1, 0]] * len(axes), atol=1e-6)
    along = np.einsum("hkd,hd->hk", turn.reshape(-1, 2, 3), axes)
    np.testing.assert_allclose(along, 0.0, atol=1e-6)


def plane(slope, side=1.0):
    """A bundle 0.5 m from the emitter that falls on a plate under an angle of incidence."""
    incoming = np.array([[1.0, 0.0, 0.0]])
    normal = np.array([[-np.cos(slope), np.sin(slope), 0.0]])
    bundles = emit_bundles(incoming, np.array([0.5]))
    rows, *others = land(bundles, incoming, side * normal, side * normal, NO_BEND)
    return Footprint(rows), *others


def test_a_bundle_on_a_slope_is_longer_and_no_wider():
    for slope in (0.0, 0.5, 1.4):
        footprint, turned, _, _ = plane(slope)
        np.testing.assert_allclose(footprint.sink, -np.cos(slope), rtol=1e-5)
        np.testing.assert_allclose(footprint.tube, 0.25, rtol=1e-6)
        lit = np.cross(footprint.shift[0, :, 0], footprint.shift[1, :, 0])
        np.testing.assert_allclose(np.linalg.norm(lit), 0.25 / np.cos(slope), rtol=1e-5)
        normal = np.array([-np.cos(slope), np.sin(slope), 0.0])
        np.testing.assert_allclose(footprint.shift[:, :, 0] @ normal, 0.0, atol=1e-6)
        # A flat mirror turns directions and keeps their angles.
        np.testing.assert_allclose(products(turned, turned)[0], [1.0, 1.0, 0.0], atol=1e-6)
        np.testing.assert_allclose(footprint.curving, 0.0)


def test_either_side_of_a_plate_mirrors_alike():
    for slope in (0.0, 0.5, 1.4):
        for side in (1.0, -1.0):
            footprint, _, flat, mirrored = plane(slope, side)
            np.testing.assert_allclose(flat, [[-np.cos(slope), np.sin(slope), 0.0]])
            expected = [[-np.cos(2 * slope), np.sin(2 * slope), 0.0]]
            np.testing.assert_allclose(mirrored, expected, atol=1e-15)
            np.testing.assert_array_equal(footprint.rows, plane(slope)[0].rows)


def test_a_mirrored_bundle_grows_on_as_before():
    """Off a plate it is as wide as it would be straight on."""
    footprint, turned, _, _ = plane(0.5)
    bundles = onto(footprint.rows, turned, np.array([0, 0]), np.array([0.1, 0.7]))
    np.testing.assert_array_equal(bundles[:, 6:], turned[[0, 0]])
    mirrored = np.array([[-np.cos(1.0), np.sin(1.0), 0.0]] * 2)
    bend = np.zeros((2, 4, 3), np.float32)
    rows, *_ = land(bundles, mirrored, -mirrored, -mirrored, bend)
    np.testing.assert_allclose(Footprint(rows).tube, [0.6**2, 1.2**2], rtol=1e-5)


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
    from sononerf.head.front_end import compress
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
