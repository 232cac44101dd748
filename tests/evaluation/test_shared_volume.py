# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.evaluation.layered_depth import volumes
from sononerf.evaluation.solid import solid_from_mesh


def sphere(radius, centre=(0, 0, 0)):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def test_volume_of_the_union_and_of_what_is_shared():
    pair = trimesh.util.concatenate([sphere(1), sphere(1, (1.2, 0, 0))])
    union = solid_from_mesh(pair, drop_cavities=True)
    one = solid_from_mesh(sphere(1), drop_cavities=True)
    lens = np.pi * (4 + 1.2) * (2 - 1.2) ** 2 / 12
    expected = 2 * 4 / 3 * np.pi - lens
    volume, single, shared = volumes(union, one)
    # The tessellated sphere itself has 0.2 % less volume.
    assert volume == pytest.approx(expected, rel=4e-3)
    assert single == pytest.approx(sphere(1).volume, rel=2e-4)
    assert shared == pytest.approx(single, rel=1e-9)


def test_a_hollow_takes_no_space():
    hollow = sphere(0.4)
    hollow.invert()
    shell = solid_from_mesh(trimesh.util.concatenate([sphere(1), hollow]), drop_cavities=False)
    filled = solid_from_mesh(sphere(1), drop_cavities=True)
    assert volumes(shell, filled)[0] == pytest.approx(sphere(1).volume * (1 - 0.4**3), rel=1e-3)


def test_solids_apart_share_nothing():
    one, other = (
        solid_from_mesh(sphere(1, centre), drop_cavities=True) for centre in ((0, 0, 0), (3, 0, 0))
    )
    assert volumes(one, other)[2] == 0
