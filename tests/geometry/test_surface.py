# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.geometry.surface import corner_normals


@pytest.mark.parametrize("subdivisions", [1, 3])
def test_normals_of_a_sphere_are_exact(subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.02)
    mesh.apply_translation([1.0, 2.0, 3.0])
    expected = (mesh.triangles - [1.0, 2.0, 3.0]) / 0.02
    # Subdivision 1 has 18 degrees between triangles, below the crease.
    np.testing.assert_allclose(corner_normals(mesh), expected, atol=1e-6)


def test_a_box_keeps_its_edges():
    mesh = trimesh.creation.box((1.0, 2.0, 3.0))
    expected = np.repeat(mesh.face_normals[:, None], 3, axis=1)
    np.testing.assert_allclose(corner_normals(mesh), expected, atol=1e-12)


def test_the_crease_decides():
    mesh = trimesh.creation.box((1.0, 1.0, 1.0))
    rounded = corner_normals(mesh, crease=np.radians(100))
    np.testing.assert_allclose(rounded, np.sign(mesh.triangles) / np.sqrt(3), atol=1e-12)


def test_a_triangle_without_area_spoils_nothing():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 3, 1]], process=False)
    normals = corner_normals(mesh)
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(normals[0], [[0, 0, 1]] * 3, atol=1e-12)
