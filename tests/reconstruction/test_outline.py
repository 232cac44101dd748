# SPDX-License-Identifier: MIT
import numpy as np
import pytest
from scipy.spatial import cKDTree

from sononerf.echoes.free_space import EchoHull
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.reconstruction import outline as outline_module
from sononerf.reconstruction.glints import Glints
from sononerf.reconstruction.outline import clearance_volume, outline
from sononerf.reconstruction.volume import grid_over

DISTANCE = 0.4
FACE, FLOOR, GAP = 0.02, -0.01, 0.015
"""Two blocks from floor to face, x, m, on both sides of a gap of half that width, y."""
CORNER = np.array([0.03, 0.045, 0.03])
SPACING = 0.003


def hull_around(body, count=400):
    """What the first echoes of points leave; each head calls and hears from one place."""
    heads = DISTANCE * fibonacci_sphere(count)
    first = cKDTree(body).query(heads)[0][:, None]
    return EchoHull(heads, heads[:, None], first, -heads / DISTANCE)


def cuboid(lower, upper, step=0.0025):
    """Points throughout a block; those inside are never the nearest."""
    axes = [np.linspace(a, b, round((b - a) / step) + 1) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def gap():
    """Two blocks on a floor, the hull of all, and its clearance."""
    sides = [cuboid([FLOOR, y - 0.01, -FACE], [FACE, y + 0.01, FACE]) for y in (-0.025, 0.025)]
    floor = cuboid([FLOOR - 0.01, -0.035, -FACE], [FLOOR, 0.035, FACE])
    hull = hull_around(np.concatenate((*sides, floor)))
    return hull, clearance_volume(hull, -CORNER, CORNER, SPACING)


def glints_at(points, sources):
    """Points heard from some places, one each."""
    towards = sources - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return Glints(points, towards, np.ones(len(points)), np.arange(len(points)) % 400)


def on_the_floor():
    """Heard through the gap from straight ahead."""
    y, z = np.meshgrid(np.linspace(-0.008, 0.008, 9), np.linspace(-0.010, 0.010, 11))
    points = np.stack((np.full(y.size, FLOOR), y.ravel(), z.ravel()), axis=1)
    return glints_at(points, np.stack((np.full(y.size, DISTANCE), y.ravel(), z.ravel()), axis=1))


def none():
    return glints_at(np.zeros((0, 3)), np.zeros((0, 3)))


def in_front(points):
    """Which of the outline lie over the gap, and which on the two faces beside it, all in front.

    Between heads 70 mm apart a sphere of 0.38 m rises over 45 mm by 45² / 760 mm.
    """
    front = (np.abs(points[:, 0] - FACE) < 0.0027) & (np.abs(points[:, 2]) < 0.014)
    aside = np.abs(points[:, 1])
    return front & (aside < 0.008), front & (aside > GAP) & (aside < 0.033)


def test_a_film_over_a_gap_stays_where_nothing_was_heard_from_behind(gap):
    points, normals = outline(*gap, none(), np.zeros(0))
    film, faces = in_front(points)
    # About a point for each voxel, of 16 mm x 28 mm and of 2 x 18 mm x 28 mm.
    assert film.sum() == pytest.approx(0.016 * 0.028 / SPACING**2, rel=0.25)
    assert faces.sum() == pytest.approx(2 * 0.018 * 0.028 / SPACING**2, rel=0.25)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    # Towards the poses that bound it.
    towards = gap[0].sources[gap[0].clearance(points)[1]] - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, towards)
    assert (normals[film | faces][:, 0] > 0.95).all()


def test_a_film_over_a_gap_goes_where_sound_came_through_and_faces_stay(gap):
    before, _ = outline(*gap, none(), np.zeros(0))
    floor = on_the_floor()
    points, normals = outline(*gap, floor, np.ones(len(floor.points)))
    assert len(points) == len(normals)
    assert not in_front(points)[0].any()
    # The ways reach 8 mm aside and are wide at 30 mm: 6 mm, and 0.8 of the 0.17 rad between heads.
    untouched = 0.008 + 0.006 + 0.8 * 0.17 * (FACE - FLOOR)

    def stays(points):
        return points[in_front(points)[1] & (np.abs(points[:, 1]) > untouched + 0.001)]

    assert len(stays(before)) > 50
    np.testing.assert_array_equal(stays(points), stays(before))
    # So do all other sides of the body.
    beside = points[points[:, 0] < FACE - 0.005]
    np.testing.assert_array_equal(beside, before[before[:, 0] < FACE - 0.005])


@pytest.mark.parametrize(
    "believed", [0.0, 0.9 * outline_module.HEARD * outline_module.THROUGH * 20]
)
def test_glints_that_nobody_bears_out_open_nothing(gap, believed):
    """However many they are."""
    before, _ = outline(*gap, none(), np.zeros(0))
    floor = on_the_floor()
    points, _ = outline(*gap, floor, np.full(len(floor.points), believed))
    np.testing.assert_array_equal(points, before)


def test_what_is_heard_from_a_face_does_not_open_it(gap):
    """Not even from 2 mm behind it, as places lie that have not settled."""
    before, _ = outline(*gap, none(), np.zeros(0))
    _, faces = in_front(before)
    for behind, stays in ((0.0, True), (0.002, True), (0.012, False)):
        middles = before[faces] - np.array([behind, 0.0, 0.0])
        glints = glints_at(middles, middles + np.array([DISTANCE, 0.0, 0.0]))
        points, _ = outline(*gap, glints, np.ones(len(middles)))
        if stays:
            np.testing.assert_array_equal(points, before)
        else:
            assert in_front(points)[1].sum() < 0.5 * faces.sum()


def test_each_first_echo_came_from_somewhere_on_its_film():
    """Where all of a pose's film was heard through, what was heard through least stays."""
    hull = hull_around(0.02 * fibonacci_sphere(2000), 100)
    clearance = clearance_volume(hull, -CORNER, CORNER, 0.002)
    before, _ = outline(hull, clearance, none(), np.zeros(0))
    y, z = np.meshgrid(*[np.arange(-0.03, 0.031, 0.003)] * 2)
    behind = np.stack((np.full(y.size, -0.03), y.ravel(), z.ravel()), axis=1)
    glints = glints_at(behind, behind + np.array([1.0, 0.0, 0.0]))
    points, _ = outline(hull, clearance, glints, np.ones(len(behind)))
    front = 0.008
    assert (points[:, 0] > front).sum() < 0.3 * (before[:, 0] > front).sum()
    # Poses whose film lies in front of all glints as a whole, and seen from ahead.
    bounded_by = hull.clearance(before)[1]
    poses = set(bounded_by) - set(bounded_by[before[:, 0] < front])
    assert len(poses) > 15
    assert poses <= set(hull.clearance(points)[1])


@pytest.mark.parametrize("cut", [False, True])
def test_the_sides_of_the_box_are_no_outline(cut):
    """A box through the body; a body heard from one side, which has no end to the other."""
    hull = hull_around(0.02 * fibonacci_sphere(2000))
    lower = np.array([0.0 if cut else -CORNER[0], *-CORNER[1:]])
    if not cut:
        ahead = hull.emitters[:, 0] > 0
        parts = (hull.emitters, hull.receivers, hull.first, hull.axes)
        hull = EchoHull(*(each[ahead] for each in parts))
    clearance = clearance_volume(hull, lower, CORNER, SPACING)
    assert (clearance.values[0] > SPACING).any()  # at the back of the box
    # Each head hears the ball where it is nearest.
    heard = glints_at(0.02 * hull.emitters / DISTANCE, hull.emitters)
    points, _ = outline(hull, clearance, heard, np.ones(len(heard.points)))
    assert len(points) > 100
    assert np.abs(hull.clearance(points)[0]).max() < SPACING


def test_where_the_hull_has_no_surface_there_is_no_outline():
    hull = hull_around(np.zeros((1, 3)), 20)
    deaf = EchoHull(hull.emitters, hull.receivers, np.full((20, 1), -np.inf), hull.axes)
    for case in (deaf, hull_around(np.array([[0.2, 0.2, 0.2]]), 20)):
        clearance = clearance_volume(case, -CORNER, CORNER, SPACING)
        assert np.isfinite(clearance.values).all()
        points, normals = outline(case, clearance, none(), np.zeros(0))
        assert points.shape == normals.shape == (0, 3)


def test_parts_of_the_glints_make_no_difference(gap, monkeypatch):
    floor = on_the_floor()
    whole, _ = outline(*gap, floor, np.ones(len(floor.points)))
    monkeypatch.setattr(outline_module, "CHUNK", 7)
    pieces, _ = outline(*gap, floor, np.ones(len(floor.points)))
    np.testing.assert_array_equal(pieces, whole)


@pytest.mark.parametrize("spacing", [0.0026, 0.005])
def test_the_clearance_is_exact_where_the_surface_runs(gap, spacing):
    """Farther off its sign is right, which is all that a surface asks."""
    hull, _ = gap
    found = clearance_volume(hull, -CORNER, CORNER, spacing)
    grid = grid_over(-CORNER, CORNER, spacing)
    assert found.shape == grid.shape
    np.testing.assert_array_equal(found.origin, grid.origin)
    plain = hull.clearance(grid.points())[0].reshape(grid.shape)
    near = np.abs(plain) < 0.5 * spacing
    assert near.sum() > 100
    np.testing.assert_array_equal(found.values[near], plain[near])
    np.testing.assert_array_equal(found.values > 0, plain > 0)
    # Both voxels of every edge that the surface crosses.
    for axis in range(3):
        one, two = (
            plain.take(range(start, plain.shape[axis] - 1 + start), axis) for start in (0, 1)
        )
        crossed = (one > 0) != (two > 0)
        for start, values in ((0, one), (1, two)):
            there = found.values.take(range(start, plain.shape[axis] - 1 + start), axis)
            np.testing.assert_array_equal(there[crossed], values[crossed])
    # And nowhere off by more than a coarse cell's half diagonal, for its slope is at most one.
    cell = outline_module.COARSER * spacing
    assert np.abs(found.values - plain).max() < cell * np.sqrt(3) / 2


def test_most_voxels_are_not_looked_at(gap, monkeypatch):
    hull, _ = gap
    asked = []
    plain = EchoHull.clearance

    def clearance(self, points):
        asked.append(len(points))
        return plain(self, points)

    monkeypatch.setattr(EchoHull, "clearance", clearance)
    found = clearance_volume(hull, -2 * CORNER, 2 * CORNER, 0.004)
    assert sum(asked) < 0.5 * found.values.size


def test_where_no_pose_speaks_the_clearance_is_far_and_finite():
    """Far is twice the box's diagonal, more than any two places of it can differ."""
    head, axis = np.array([[DISTANCE, 0.0, 0.0]]), np.array([[-0.8, 0.6, 0.0]])
    # Looks 37 degrees off the box, and hears 37 degrees to either side: half of the box.
    hull = EchoHull(head, head[:, None], np.array([[0.5]]), axis, within=0.8)
    found = clearance_volume(hull, -CORNER, CORNER, SPACING)
    values, y = found.values.ravel(), found.points()[:, 1]
    cell = outline_module.COARSER * SPACING
    np.testing.assert_allclose(values[y < -cell], 2 * np.linalg.norm(2 * CORNER))
    assert (values[y > cell] < -0.05).all()


def test_what_a_single_pose_bounds_is_kept_beside_what_it_heard():
    """It has no neighbours, so that it looks from one side, and its ways are as wide as can be."""
    face = cuboid([0.0, -0.02, -0.02], [FACE, 0.02, 0.02])
    hull = hull_around(face, count=1)
    clearance = clearance_volume(hull, -CORNER, CORNER, SPACING)
    head = hull.sources[0]
    middle = head * (1 - hull.first[0, 0] / np.linalg.norm(head))
    heard = glints_at(middle[None] + 0.0, head[None])
    glints = Glints(heard.points, heard.normals, heard.power, np.zeros(1, int))
    points, normals = outline(hull, clearance, glints, np.ones(1))
    reach = np.linalg.norm(points - middle, axis=1)
    assert len(points) == len(normals) > 10
    assert reach.max() < outline_module.BESIDE
    apart = clearance.points()[np.abs(clearance.values.ravel()) < SPACING / 2]
    assert (
        np.linalg.norm(apart - middle, axis=1).max() > outline_module.BESIDE
    )  # it reached farther
    assert not len(outline(hull, clearance, none(), np.zeros(0))[0])
