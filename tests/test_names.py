# SPDX-License-Identifier: MIT
"""The public names: all are there, each is what it says, and none is imported too early."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import trimesh

import sononerf
from sononerf.errors import InputError, SettingsError


def test_all_names_are_there_and_have_docstrings():
    assert dir(sononerf) == sononerf.__all__
    for name in set(sononerf.__all__) - {"__version__"}:
        found = getattr(sononerf, name)
        assert found.__name__ == name
        assert found.__doc__
    with pytest.raises(AttributeError, match="has no attribute 'Scenes'"):
        sononerf.Scenes  # noqa: B018


def test_an_import_of_the_package_imports_nothing_else():
    script = (
        "import sys, sononerf; print(sorted({'numpy', 'torch', 'trimesh'} & set(sys.modules)));"
        "sononerf.Poses; print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout == "[]\nFalse\n", done.stderr


def test_a_scene_of_a_file_has_its_unit_and_material(tmp_path):
    trimesh.creation.box((10.0, 20.0, 30.0)).export(tmp_path / "box.stl")
    scene = sononerf.Scene.load(tmp_path / "box.stl", unit="mm", material="leaf")
    np.testing.assert_allclose(scene.mesh.extents, (0.01, 0.02, 0.03))
    with pytest.raises(InputError, match="states no unit"):
        sononerf.Scene.load(tmp_path / "box.stl")
    with pytest.raises(SettingsError, match="unknown"):
        sononerf.Scene.load(tmp_path / "box.stl", unit="mm", colour="red")


def test_a_section_of_the_head_that_has_another_name_is_told():
    with pytest.raises(SettingsError, match="unknown section 'analysis'; did you mean spectrogram"):
        sononerf.Head(analysis={"window": 64})


def test_a_boolean_split_is_refused():
    """True would be 1, which is validation."""
    head, poses = sononerf.Head(), sononerf.Poses.sphere(4, radius=0.4)
    heard = np.ones((4, 2, len(head.range), len(head.frequency)))
    with pytest.raises(InputError, match="split: found True, expected train, val or test"):
        sononerf.Echoes.from_arrays(heard, poses, head, split=[True, True, False, False])


def test_testing_is_reached_by_its_name():
    assert sononerf.testing.check_field
