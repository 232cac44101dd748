# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.surface.refine.planes import flat_parts, planes_of
from sononerf.surface.refine.remesh import remesh

SIDES = (0.06, 0.04, 0.03)
EDGE = 1.5e-3
TOLERANCE = 1e-3
LEAST = 5e-5


def turned_box():
    found = trimesh.creation.box(SIDES)
    turn = trimesh.transformations.euler_matrix(0.3, 0.8, 1.9)
    return found.apply_transform(turn)


def worn_down(box):
    """Return a box with rounded edges, and waves of half a millimetre on its faces."""
    found = remesh(box.subdivide_to_size(2e-3), EDGE, 1.5e-3)
    places = np.asarray(found.vertices)
    wave = 4e-4 * np.sin(places @ np.array([250.0, 120.0, 90.0]))
    moved = places + wave[:, None] * np.asarray(found.vertex_normals)
    return trimesh.Trimesh(moved, found.faces, process=False)


@pytest.fixture(scope="module")
def box():
    return turned_box()


@pytest.fixture(scope="module")
def worn(box):
    return worn_down(box)


def test_a_worn_box_has_its_six_faces(box, worn):
    part = flat_parts(worn, TOLERANCE, LEAST)
    normal, offset = planes_of(worn, part, TOLERANCE)
    assert len(normal) == 6
    alike = normal @ np.asarray(box.facets_normal).T
    assert np.degrees(np.arccos(alike.max(axis=1))).max() < 1.0
    wanted = np.asarray(box.facets_origin) * np.asarray(box.facets_normal)
    assert np.allclose(offset, wanted.sum(axis=1)[alike.argmax(axis=1)], atol=2e-4)


def test_the_parts_do_not_depend_on_where_the_box_lies(worn):
    turned = worn.copy().apply_translation([0.3, -0.2, 0.1])
    first, second = (flat_parts(mesh, TOLERANCE, LEAST) for mesh in (worn, turned))
    assert len(np.unique(np.stack([first, second], axis=1), axis=0)) == first.max() + 1


def test_small_parts_are_given_away(worn):
    many = flat_parts(worn, 0.2 * TOLERANCE, 0.0)
    fewer = flat_parts(worn, 0.2 * TOLERANCE, LEAST)
    area = np.bincount(fewer, worn.area_faces)
    assert fewer.max() < many.max()
    assert area.min() >= LEAST


def test_the_sides_of_a_thin_plate_stay_apart():
    plate = trimesh.creation.box((0.05, 0.04, 1e-3)).subdivide_to_size(2e-3)
    part = flat_parts(plate, TOLERANCE, LEAST)
    up = np.asarray(plate.face_normals)[:, 2]
    assert not set(part[up > 0.9]) & set(part[up < -0.9])


def test_a_smooth_body_has_many_parts():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    assert flat_parts(ball, 3e-4, 0.0).max() > 20
