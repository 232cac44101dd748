# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from sononerf_scenes.blade import Blade

LENGTH, WIDTH, THICKNESS = 0.18, 0.1, 4e-4


def blade(curl=60.0, bend=30.0, undulation=0.0):
    return Blade.drawn(
        3,
        length=LENGTH,
        width=WIDTH,
        thickness=THICKNESS,
        curl=np.radians(curl),
        bend=np.radians(bend),
        undulation=undulation,
    )


def at(*values):
    return [np.array([value]) for value in values]


def places(count=300):
    random = np.random.default_rng(0)
    shape = 3, count
    along, across, height = random.uniform(-1.0, 1.0, shape) * [[LENGTH / 2], [WIDTH / 2], [0.005]]
    return along, across, height


def test_unbent_places_and_heights_are_coordinates():
    along, across, height = places()
    points = blade(0.0, 0.0).placed(along, across, height)
    np.testing.assert_allclose(points, np.stack([height, across, along], axis=1), atol=1e-15)


def test_curl_alone_makes_a_cylinder_hollow_above():
    along, across, height = places()
    points = blade(60.0, 0.0).placed(along, across, height)
    radius = WIDTH / np.radians(60.0)
    np.testing.assert_allclose(points[:, 2], along)
    from_axis = np.hypot(points[:, 0] - radius, points[:, 1])
    np.testing.assert_allclose(from_axis, radius - height, rtol=1e-12)
    # The edges stand at half the angle each.
    edge = blade(60.0, 0.0).placed(*at(0.0, WIDTH / 2, 0.0))[0]
    np.testing.assert_allclose(edge, [radius * (1 - np.sqrt(0.75)), radius / 2, 0.0], atol=1e-12)


def test_bend_alone_makes_a_cylinder_that_turns_away_above():
    along, across, height = places()
    points = blade(0.0, 30.0).placed(along, across, height)
    radius = LENGTH / np.radians(30.0)
    np.testing.assert_allclose(points[:, 1], across)
    from_axis = np.hypot(points[:, 0] + radius, points[:, 2])
    np.testing.assert_allclose(from_axis, radius + height, rtol=1e-12)


@pytest.mark.parametrize("curl", [-120.0, 0.0, 60.0, 120.0])
@pytest.mark.parametrize("bend", [-90.0, 0.0, 90.0])
def test_every_point_has_one_place(curl, bend):
    # What can be undone folds nothing over, so no sheet meets itself.
    along, across, height = places()
    bent = blade(curl, bend)
    for found, given in zip(
        bent.unplaced(bent.placed(along, across, height)), (along, across, height), strict=True
    ):
        np.testing.assert_allclose(found, given, atol=1e-12)


def test_lengths_stay_on_the_bent_blade_and_stretch_bounds_them():
    for curl, bend in ((60.0, 30.0), (120.0, 90.0), (-120.0, 90.0)):
        bent = blade(curl, bend, undulation=1e-3)
        along, across, _ = places()
        start = bent.placed(along, across, bent.undulation(along, across))
        step = 1e-5
        turn = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(along))
        u, v = along + step * np.cos(turn), across + step * np.sin(turn)
        grown = np.linalg.norm(bent.placed(u, v, bent.undulation(u, v)) - start, axis=1) / step
        assert grown.max() <= bent.stretch()
    assert blade(0.0, 0.0).stretch() == 1.0


def test_it_is_as_long_and_wide_as_said_and_has_a_stalk():
    flat = blade()
    along = np.linspace(-LENGTH / 2, LENGTH / 2, 2001)
    half = flat.half_width(along)
    assert half.max() == pytest.approx(WIDTH / 2, rel=1e-5)
    assert along[half.argmax()] == pytest.approx(-0.1 * LENGTH, abs=1e-4)
    assert half[-1] == 0.0
    assert flat.half_width(at(-LENGTH / 2 - 0.01)[0])[0] == pytest.approx(1.2e-3)


def test_ribs_stand_out_below_a_millimetre_and_taper():
    flat = blade(0.0, 0.0)
    midrib = flat.ribs(np.array([-0.085, 0.0, 0.085]), np.zeros(3))
    assert 1e-3 > midrib[0] > midrib[1] > midrib[2] > 0.0
    along, across = (grid.ravel() for grid in np.mgrid[-0.08:0.08:400j, -0.05:0.05:250j])
    inside = np.abs(across) < flat.half_width(along)
    ribs = flat.ribs(along, across)
    assert ribs.max() < 1e-3
    # Away from the midrib only the veins are left, half as high on the upper side.
    aside = inside & (np.abs(across) > 0.01)
    assert 1.5e-4 < ribs[aside].max() < 3.5e-4
    upper, lower = flat.upper(along, across)[:, 0], flat.lower(along, across)[:, 0]
    np.testing.assert_allclose(upper, THICKNESS / 2 + ribs / 2, atol=1e-15)
    np.testing.assert_allclose(lower, -THICKNESS / 2 - ribs, atol=1e-15)


def test_waves_have_the_size_asked_for_and_leave_the_middle_in_place():
    wavy = blade(undulation=1e-3)
    along, across = np.random.default_rng(0).uniform(-5.0, 5.0, (2, 200_000))
    # Over many wavelengths the mean square of a cosine is a half; their mean is the middle's.
    assert wavy.undulation(along, across).std() == pytest.approx(1e-3, rel=0.01)
    assert wavy.undulation(*at(0.0, 0.0))[0] == 0.0


def test_frames_are_square_and_stand_on_the_upper_side():
    bent = blade(undulation=1e-3)
    along, across, _ = places()
    points, normals, tangents = bent.frames(along, across)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    np.testing.assert_allclose((normals * tangents).sum(axis=1), 0.0, atol=1e-9)
    for u, v in ((1e-4, 0.0), (0.0, 1e-4)):
        ahead, _, _ = bent.frames(along + u, across + v)
        np.testing.assert_allclose(((ahead - points) * normals).sum(axis=1), 0.0, atol=3e-7)
    # Half the thickness above the middle surface, up being +x in the middle.
    point, normal, tangent = (vectors[0] for vectors in blade().frames(*at(0.0, 0.0)))
    np.testing.assert_allclose(point, [THICKNESS / 2, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(normal, [1.0, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(tangent, [0.0, 0.0, 1.0], atol=1e-8)


def test_clearance_is_the_height_above_the_upper_side():
    bent = blade(undulation=1e-3)
    along, across, _ = places()
    np.testing.assert_allclose(bent.clearance(bent.upper(along, across)), 0.0, atol=1e-12)
    points, normals, _ = bent.frames(along, across)
    ribs = bent.ribs(along, across) / 2
    above = bent.clearance(points + 0.003 * normals)
    np.testing.assert_allclose(above, 0.003 - ribs, atol=1.5e-4)
