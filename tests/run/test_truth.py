# SPDX-License-Identifier: MIT
"""A true surface comes from a file, or from the scene; a bad file is refused in one line."""

from __future__ import annotations

import pytest
import trimesh

from sononerf.errors import InputError
from sononerf.run.truth import read_truth, true_mesh


def test_a_file_comes_before_the_scene(tiny, tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.export(tmp_path / "true.ply")
    assert true_mesh(tiny()).extents == pytest.approx([0.04] * 3)
    given = tiny(evaluation={"truth": str(tmp_path / "true.ply")})
    assert true_mesh(given).extents == pytest.approx([0.1, 0.2, 0.3])


def test_without_scene_and_file_there_is_no_truth(tiny, echoes):
    assert true_mesh(tiny().model_copy(update={"scene": None})) is None


def test_a_scene_whose_file_has_moved_is_told(tiny, tmp_path, caplog):
    file = tmp_path / "mug.stl"
    trimesh.creation.box((0.1, 0.2, 0.3)).export(file)
    settings = tiny(scene={"name": "mesh", "options": {"path": str(file), "unit": "m"}})
    assert true_mesh(settings) is not None
    file.unlink()
    assert true_mesh(settings) is None
    assert "the true surface is unknown: " in caplog.text
    assert str(file) in caplog.text
    assert "evaluation.truth=FILE" in caplog.text


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("true.txt", b"x", "expected one of .ply"),
        ("true.ply", b"ply\nnonsense", "evaluation.truth: damaged"),
        ("true.obj", b"# nothing\n", "evaluation.truth: "),
        (None, b"", "no such file"),
    ],
)
def test_a_bad_true_surface_is_refused_in_one_line(tmp_path, name, content, says):
    path = tmp_path / (name or "missing.ply")
    if name:
        path.write_bytes(content)
    with pytest.raises(InputError, match=says) as raised:
        read_truth(path)
    assert "\n" not in str(raised.value)
