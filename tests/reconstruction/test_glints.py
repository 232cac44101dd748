# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import torch

from sononerf.field.field import Field, sphere_directions
from sononerf.reconstruction.glints import FEW_SUPPORT, Glints, find_glints, trust

FREQUENCY = torch.tensor([30e3, 50e3, 70e3, 90e3])
RADIUS = 0.02
MIDDLE = torch.tensor([0.1, -0.05, 0.02], dtype=torch.float64)


class Lobes(Field):
    """Places of spheres around some middles: exp(k (cos θ - 1)), from curvature (1 - cos θ)."""

    knows_directions = True

    def __init__(self, concentration, curvature=0.0, middles=MIDDLE[None], heard=True):
        super().__init__(torch.tensor([[-1.0] * 3, [1.0] * 3]).double(), FREQUENCY)
        self.concentration, self.curvature = concentration, curvature
        self.middles, self.heard = middles, heard

    def cosine(self, positions, directions):
        rays = positions[:, None] - self.middles
        nearest = rays.norm(dim=-1).argmin(1)
        axis = rays[torch.arange(len(rays)), nearest]
        return (axis / axis.norm(dim=-1, keepdim=True) * directions).sum(-1)

    def audible(self, positions, sources):
        rays = sources - positions  # of one emitter
        cosine = self.cosine(positions, rays / rays.norm(dim=-1, keepdim=True))[None]
        return (self.concentration * (cosine - 1) > -5) & self.heard

    def echo(self, positions, directions, bins, place=None):
        assert place is None
        off = 1 - self.cosine(positions, directions)
        response = torch.exp(-self.concentration * off)
        return response[:, None].expand(-1, len(bins)), self.curvature * off


def places_of(middles=MIDDLE[None], count=8000):
    return torch.cat([middle + RADIUS * sphere_directions(count, MIDDLE) for middle in middles])


def sources_around(count=12, distance=0.4, middle=MIDDLE):
    return middle + distance * sphere_directions(count, MIDDLE)


def off_the_sphere(glints, middle=MIDDLE):
    return np.linalg.norm(glints.points - middle.numpy(), axis=1) - RADIUS


@pytest.mark.parametrize(
    ("concentration", "curvature", "shift"),
    [
        # A lobe of this width answers from R / (2 k) farther than the nearest point, 0.05 mm.
        (200.0, 0.0, 0.0),
        # A wide one from a millimetre, which the right radius of curvature makes up for.
        (10.0, RADIUS, 0.0),
        (10.0, 0.0, -RADIUS / 20),
    ],
    ids=["narrow", "wide and curved", "wide and flat"],
)
def test_glints_lie_on_the_sphere_and_face_their_poses(concentration, curvature, shift):
    sources = sources_around()
    glints = find_glints(Lobes(concentration, curvature), places_of(), sources)
    assert sorted(glints.pose) == list(range(12))
    # A tenth of a millimetre; of what a wide and flat one is off, a fifth.
    tolerance = 1e-4 if shift == 0 else 2e-4
    np.testing.assert_allclose(off_the_sphere(glints), shift, rtol=0, atol=tolerance)
    line = (sources - MIDDLE).numpy()[glints.pose]
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(glints.normals, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(glints.normals, line, rtol=0, atol=2e-3)
    assert (glints.power > 0).all()


def test_places_off_the_surface_that_sound_from_it_give_it():
    """What is read is the sound: each place lies 1.5 mm too deep and leads by as much."""

    class Deep(Lobes):
        def echo(self, positions, directions, bins, place=None):
            response, lead = super().echo(positions, directions, bins, place)
            return response, lead + 0.0015

    places = MIDDLE + (RADIUS - 0.0015) * sphere_directions(8000, MIDDLE)
    glints = find_glints(Deep(200.0), places, sources_around())
    np.testing.assert_allclose(off_the_sphere(glints), 0.0, rtol=0, atol=1e-4)


def test_two_bodies_give_each_pose_a_glint_on_either():
    middles = MIDDLE + torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.08, 0.0]], dtype=torch.float64)
    sources = MIDDLE + torch.tensor([[0.4, 0.0, 0.0], [0.35, 0.1, 0.05]], dtype=torch.float64)
    glints = find_glints(Lobes(200.0, middles=middles), places_of(middles), sources)
    off = np.stack([np.abs(off_the_sphere(glints, middle)) < 1e-4 for middle in middles])
    assert off.sum(axis=0).tolist() == [1, 1, 1, 1]
    assert [sorted(glints.pose[row]) for row in off] == [[0, 1], [0, 1]]


def test_power_is_free_of_spreading():
    """From four times as far it is 256 times fainter; what stays is how wide a cap answers."""
    sources = torch.cat((sources_around(1, 0.2), sources_around(1, 0.8)))
    near, far = find_glints(Lobes(200.0), places_of(), sources).power
    # The solid angle of places within a lobe's width of their axis: ((D - R) / D)².
    assert near / far == pytest.approx((0.9 / 0.975) ** 2, rel=0.03)


def test_where_nothing_is_heard_there_are_none():
    for places in (places_of(), places_of()[:0]):
        glints = find_glints(Lobes(200.0, heard=False), places, sources_around())
        assert glints.points.shape == glints.normals.shape == (0, 3)
        assert glints.power.shape == glints.pose.shape == trust(glints).shape == (0,)
        assert glints.pose.dtype == np.intp


def test_progress_counts_poses():
    done = []
    find_glints(
        Lobes(200.0), places_of(), sources_around(3), progress=lambda *counts: done.append(counts)
    )
    assert done == [(1, 3), (2, 3), (3, 3)]


def on_a_sphere(count=300):
    """One glint of each pose, of equal power, 4 mm from its neighbours."""
    normals = sphere_directions(count, MIDDLE).numpy()
    return Glints(RADIUS * normals, normals, np.ones(count), np.arange(count))


def changed(glints, **parts):
    return Glints(**{**vars(glints), **parts})


def by_hand(support, around, power):
    support, around = np.array(support, dtype=float), np.array(around)
    usual = np.average(support, weights=power)
    return (support / around) ** 2 * (support / (support + FEW_SUPPORT * usual)) ** 2


@pytest.mark.parametrize("shift", [0.004, -0.004])
def test_poses_bear_out_a_surface_and_not_what_lies_off_it(shift):
    true = on_a_sphere()
    # A cap of 12 mm holds 27 of 300; of their power all but one's own agrees.
    expected = by_hand([26.0], [27.0], [1.0])
    np.testing.assert_allclose(trust(true), expected.repeat(300), rtol=0.1)
    points = true.points.copy()
    points[7] += shift * true.normals[7]
    found = trust(changed(true, points=points))
    assert found[7] == 0.0
    assert np.delete(found, 7).min() > 0.8 * expected


def test_neither_the_same_pose_nor_what_faces_elsewhere_bears_out():
    true = on_a_sphere()
    assert trust(changed(true, pose=np.zeros(300, dtype=np.intp))).max() == 0.0
    normals = true.normals.copy()
    normals[7] *= -1
    assert trust(changed(true, normals=normals))[7] == 0.0
    lone = changed(true, points=10 * true.points)
    assert trust(lone).max() == 0.0


def test_who_is_louder_has_more_to_say():
    """Three on a plane, powers 1, 2 and 3, and one of 10 that is 4 mm above."""
    points = np.array([[0, 0, 0], [0.003, 0, 0], [0, 0.003, 0], [0.001, 0.001, 0.004]])
    power = np.array([1.0, 2, 3, 10])
    glints = Glints(points, np.tile([0.0, 0, 1], (4, 1)), power, np.arange(4))
    for options, support, around in (
        ({}, [5, 4, 3, 0], [16, 16, 16, 16]),
        ({"tolerance": 0.01}, [15, 14, 13, 6], [16, 16, 16, 16]),
        ({"reach": 0.0035}, [5, 1, 1, 0], [6, 3, 4, 10]),
    ):
        np.testing.assert_allclose(trust(glints, **options), by_hand(support, around, power))


def test_where_little_is_heard_little_is_trusted():
    """Two far from all others agree with each other alone, as second bounces may."""
    true = on_a_sphere()
    points = np.concatenate((true.points, [[0.1, 0.0, 0.0], [0.1, 0.003, 0.0]]))
    normals = np.concatenate((true.normals, [[1.0, 0.0, 0.0]] * 2))
    found = trust(Glints(points, normals, np.ones(302), np.arange(302)))
    usual = 26 * 300 / 302
    expected = (1 / 2) ** 2 * (1 / (1 + FEW_SUPPORT * usual)) ** 2
    np.testing.assert_allclose(found[-2:], expected, rtol=0.05)
    assert found[-1] < 0.01 * found[:300].min()


def test_some_of_the_glints():
    true = on_a_sphere()
    kept = true.points[:, 0] > true.points[:, 0].mean()
    some = true.where(kept)
    for name in ("points", "normals", "power", "pose"):
        np.testing.assert_array_equal(getattr(some, name), getattr(true, name)[kept])
    none = true.where(np.zeros(len(kept), dtype=bool))
    assert none.points.shape == none.normals.shape == (0, 3)
    assert trust(none).shape == (0,)
