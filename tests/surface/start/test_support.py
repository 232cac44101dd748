# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.surface.start import evidence as support
from sononerf.surface.start.evidence import ALIGNED, REACH, Evidence, poses_that_heard

RADIUS, RESOLUTION = 0.03, 0.005


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)


def evidence_at(points, normals, pose):
    points, normals = np.atleast_2d(points).astype(float), np.atleast_2d(normals).astype(float)
    return Evidence(points, normals, np.ones(len(points)), np.asarray(pose, dtype=np.intp))


def by_a_loop(mesh, evidence):
    counts = []
    for vertex, normal in zip(mesh.vertices, mesh.vertex_normals, strict=True):
        heard = set()
        each = zip(evidence.points, evidence.normals, evidence.pose, strict=True)
        for point, other, pose in each:
            near = np.linalg.norm(point - vertex) <= REACH * RESOLUTION
            off = abs((point - vertex) @ (normal + other))
            if near and normal @ other > 0.5 and off < 2 * ALIGNED * RESOLUTION:
                heard.add(int(pose))
        counts.append(len(heard))
    return counts


@pytest.mark.parametrize("pairs", [2_000_000, 15_000])
def test_it_counts_as_a_slow_loop_does(ball, monkeypatch, pairs):
    monkeypatch.setattr(support, "_PAIRS", pairs)
    generator = np.random.default_rng(1)
    normals = generator.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * (RADIUS + generator.normal(0, 0.004, (300, 1)))
    turned = normals + generator.normal(0, 0.5, (300, 3))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    evidence = evidence_at(points, turned, 7 * generator.integers(0, 12, 300))
    expected = by_a_loop(ball, evidence)
    assert max(expected) > 4
    np.testing.assert_array_equal(poses_that_heard(ball, evidence, RESOLUTION), expected)


def test_a_pose_counts_once_and_only_around_its_points(ball):
    top = [0, 0, RADIUS]
    evidence = evidence_at([top, top, top], [[0, 0, 1]] * 3, [4, 4, 9])
    counts = poses_that_heard(ball, evidence, RESOLUTION)
    near = np.linalg.norm(ball.vertices - top, axis=1) <= REACH * RESOLUTION
    assert (counts[near] == 2).all()
    assert (counts[~near] == 0).all()


def test_without_evidence_no_pose_heard_anything(ball):
    nothing = evidence_at(np.zeros((0, 3)), np.zeros((0, 3)), [])
    counts = poses_that_heard(ball, nothing, RESOLUTION)
    assert counts.shape == (len(ball.vertices),)
    assert not counts.any()
