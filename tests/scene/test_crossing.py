# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.scene.composition import surfaces_cross


def box(size, centre):
    body = trimesh.creation.box(size)
    body.apply_translation(centre)
    return body


def ball(radius, centre=(0.0, 0.0, 0.0)):
    body = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    body.apply_translation(centre)
    return body


@pytest.mark.parametrize(("gap", "cross"), [(1e-4, False), (-1e-4, True)])
def test_balls_cross_where_they_are_nearer_than_their_radii(gap, cross):
    # Both have a vertex where they come nearest, on the x axis.
    one, other = ball(0.02), ball(0.01, (0.03 + gap, 0.0, 0.0))
    assert one.bounds[1, 0] == pytest.approx(0.02, abs=1e-12)
    assert surfaces_cross(one, other) is cross
    assert surfaces_cross(other, one) is cross


@pytest.mark.parametrize(("distance", "cross"), [(0.0405, False), (0.039, True)])
def test_balls_side_by_side_cross_only_where_they_meet(distance, cross):
    # Along the diagonal their bounding boxes overlap all the same, with triangles of both inside.
    other = ball(0.02, np.full(3, distance / np.sqrt(3.0)))
    assert (ball(0.02).bounds[1] > other.bounds[0] + 0.01).all()
    assert surfaces_cross(ball(0.02), other) is cross


def test_a_needle_through_a_wide_triangle_is_found_whichever_comes_first():
    # No edge of the plate comes near the needle: only the needle's edges meet the plate.
    plate, needle = box((0.2, 0.2, 0.001), (0, 0, 0)), box((1e-3, 1e-3, 0.05), (0.031, 0.017, 0))
    assert surfaces_cross(plate, needle)
    assert surfaces_cross(needle, plate)


def test_boxes_that_share_air_only_do_not_cross():
    # Their bounding boxes overlap: a bar along the diagonal of a frame's hole.
    frame = trimesh.creation.annulus(r_min=0.05, r_max=0.06, height=0.02)
    assert not surfaces_cross(frame, box((0.03, 0.03, 0.1), (0, 0, 0)))
    assert surfaces_cross(frame, box((0.2, 0.005, 0.005), (0, 0, 0)))


def test_what_lies_wholly_inside_does_not_cross():
    assert not surfaces_cross(ball(0.02), ball(0.01))


def test_the_place_in_the_world_does_not_matter():
    far = np.array([5.0, -3.0, 2.0])
    assert surfaces_cross(ball(0.02, far), ball(0.01, far + np.array([0.0299, 0, 0])))
    assert not surfaces_cross(ball(0.02, far), ball(0.01, far + np.array([0.0301, 0, 0])))
