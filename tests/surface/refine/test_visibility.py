# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import trimesh

from sononerf.geometry.raycast import Occlusion
from sononerf.surface.refine.visibility import FREE, StillSurface, seen


def test_what_stands_before_a_point_hides_it_but_not_what_touches_it():
    wall = trimesh.creation.box((0.001, 0.1, 0.1))
    sight = Occlusion(np.asarray(wall.vertices), np.asarray(wall.faces))
    points = np.array([[-0.05, 0.0, 0.0], [-0.001, 0.0, 0.0], [0.05, 0.0, 0.0]])
    target = np.broadcast_to([0.3, 0.0, 0.0], points.shape)
    assert seen(sight, points, target, free=0.005).tolist() == [False, True, True]
    assert seen(sight, points, target, free=0.0).tolist() == [False, False, True]


def heard(optics, mesh, at):
    surface = StillSurface(mesh, optics)
    pieces, _, _ = surface.listen(np.array([at]), np.diag([-1.0, -1.0, 1.0])[None])
    return surface.vertices[pieces.vertex].numpy(), pieces


def test_a_body_hides_the_one_behind_it(optics, ball):
    other = ball.copy()
    other.apply_translation([-0.05, 0.0, 0.0])
    places, pieces = heard(optics, trimesh.util.concatenate([ball, other]), [0.3, 0.0, 0.0])
    assert (places[:, 0] > 0).all()
    assert float(pieces.weight.min()) >= 0.0
    alone, _ = heard(optics, other, [0.3, 0.0, 0.0])
    assert len(alone) > 20


def test_the_other_side_of_a_sheet_pushed_through_hides_nothing(optics):
    sheet = trimesh.creation.box((0.0005, 0.03, 0.03))
    for _ in range(4):
        sheet = sheet.subdivide()
    vertices = np.array(sheet.vertices)
    front = vertices[:, 0] > 0
    vertices[front, 0] -= FREE * optics.wavelength  # now behind the other side
    crossed = trimesh.Trimesh(vertices, sheet.faces, process=False)
    places, _ = heard(optics, crossed, [0.3, 0.0, 0.0])
    assert len(places) > 50
