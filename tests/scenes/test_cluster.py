# SPDX-License-Identifier: MIT
from itertools import combinations

import numpy as np
import pytest
from sononerf_scenes.bodies import EDGE
from sononerf_scenes.cluster import GAP

from sononerf.errors import SettingsError
from sononerf.geometry.meshes import surface_faults
from sononerf.scene.scene import load_scene


def balls(mesh):
    """Centres and radii of the bodies."""
    found = []
    for part in mesh.split(only_watertight=True):
        centre = part.bounds.mean(axis=0)
        found.append((centre, np.linalg.norm(part.vertices - centre, axis=1).mean()))
    return found


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_spheres_of_mixed_radii_do_not_touch(seed):
    mesh = load_scene("cluster", {"seed": seed, "count": 8, "spread": 0.09}).mesh
    assert surface_faults(mesh) == []
    assert mesh.edges_unique_length.max() <= EDGE
    found = balls(mesh)
    assert len(found) == 8
    radii = [radius for _, radius in found]
    assert 0.01 <= min(radii) < max(radii) - 0.002 <= 0.02
    for (a, first), (b, second) in combinations(found, 2):
        assert np.linalg.norm(a - b) - first - second >= GAP - 1e-6
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0.0, atol=1e-9)
    assert mesh.extents.max() <= 0.18
    # Triangles with edges e, all corners on the sphere, lose less than e^2 / (2 r^2).
    exact = sum(4.0 / 3.0 * np.pi * radius**3 for radius in radii)
    assert 1.0 - EDGE**2 / (2.0 * 0.01**2) < mesh.volume / exact < 1.0


def test_the_seed_alone_decides():
    first, again, other = (load_scene("cluster", {"seed": seed}).mesh for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert first.vertices.shape != other.vertices.shape or (first.vertices != other.vertices).any()


def test_what_does_not_fit_is_refused():
    with pytest.raises(SettingsError, match=r"50 spheres .* do not fit into a spread of 0\.03 m"):
        load_scene("cluster", {"count": 50, "spread": 0.03})
    with pytest.raises(SettingsError, match=r"radius_min: found 0\.03; must not exceed .*0\.02"):
        load_scene("cluster", {"radius_min": 0.03})
    with pytest.raises(SettingsError, match="count"):
        load_scene("cluster", {"count": 0})
