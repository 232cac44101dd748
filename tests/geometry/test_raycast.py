# SPDX-License-Identifier: MIT


import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from sononerf.geometry import raycast
from sononerf.geometry.directions import fibonacci_cap, fibonacci_sphere, spread_points
from sononerf.geometry.raycast import RayCaster, contains


def shoot(caster, origin, directions):
    return caster.first_hit(np.broadcast_to(origin, directions.shape), directions)


def test_distance_to_a_plate_is_exact():
    plate = trimesh.creation.box((0.01, 2.0, 2.0))
    plate.apply_translation([1.005, 0.0, 0.0])
    directions = fibonacci_cap(5000, axis=(1, 0, 0), half_angle=0.7, offset=(0.5, 0.0))
    hits = shoot(RayCaster(plate), np.zeros(3), directions)
    assert len(hits.ray) == 5000
    np.testing.assert_allclose(hits.distance, 1.0 / directions[:, 0], atol=1e-12)
    np.testing.assert_allclose(hits.points[:, 0], 1.0, atol=1e-12)
    np.testing.assert_allclose(hits.normals, [[-1, 0, 0]] * 5000, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("shift", [0.0, 1e3])
def test_sphere_is_the_same_at_any_scale_and_place(scale, shift):
    mesh = trimesh.creation.icosphere(subdivisions=4)
    mesh.apply_scale(scale)
    mesh.apply_translation([shift * scale, 0.0, 0.0])
    origin = np.array([(shift + 3.0) * scale, 0.1 * scale, 0.0])
    directions = fibonacci_cap(5000, axis=(-1, 0, 0), half_angle=0.3, offset=(0.5, 0.0))
    hits = shoot(RayCaster(mesh), origin, directions)
    assert len(hits.ray) == 5000
    outward = (hits.points - [shift * scale, 0, 0]) / scale
    radius = np.linalg.norm(outward, axis=1)
    # A chord of an icosphere of this fineness lies at most 1.2e-3 radii inside.
    assert radius.max() <= 1.0 + 1e-9
    assert radius.min() > 1.0 - 1.3e-3
    np.testing.assert_allclose(hits.normals, outward / radius[:, None], atol=1e-6)
    np.testing.assert_allclose(
        hits.distance, np.linalg.norm(hits.points - origin, axis=1), rtol=1e-12
    )


def test_rays_that_miss_are_left_out():
    caster = RayCaster(trimesh.creation.icosphere(subdivisions=2))
    directions = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0], [-1.0, 0, 0]])
    hits = shoot(caster, np.array([3.0, 0.0, 0.0]), directions)
    np.testing.assert_array_equal(hits.ray, [1, 3])
    assert len(shoot(caster, np.array([3.0, 0, 0]), directions[:1]).ray) == 0


def test_no_ray_leaks_out_through_edges_and_vertices():
    mesh = trimesh.creation.icosphere(subdivisions=4)
    caster = RayCaster(mesh)
    aimed = np.concatenate([mesh.vertices, mesh.vertices[mesh.edges_unique].mean(axis=1)])
    aimed /= np.linalg.norm(aimed, axis=1, keepdims=True)
    assert len(shoot(caster, np.zeros(3), aimed).ray) == len(aimed)


@pytest.mark.parametrize("shift", [0.0, 20.0])  # far off, single precision is a micrometre
def test_a_surface_does_not_hide_itself(shift):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.015)
    place = np.array([shift, 0.0, 0.0])
    mesh.apply_translation(place)
    caster = RayCaster(mesh)
    directions = fibonacci_sphere(20_000)
    hits = shoot(caster, place, directions)  # from inside, so that all of it is met
    flat = caster.face_normals[hits.triangle]
    seen = caster.visible(hits.points, hits.points + 0.5 * flat, normals=flat)
    assert seen.all()
    towards = place + np.array([0.4, 0.0, 0.0])
    rise = np.einsum("nd,nd->n", towards - hits.points, flat)
    seen = caster.visible(hits.points, towards, normals=flat)
    # A convex body is seen where it faces; facets that graze the line may go either way.
    assert seen[rise > 1e-4].all()
    assert seen[rise < -1e-4].mean() < 1e-3  # a few rays slip through vertices


def test_occlusion_ends_at_the_target():
    plate = trimesh.creation.box((0.01, 2.0, 2.0))
    plate.apply_translation([1.0, 0.0, 0.0])
    points = np.zeros((3, 3))
    targets = np.array([[0.9, 0, 0], [1.1, 0, 0], [3.0, 3.5, 0]])
    np.testing.assert_array_equal(RayCaster(plate).visible(points, targets), [True, False, True])


def test_a_triangle_without_area_spoils_nothing():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]]
    caster = RayCaster(trimesh.Trimesh(vertices, [[0, 1, 2], [0, 3, 1]], process=False))
    hits = shoot(caster, np.array([0.2, 0.2, 1.0]), np.array([[0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(hits.points, [[0.2, 0.2, 0.0]], atol=1e-12)


def normal_change(hits, shift):
    """How the smooth normals turn as the hits move along their triangles."""
    to_second, to_third, second, third = hits.gradients.transpose(1, 0, 2).astype(float)
    change = np.einsum("nd,nd->n", shift, to_second)[:, None] * second
    change += np.einsum("nd,nd->n", shift, to_third)[:, None] * third
    return change - np.einsum("nd,nd->n", change, hits.normals)[:, None] * hits.normals


def test_gradients_and_flat_normals_are_those_of_the_triangles_hit():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    directions = fibonacci_cap(300, axis=(-1, 0, 0), half_angle=0.3, offset=(0.5, 0.0))
    hits = shoot(RayCaster(mesh), np.array([0.3, 0.02, 0.01]), directions)
    corners = mesh.triangles.view(np.ndarray)[hits.triangle]
    assert hits.gradients.shape == (len(hits.ray), 4, 3)
    np.testing.assert_allclose(hits.flat, mesh.face_normals[hits.triangle], atol=1e-9)
    to_second, to_third, second, third = hits.gradients.transpose(1, 0, 2)
    first, sides = corners[:, 0], corners[:, 1:] - corners[:, :1]
    weights = np.stack(
        [np.einsum("nd,nd->n", hits.points - first, g) for g in (to_second, to_third)]
    )
    again = first + np.einsum("kn,nkd->nd", weights, sides)
    np.testing.assert_allclose(again, hits.points, atol=1e-8)
    # Smooth normals of a sphere about the origin are its places.
    np.testing.assert_allclose(second, sides[:, 0] / 0.1, atol=1e-6)
    np.testing.assert_allclose(third, sides[:, 1] / 0.1, atol=1e-6)


@pytest.mark.parametrize("inside_out", [False, True])
def test_normals_of_a_sphere_turn_by_the_shift_over_the_radius(inside_out):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    if inside_out:
        mesh.invert()
    sign = -1.0 if inside_out else 1.0
    directions = fibonacci_cap(2000, axis=(-1, 0, 0), half_angle=0.2, offset=(0.5, 0.0))
    hits = shoot(RayCaster(mesh), np.array([0.2, 0.0, 0.0]), directions)
    shift = np.cross(hits.flat, np.random.default_rng(1).normal(size=hits.points.shape))
    shift /= np.linalg.norm(shift, axis=1, keepdims=True)
    change = normal_change(hits, shift)
    # A facet is tilted against the smooth normal by up to two degrees.
    np.testing.assert_allclose(change, sign * shift / 0.05, atol=0.05 / 0.05)
    length = np.linalg.norm(change, axis=1)
    np.testing.assert_allclose(length, 1 / 0.05, rtol=2e-3)


def test_gradients_are_the_slope_of_the_normals():
    """Against a second ray that hits the same triangle some micrometres aside."""
    rng = np.random.default_rng(2)
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    mesh.vertices *= 1.0 + 0.05 * rng.random((len(mesh.vertices), 1))
    caster = RayCaster(mesh)
    origin = np.array([0.4, 0.0, 0.0])
    hits = shoot(caster, origin, fibonacci_cap(500, axis=(-1, 0, 0), half_angle=0.2, offset=(0, 0)))
    shift = 3e-5 * np.cross(hits.flat, rng.normal(size=hits.flat.shape))
    aside = hits.points + shift - origin
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    again = shoot(caster, origin, aside)
    same = again.triangle == hits.triangle
    assert same.mean() > 0.95
    slope = (again.normals - hits.normals)[same]
    # Between corners that differ by up to 25 degrees the mean normal is shorter than 1, by 3 %;
    # not made longer, its change is that of a sphere through the corners.
    error = np.linalg.norm(normal_change(hits, shift)[same] - slope, axis=1)
    assert (error / np.linalg.norm(slope, axis=1)).max() < 0.035


def test_curvature_is_that_of_the_surface():
    np.testing.assert_allclose(
        RayCaster(trimesh.creation.icosphere(subdivisions=4, radius=0.015)).curvature,
        np.sqrt(2) / 0.015,
        rtol=2e-3,
    )


def test_occlusion_agrees_with_the_ray_caster():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (500, 3))
    points = points[np.linalg.norm(points, axis=1) > 0.021]
    target = np.broadcast_to([0.3, 0.0, 0.0], points.shape)
    blocked = raycast.Occlusion(np.array(ball.vertices), np.array(ball.faces)).blocked(
        points, target
    )
    assert 0 < blocked.sum() < len(points)
    np.testing.assert_array_equal(~blocked, RayCaster(ball).visible(points, target))


GENERATOR = np.random.default_rng(0)


def ball(radius=1.0, centre=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def test_inside_of_overlapping_and_hollow_bodies():
    left, right = ball(centre=(-0.6, 0, 0)), ball(centre=(0.6, 0, 0))
    hollow = ball(0.2, (-0.8, 0, 0))
    hollow.invert()
    mesh = trimesh.util.concatenate([left, right, hollow])
    points = GENERATOR.uniform(-1.7, 1.7, (300, 3))
    expected = np.zeros(300, bool)
    for centre in (-0.6, 0.6):
        expected |= np.linalg.norm(points - [centre, 0, 0], axis=1) < 1.0
    expected &= np.linalg.norm(points - [-0.8, 0, 0], axis=1) > 0.2
    assert np.mean(contains(mesh.vertices, mesh.faces, points) == expected) > 0.98  # flat facets
    places = [[-0.8, 0, 0], [0, 0, 0], [-1.3, 0, 0], [5.0, 0, 0]]
    assert contains(mesh.vertices, mesh.faces, places).tolist() == [False, True, True, False]


def test_points_in_line_with_corners_and_edges():
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    steps = np.array([-0.5, 0.0, 0.5])
    points = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    assert contains(box.vertices, box.faces, points).all()
    outside = points / np.abs(points).max(axis=1, keepdims=True).clip(1e-9) * 1.1
    outside = outside[np.abs(outside).max(axis=1) > 1]
    assert not contains(box.vertices, box.faces, outside).any()
    assert contains(box.vertices, box.faces, np.zeros((0, 3))).shape == (0,)


def uneven():
    """Return a box of which two triangles are divided into 2,048, and the others are not."""
    box = trimesh.creation.box((0.04, 0.05, 0.06))
    first, others = box.submesh([[0, 1], range(2, 12)])
    for _ in range(5):
        first = first.subdivide()
    return trimesh.util.concatenate([first, others])


@pytest.mark.parametrize("first", [40, 100, 250])
@pytest.mark.parametrize(
    "mesh", [trimesh.creation.icosphere(subdivisions=3, radius=0.02), uneven()], ids=["ball", "box"]
)
def test_any_first_points_are_spread_evenly(mesh, first):
    points, _ = spread_points(mesh, 250)
    apart = cKDTree(points[:first]).query(points[:first], k=2)[0][:, 1]
    spacing = np.sqrt(mesh.area / first)
    assert apart.min() > 0.55 * spacing
    assert apart.max() < 1.5 * spacing
    # And no place of the surface is far from all of them.
    places = mesh.triangles_center
    assert cKDTree(points[:first]).query(places)[0].max() < 1.2 * spacing


def test_points_lie_on_the_surface_and_normals_point_out():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    points, normals = spread_points(mesh, 100)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.02, rtol=5e-3)
    np.testing.assert_allclose(normals, points / 0.02, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_the_same_points_every_time():
    mesh = uneven()
    np.testing.assert_array_equal(spread_points(mesh, 50)[0], spread_points(mesh, 50)[0])
