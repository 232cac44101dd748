# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.reconstruction import confidence
from sononerf.reconstruction.confidence import (
    MANY_POSES,
    confidence_colours,
    linear_light,
    poses_that_saw,
)
from sononerf.reconstruction.glints import Glints

RADIUS = 0.03


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)


def glints_at(points, normals, pose):
    points, normals = np.atleast_2d(points).astype(float), np.atleast_2d(normals).astype(float)
    return Glints(points, normals, np.ones(len(points)), np.asarray(pose, dtype=np.intp))


def by_a_loop(mesh, glints, reach, tolerance):
    counts = []
    for vertex, normal in zip(mesh.vertices, mesh.vertex_normals, strict=True):
        seen = set()
        for point, other, pose in zip(glints.points, glints.normals, glints.pose, strict=True):
            mean = (normal + other) / np.linalg.norm(normal + other)
            near = np.linalg.norm(point - vertex) <= reach
            if near and normal @ other >= 0.5 and abs((point - vertex) @ mean) <= tolerance:
                seen.add(int(pose))
        counts.append(len(seen))
    return counts


@pytest.mark.parametrize("at_once", [4096, 50])
def test_it_counts_as_a_slow_loop_does(ball, monkeypatch, at_once):
    monkeypatch.setattr(confidence, "VERTICES_AT_ONCE", at_once)
    generator = np.random.default_rng(1)
    normals = generator.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * (RADIUS + generator.normal(0, 0.004, (300, 1)))
    turned = normals + generator.normal(0, 0.5, (300, 3))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    glints = glints_at(points, turned, 7 * generator.integers(0, 12, 300))
    expected = by_a_loop(ball, glints, 0.01, 0.003)
    assert max(expected) > 5
    np.testing.assert_array_equal(poses_that_saw(ball, glints), expected)


def test_a_pose_counts_once_and_only_around_its_glints(ball):
    top = [0, 0, RADIUS]
    glints = glints_at([top, top, top], [[0, 0, 1]] * 3, [4, 4, 9])
    counts = poses_that_saw(ball, glints)
    near = np.linalg.norm(ball.vertices - top, axis=1) <= 0.01
    assert (counts[near] == 2).all()
    assert (counts[~near] == 0).all()


def test_no_glints_bear_out_nothing(ball):
    counts = poses_that_saw(ball, glints_at(np.zeros((0, 3)), np.zeros((0, 3)), []))
    assert counts.shape == (len(ball.vertices),)
    assert not counts.any()


@pytest.mark.parametrize("wrong", [{"reach": 0.0}, {"tolerance": -1.0}])
def test_wrong_distances_are_refused(ball, wrong):
    with pytest.raises(ValueError, match="above 0"):
        poses_that_saw(ball, glints_at([0, 0, 1], [0, 0, 1], [0]), **wrong)


def test_colours_brighten_evenly_from_grey_to_yellow():
    colours = confidence_colours([0, 1, 3, 10, 30, MANY_POSES, 10 * MANY_POSES])
    assert ((colours >= 0) & (colours <= 1)).all()
    assert np.ptp(colours[0]) < 0.05
    assert colours[-2, 0] > 0.85
    assert colours[-2, 2] < 0.7
    np.testing.assert_array_equal(colours[-2], colours[-1])
    # The eye's lightness, CIE L*, from relative luminance: a rule that the map was not made with.
    even = np.expm1(np.linspace(0, 1, 9) * np.log1p(MANY_POSES))
    luminance = linear_light(confidence_colours(even)) @ [0.2126, 0.7152, 0.0722]
    lightness = 116 * np.cbrt(luminance) - 16
    steps = np.diff(lightness)
    assert steps.min() > 0.8 * steps.mean()
    assert steps.max() < 1.2 * steps.mean()
    assert lightness[0] < 30
    assert lightness[-1] > 85
