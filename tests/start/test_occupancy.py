# SPDX-License-Identifier: MIT


from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from sononerf.echoes.free_space import EchoHull
from sononerf.errors import NumericalError
from sononerf.field.field import Field, sphere_directions
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.geometry.lattice import Lattice
from sononerf.start import occupancy
from sononerf.start.evidence import poses_that_heard
from sononerf.start.occupancy import (
    estimate_occupancy,
    gather_evidence,
    planes,
    thinness,
    winding_of,
)

RADIUS, RESOLUTION, SPACING, FAR = 0.012, 0.006, 0.002, 0.4
LOWER, UPPER = np.array([-0.05, -0.03, -0.03]), np.array([0.05, 0.03, 0.03])


class Bodies(Field):
    """Lobes along given normals at given places."""

    def __init__(self, places, normals):
        super().__init__(torch.tensor(np.stack([LOWER, UPPER])), torch.tensor([30e3, 60e3, 90e3]))
        self.places, self.normals = places, normals

    def audible(self, positions, sources, code=None):
        rays = sources[:, None] - positions
        return (rays / rays.norm(dim=-1, keepdim=True) * self.normals).sum(-1) > 0.9

    def echo(self, positions, directions, bins, place=None, code=None):
        which = torch.cdist(positions, self.places).argmin(1)
        cosine = (self.normals[which] * directions).sum(-1)
        response = torch.exp(80 * (cosine - 1))
        return response[:, None].expand(-1, len(bins)), torch.zeros_like(cosine)


def spheres(*middles):
    normals = sphere_directions(600, torch.zeros(1).double())
    places = [torch.tensor(m).double() + RADIUS * normals for m in middles]
    return torch.cat(places), normals.repeat(len(middles), 1)


def leaf():
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 31), np.linspace(-0.02, 0.02, 21))
    places = np.stack([x.ravel(), y.ravel(), 0.002 * np.sin(40 * x.ravel())], axis=1)
    slope = np.stack([-0.08 * np.cos(40 * x.ravel()), 0 * x.ravel(), 1 + 0 * x.ravel()], axis=1)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    places = np.concatenate([places + 1e-6 * slope, places - 1e-6 * slope])
    return torch.tensor(places), torch.tensor(np.concatenate([slope, -slope]))


def hull_of(places, sources):
    first = torch.cdist(torch.tensor(sources), places).min(dim=1).values.numpy()[:, None]
    return EchoHull(sources, sources[:, None], first, -sources / FAR)


def confidence_of(known, found):
    return poses_that_heard(found, known.evidence, RESOLUTION)


def around(count=150):
    return (FAR * sphere_directions(count, torch.zeros(1).double())).numpy()


def gathered(places, normals, sources=None, hull=None, field=None):
    sources = around() if sources is None else sources
    hull = hull or hull_of(places, sources)
    field = field or Bodies(places, normals)
    return gather_evidence(field, places, hull, LOWER, UPPER, SPACING, RESOLUTION)


@pytest.fixture(scope="module")
def two():
    return gathered(*spheres((-0.025, 0.0, 0.0), (0.025, 0.0, 0.0)))


def off_spheres(mesh):
    away = [np.linalg.norm(mesh.vertices - [x, 0, 0], axis=1) - RADIUS for x in (-0.025, 0.025)]
    return np.min(np.abs(away), axis=0)


def test_two_spheres_are_two_although_the_onsets_leave_a_bridge(two):
    assert two.bound[two.lattice.shape[0] // 2].min() < -1  # a film between them
    found = estimate_occupancy(two, "open")
    assert found.body_count == 2
    assert found.is_watertight
    assert found.volume == pytest.approx(2 * 4 / 3 * np.pi * RADIUS**3, rel=0.15)
    assert off_spheres(found).mean() < 0.6e-3


def test_every_vertex_says_how_many_poses_heard_it(two):
    found = estimate_occupancy(two, "open")
    assert confidence_of(two, found).shape == (len(found.vertices),)
    assert np.median(confidence_of(two, found)) >= 3


def test_a_flat_face_that_nobody_faces_lies_along_the_onsets():
    box = trimesh.creation.box((0.05, 0.036, 0.03))
    places = torch.tensor(np.asarray(trimesh.sample.sample_surface(box, 6000, seed=1)[0]))
    silent = Bodies(places[:1], torch.tensor([[1.0, 0, 0]]).double())
    silent.audible = lambda positions, sources, code=None: torch.zeros(
        len(sources), len(positions), dtype=torch.bool
    )
    known = gathered(places, None, field=silent)
    found = estimate_occupancy(known, "filled")
    assert found.body_count == 1
    assert found.volume == pytest.approx(box.volume, rel=0.25)
    assert (confidence_of(known, found) == 0).all()


def test_a_sheet_is_one_thin_solid_with_two_sides():
    found = estimate_occupancy(gathered(*leaf()), "filled")
    assert found.body_count == 1
    inner = np.abs(found.vertices[:, 0]) < 0.02
    inner &= np.abs(found.vertices[:, 1]) < 0.012
    height = found.vertices[inner, 2] - 0.002 * np.sin(40 * found.vertices[inner, 0])
    assert np.abs(height).mean() < 1.2e-3
    up = found.vertex_normals[inner, 2]
    assert (up > 0.7).any()
    assert (up < -0.7).any()


def test_nothing_heard_is_told():
    places, normals = spheres((0.0, 0.0, 0.0))
    sources = around(10)
    mute = hull_of(places, sources)
    mute = EchoHull(mute.emitters, mute.receivers, np.full((10, 1), -np.inf), mute.axes)
    field = Bodies(places, normals)
    field.audible = lambda positions, sources, code=None: torch.zeros(
        len(sources), len(positions), dtype=torch.bool
    )
    with pytest.raises(NumericalError, match="no pose heard an echo"):
        gathered(places, normals, sources=sources, hull=mute, field=field)


def test_onsets_that_leave_no_room_are_told():
    places, normals = spheres((0.0, 0.0, 0.0))
    sources = around(40)
    hull = EchoHull(sources, sources[:, None], np.full((40, 1), FAR + 0.1), -sources / FAR)
    with pytest.raises(NumericalError, match="no room for a body"):
        estimate_occupancy(gathered(places, normals, sources=sources, hull=hull))


def test_the_onsets_alone_leave_the_bridge(two):
    found = estimate_occupancy(two, "hull")
    assert found.body_count == 1
    assert found.is_watertight
    # The mesh lies on the boundary of free space, neither thickened nor thinned.
    assert np.abs(two.hull.clearance(found.vertices)[0]).mean() < SPACING / 20
    assert found.volume > 1.3 * estimate_occupancy(two, "open").volume


def test_the_onsets_alone_do_not_make_a_sheet_thicker():
    known = gathered(*leaf())
    assert known.thin.max() > 0.5
    found = estimate_occupancy(known, "hull")
    inner = np.abs(found.vertices[:, :2]).max(axis=1) < 0.01
    assert np.abs(known.hull.clearance(found.vertices[inner])[0]).mean() < SPACING / 50


def test_a_part_that_no_pose_hears_stays_in_the_hull_alone():
    """Two spheres are seen by the onsets; the field sounds from one of them."""
    middles = (-0.025, 0.0, 0.0), (0.025, 0.0, 0.0)
    both, one = spheres(*middles), spheres(middles[0])
    known = gathered(*one, hull=hull_of(both[0], around(600)), sources=around(600))
    hull = estimate_occupancy(known, "hull")
    assert hull.bounds[1, 0] == pytest.approx(0.025 + RADIUS, abs=SPACING)
    assert (confidence_of(known, hull)[hull.vertices[:, 0] > 0.025] == 0).all()


def test_a_crumb_that_is_full_of_evidence_does_not_remove_the_body():
    """Evidence per area is compared with that of the part with most evidence."""
    lattice = Lattice.over(np.zeros(3), np.full(3, 0.05), 0.001)
    distance = np.ones(lattice.shape, np.float32)
    distance[5:45, 5:45, 5:45], distance[50:53, 50:53, 50:53] = -1, -1
    places = np.concatenate((np.full((30, 3), 25), np.full((20, 3), 51)))
    normals = np.zeros((50, 3))
    known = SimpleNamespace(
        lattice=lattice,
        points=lattice.origin + 0.001 * places,
        evidence=SimpleNamespace(normals=normals),
        weight=np.ones(50),
    )
    left = occupancy.without_parts(distance, known.lattice, known)
    assert (left[5:45, 5:45, 5:45] < 0).all()


SPACING, RADIUS = 0.002, 0.016
LATTICE = Lattice.over(np.full(3, -0.03), np.full(3, 0.03), SPACING)
NOTHING = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)


def sphere():
    normals = fibonacci_sphere(1500)
    return RADIUS * normals, normals, np.ones(len(normals))


def sides(thickness, outward=True):
    """Two flat sides that look away from each other, or at each other over a gap."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(-0.02, 0.0201, 0.001)] * 2))
    top = np.stack((x, y, np.full(len(x), thickness / 2)), axis=1)
    up = np.tile([0.0, 0.0, 1.0 if outward else -1.0], (len(x), 1))
    bottom = top * [1, 1, -1]
    return np.concatenate((top, bottom)), np.concatenate((up, -up)), np.ones(2 * len(x))


def value(grid, *place):
    return LATTICE.read(grid, np.array([place]))[0]


@pytest.mark.parametrize(
    ("thickness", "outward", "expected"),
    [(0.0005, True, 1.0), (0.002, True, 1.0), (0.016, True, 0.0), (0.004, False, 0.0)],
)
def test_only_what_has_its_other_side_close_behind_it_is_thin(thickness, outward, expected):
    thin = thinness(LATTICE, *sides(thickness, outward))
    assert value(thin, 0, 0, thickness / 2) == pytest.approx(expected, abs=0.1)
    assert ((thin >= 0) & (thin <= 1.0001)).all()


def test_a_sphere_is_not_thin():
    assert thinness(LATTICE, *sphere()).max() < 0.05


def test_near_a_sphere_the_distance_to_its_planes_is_known():
    known, target = planes(LATTICE, *sphere())
    distance = np.linalg.norm(LATTICE.points(), axis=1).reshape(LATTICE.shape) - RADIUS
    near = np.abs(distance) < SPACING
    assert known[near].min() > 0.5
    np.testing.assert_allclose(target[near], distance[near] / SPACING, atol=0.2)
    assert known[np.abs(distance) > 4 * SPACING].max() < 1e-3
    assert known.max() <= 1


def test_the_winding_number_tells_inside_from_outside_however_loud_the_places_are():
    points, normals, weight = sphere()
    loud = weight * np.where(points[:, 0] > 0, 1.0, 0.2)
    for some in (weight, loud):
        winding = winding_of(LATTICE, points, normals, some)
        assert value(winding, 0, 0, 0) == pytest.approx(1.0, abs=0.25)
        assert abs(value(winding, 0.026, 0, 0)) < 0.1


def test_a_gap_whose_walls_look_at_each_other_has_a_negative_winding_number():
    assert value(winding_of(LATTICE, *sides(0.012, outward=False)), 0, 0, 0) < -0.3
    assert value(winding_of(LATTICE, *sides(0.012)), 0, 0, 0) > 0.3


def test_without_points_nothing_is_known():
    assert not thinness(LATTICE, *NOTHING).any()
    known, target = planes(LATTICE, *NOTHING)
    assert not known.any()
    assert not target.any()
