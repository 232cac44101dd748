# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.evaluation import layered_depth as columns
from sononerf.evaluation.layered_depth import crossings, inside_intervals

AXIS = np.linspace(-1.2, 1.2, 101)


def lengths(mesh, axis=AXIS):
    line, start, stop = inside_intervals(crossings(mesh.vertices, mesh.faces, axis, axis))
    total = np.bincount(line, weights=stop - start, minlength=len(axis) ** 2)
    return total.reshape(len(axis), len(axis))


def test_chords_of_a_sphere():
    mesh = trimesh.creation.icosphere(subdivisions=5)
    y, z = np.meshgrid(AXIS, AXIS, indexing="ij")
    chord = 2 * np.sqrt(np.maximum(1 - y**2 - z**2, 0))
    inner = y**2 + z**2 < 0.9
    np.testing.assert_allclose(lengths(mesh)[inner], chord[inner], atol=2e-3)
    assert (lengths(mesh)[y**2 + z**2 > 1] == 0).all()


def test_every_line_that_enters_leaves():
    mesh = trimesh.creation.torus(0.7, 0.3)
    found = crossings(mesh.vertices, mesh.faces, AXIS + 1e-4, AXIS - 1e-4)
    assert len(found.line)
    balance = np.bincount(found.line, weights=np.where(found.entering, 1, -1))
    assert (balance == 0).all()


def test_overlap_counts_once_and_a_hollow_not_at_all():
    one = trimesh.creation.box((2, 1, 1))
    other = trimesh.creation.box(
        (2, 1, 1), transform=trimesh.transformations.translation_matrix((1, 0, 0))
    )
    hollow = trimesh.creation.box((0.5, 0.5, 0.5))
    hollow.invert()
    axis = np.array([-0.3, 0.01, 0.32])
    union = lengths(trimesh.util.concatenate([one, other]), axis)
    np.testing.assert_allclose(union, 3)
    shell = lengths(trimesh.util.concatenate([one, hollow]), axis)
    assert shell[1, 1] == pytest.approx(1.5)
    assert shell[0, 0] == pytest.approx(2)


def test_weights_give_the_place_of_the_crossing():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    found = crossings(mesh.vertices, mesh.faces, AXIS, AXIS)
    corners = mesh.vertices[mesh.faces[found.face]]
    weights = np.stack([1 - found.second - found.third, found.second, found.third], axis=1)
    places = np.einsum("nc,nci->ni", weights, corners)
    row, column = np.divmod(found.line, len(AXIS))
    np.testing.assert_allclose(places[:, 0], found.depth, atol=1e-12)
    np.testing.assert_allclose(places[:, 1:], np.stack([AXIS[row], AXIS[column]], 1), atol=1e-12)


def test_chunks_change_nothing(monkeypatch):
    mesh = trimesh.creation.icosphere(subdivisions=2)
    whole = lengths(mesh)
    monkeypatch.setattr(columns, "CHUNK_PAIRS", 50)
    np.testing.assert_array_equal(lengths(mesh), whole)


def test_lines_that_miss_find_nothing():
    mesh = trimesh.creation.box()
    found = crossings(mesh.vertices, mesh.faces, AXIS + 10, AXIS)
    assert len(found.line) == 0
    assert len(inside_intervals(found)[0]) == 0


def test_lines_through_edges_and_corners_enter_and_leave_once():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    cube = trimesh.creation.box((2, 1, 1)).subdivide().subdivide()
    axis = np.linspace(-0.5, 0.5, 17)  # the cube's corners lie on every line
    for body in (mesh, cube):
        found = crossings(body.vertices, body.faces, axis, axis)
        balance = np.bincount(found.line, weights=np.where(found.entering, 1, -1))
        assert (balance == 0).all()
        assert np.bincount(found.line).max() == 2
    inner = lengths(cube, axis)[1:-1, 1:-1]
    np.testing.assert_allclose(inner, 2)
