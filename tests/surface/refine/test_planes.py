# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import trimesh

from sononerf.surface.refine.planes import flat_parts, planes_of

TOLERANCE = 1e-3
LEAST = 5e-5


def test_a_worn_box_has_its_six_faces(turned_box, worn):
    part = flat_parts(worn, TOLERANCE, LEAST)
    normal, offset = planes_of(worn, part, TOLERANCE)
    assert len(normal) == 6
    alike = normal @ np.asarray(turned_box.facets_normal).T
    assert np.degrees(np.arccos(alike.max(axis=1))).max() < 1.0
    wanted = np.asarray(turned_box.facets_origin) * np.asarray(turned_box.facets_normal)
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
