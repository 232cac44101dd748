# SPDX-License-Identifier: MIT


import numpy as np
import pytest
import torch

from sononerf.echoes.free_space import EchoHull
from sononerf.field.field import Field, sphere_directions
from sononerf.surface.start.evidence import (
    AT_ONSET,
    COMPRESSION,
    Evidence,
    locate_sound,
    reliability,
)

FREQUENCY = torch.tensor([30e3, 60e3, 90e3])
RADIUS, RESOLUTION = 0.02, 0.006


class Ball(Field):
    """Lobes along the normals of a sphere around the origin; loudness by the side they are on."""

    def __init__(self, loudness=(1.0, 1.0), heard=True):
        super().__init__(torch.tensor([[-0.1] * 3, [0.1] * 3]).double(), FREQUENCY)
        self.loudness, self.heard = loudness, heard

    def audible(self, positions, sources, code=None):
        return torch.full((len(sources), len(positions)), self.heard)

    def echo(self, positions, directions, bins, place=None, code=None):
        axis = positions / positions.norm(dim=-1, keepdim=True)
        lobe = torch.exp(60 * ((axis * directions).sum(-1) - 1))
        upper, lower = self.loudness
        response = lobe * torch.where(positions[:, 2] > 0, upper, lower)
        return response[:, None].expand(-1, len(bins)), torch.zeros_like(lobe)


def places(scatter=0.0):
    found = RADIUS * sphere_directions(3000, torch.zeros(1).double())
    noise = torch.randn(found.shape, generator=torch.Generator().manual_seed(1)).double()
    return found + scatter * noise


def around(count=40):
    return (0.4 * sphere_directions(count, torch.zeros(1).double())).numpy()


def located(field, scatter=0.0, sources=None):
    given = around() if sources is None else sources
    return locate_sound(field, places(scatter), given, resolution=RESOLUTION)


def test_sound_is_put_on_the_surface_facing_its_pose():
    found = located(Ball())
    assert set(found.pose) == set(range(40))
    towards = around()[found.pose] - found.points
    np.testing.assert_allclose(
        found.normals, towards / np.linalg.norm(towards, axis=1, keepdims=True), atol=1e-9
    )
    best = found.weight > 0.8
    off = np.linalg.norm(found.points[best], axis=1) - RADIUS
    assert np.abs(off).max() < 0.4e-3


def test_places_that_scatter_in_range_share_one_echo():
    scattered, exact = located(Ball(), scatter=0.002), located(Ball())
    spread = [np.std(np.linalg.norm(e.points[e.weight > 0.8], axis=1)) for e in (scattered, exact)]
    assert spread[0] < 0.5e-3  # a quarter of the scatter of the places
    assert spread[0] < spread[1] + 0.5e-3


def test_a_quiet_side_counts_beside_a_loud_one():
    found = located(Ball(loudness=(1.0, 0.1)))  # 20 dB below
    quiet = found.points[:, 2] < -0.5 * RADIUS
    ratio = found.weight[quiet].max() / found.weight.max()
    assert ratio == pytest.approx(0.01**COMPRESSION, rel=0.25)


def test_one_very_loud_pose_does_not_silence_the_others():
    field = Ball()
    alone = located(field)
    near = np.concatenate([around(), [[0.0, 0.0, 0.4]]])
    together = located(field, sources=near)
    assert together.weight[together.pose < 40].max() == pytest.approx(alone.weight.max())


def test_a_silent_field_has_no_evidence():
    found = located(Ball(heard=False))
    assert len(found.points) == len(found.weight) == len(found.pose) == 0
    assert found.points.shape == (0, 3)


def test_progress_counts_the_poses():
    said = []
    locate_sound(
        Ball(), places(), around(3), resolution=RESOLUTION, progress=lambda *n: said.append(n)
    )
    assert said == [(1, 3), (2, 3), (3, 3)]


RADIUS, RESOLUTION, POSES = 0.02, 0.006, 150


def ball(far=0.4):
    import torch

    normals = sphere_directions(POSES, torch.zeros(1).double()).numpy()
    sources = far * normals
    hull = EchoHull(
        sources, sources[:, None], np.full((POSES, 1), far - RADIUS), -normals, within=-1.0
    )
    return Evidence(RADIUS * normals, normals, np.ones(POSES), np.arange(POSES)), hull


def without_onsets(hull):
    return EchoHull(hull.emitters, hull.receivers, np.full_like(hull.first, -np.inf), hull.axes)


def test_points_of_one_smooth_surface_bear_one_another_out():
    evidence, hull = ball()
    assert reliability(evidence, without_onsets(hull), RESOLUTION).min() > 0.5


def test_a_point_off_the_surface_is_doubted():
    evidence, hull = ball()
    moved = evidence.points.copy()
    moved[::10] *= 0.7  # as a later bounce is heard: too far from the pose
    doubted = Evidence(moved, evidence.normals, evidence.weight, evidence.pose)
    found = reliability(doubted, without_onsets(hull), RESOLUTION)
    assert found[::10].max() < 0.1
    assert np.delete(found, np.s_[::10]).min() > 0.2


def test_what_one_pose_says_twice_is_not_agreement():
    evidence, hull = ball()
    same = Evidence(evidence.points, evidence.normals, evidence.weight, np.zeros(POSES, np.intp))
    assert reliability(same, without_onsets(hull), RESOLUTION).max() == 0.0


def test_evidence_at_the_onset_is_believed_without_others():
    evidence, hull = ball()
    alone = evidence.where(np.arange(POSES) == 7)
    assert reliability(alone, hull, RESOLUTION)[0] > 0.99 * AT_ONSET
    late = Evidence(0.6 * alone.points, alone.normals, alone.weight, alone.pose)
    assert reliability(late, hull, RESOLUTION)[0] < 0.01


def test_no_evidence_no_reliability():
    evidence, hull = ball()
    assert reliability(evidence.where(np.zeros(POSES, bool)), hull, RESOLUTION).shape == (0,)
