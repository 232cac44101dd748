# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.start.evidence import NEIGHBOUR_RADIUS, Evidence, poses_that_heard

RADIUS, RESOLUTION = 0.03, 0.005


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)


def evidence_at(points, normals, pose):
    points, normals = np.atleast_2d(points).astype(float), np.atleast_2d(normals).astype(float)
    return Evidence(points, normals, np.ones(len(points)), np.asarray(pose, dtype=np.intp))


def test_a_pose_counts_once_and_only_around_its_points(ball):
    top = [0, 0, RADIUS]
    evidence = evidence_at([top, top, top], [[0, 0, 1]] * 3, [4, 4, 9])
    counts = poses_that_heard(ball, evidence, RESOLUTION)
    near = np.linalg.norm(ball.vertices - top, axis=1) <= NEIGHBOUR_RADIUS * RESOLUTION
    assert (counts[near] == 2).all()
    assert (counts[~near] == 0).all()


def test_without_evidence_no_pose_heard_anything(ball):
    nothing = evidence_at(np.zeros((0, 3)), np.zeros((0, 3)), [])
    counts = poses_that_heard(ball, nothing, RESOLUTION)
    assert counts.shape == (len(ball.vertices),)
    assert not counts.any()
