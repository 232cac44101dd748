# SPDX-License-Identifier: MIT
import numpy as np

from sononerf.echoes.free_space import EchoHull
from sononerf.field.field import sphere_directions
from sononerf.surface.start.evidence import Evidence
from sononerf.surface.start.reliability import AT_ONSET, reliability

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
