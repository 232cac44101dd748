# SPDX-License-Identifier: MIT
import io

import numpy as np
import pytest
import trimesh

from sononerf.errors import NumericalError
from sononerf.reconstruction.mesh import mesh_bytes


@pytest.mark.parametrize("file_type", ["ply", "stl", "glb"])
def test_a_file_reads_back_as_the_same_body_and_is_always_the_same(file_type):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.015)
    mesh.apply_translation([0.1, 0.2, 0.3])
    data = mesh_bytes(mesh, file_type)
    back = trimesh.load(io.BytesIO(data), file_type=file_type, force="mesh")
    # glTF has y up by custom, yet coordinates are written as they are.
    np.testing.assert_allclose(back.bounds, mesh.bounds, atol=1e-7)
    assert back.volume == pytest.approx(mesh.volume, rel=1e-5)
    mesh.metadata["file_name"] = "/somewhere/else.ply"
    assert mesh_bytes(mesh, file_type) == data


def test_what_cannot_be_written_is_refused():
    mesh = trimesh.creation.box()
    with pytest.raises(ValueError, match="file_type"):
        mesh_bytes(mesh, "obj")
    with pytest.raises(NumericalError, match="empty"):
        mesh_bytes(trimesh.Trimesh(), "ply")
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(NumericalError, match="not finite"):
        mesh_bytes(broken, "ply")
