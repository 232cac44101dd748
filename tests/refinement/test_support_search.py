# SPDX-License-Identifier: MIT
"""A support that a fit did not know is found from the image below the bumpy."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError
from sononerf.geometry.poses import cylinder_poses
from sononerf.refinement.optics import Optics
from sononerf.refinement.self_calibration import find_support, least, with_support
from sononerf.refinement.tracer import StillSurface
from tests.memory import echoes_of
from tests.refinement.conftest import RADIUS

HEIGHT = -1.1 * RADIUS


@pytest.fixture
def heard(bumpy, optics):
    """Poses of a turntable that hear the body and its image, in recordings of unknown level."""
    standing = Optics(with_support(optics.head, HEIGHT))
    poses = cylinder_poses(
        12, radius=0.3, heights=(0.0, 0.2), aim_jitter=0.0, generator=np.random.default_rng(0)
    )
    magnitude = 0.3 * StillSurface(bumpy, standing).render(poses.positions, poses.rotations)
    return echoes_of(
        optics.head,
        poses.positions,
        poses.rotations,
        lambda pose: magnitude[pose],
        np.zeros(12, dtype=int),
        origin="recorded",
    )


@pytest.mark.slow
def test_it_is_found_below_a_body_and_its_image(bumpy, heard):
    image = trimesh.Trimesh(
        bumpy.vertices * [1, 1, -1] + [0, 0, 2 * HEIGHT], bumpy.faces[:, ::-1], process=False
    )
    shares = []
    height, deviation = find_support(trimesh.util.concatenate([bumpy, image]), heard, shares.append)
    resolution = heard.head.resolution
    # The body is two range resolutions wide.
    assert height == pytest.approx(HEIGHT, abs=0.5 * resolution)
    assert 0.1 * resolution < deviation < resolution
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_a_flat_surface_is_refused(heard):
    plate = trimesh.creation.box((0.05, 0.05, 0.004))
    with pytest.raises(InputError, match="too flat to tell what it stands on"):
        find_support(plate, heard, lambda share: None)


def test_the_least_value_lies_between_those_of_a_parabola():
    at = np.arange(6.0)
    assert least((at - 2.3) ** 2) == pytest.approx(2.3)
    assert least(at) == 0.0
    assert least(-at) == 5.0
