# SPDX-License-Identifier: MIT


import numpy as np
import pytest
import torch

from sononerf.echoes.free_space import EchoHull
from sononerf.field.field import Field, sphere_directions
from sononerf.geometry.lattice import Lattice
from sononerf.start import evidence as module
from sononerf.start.evidence import (
    AT_ONSET,
    COMPRESSION,
    Evidence,
    fitted_distance,
    locate_sound,
    reliability,
)
from sononerf.start.occupancy import clearance_grid

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


def test_of_more_places_than_memory_holds_a_part_says_the_same(monkeypatch):
    class Counted(Ball):
        def audible(self, positions, sources, code=None):
            assert len(positions) < 600  # of 3000
            return super().audible(positions, sources, code)

    monkeypatch.setattr(module, "MAX_PAIRS", 1e5)
    few = located(Counted())
    best = few.weight > 0.8
    assert np.abs(np.linalg.norm(few.points[best], axis=1) - RADIUS).max() < 1e-3


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


SIZE, MIDDLE = 32, 15.5
GRID = np.stack(np.meshgrid(*[np.arange(SIZE)] * 3, indexing="ij"), axis=-1) - MIDDLE
AWAY = np.linalg.norm(GRID, axis=-1).astype(np.float32)
NONE = np.zeros((SIZE,) * 3, np.float32)


def solve(weight=NONE, target=NONE, bound=None, pull=1e-3, empty=NONE):
    if bound is None:
        bound = AWAY - 14
    return fitted_distance(weight, target, bound, pull, empty, 1.0)


def test_without_evidence_the_body_reaches_as_far_as_it_may():
    found = solve(pull=0.1)
    near = (np.abs(AWAY - 14) < 2) & (np.abs(GRID) < 13).all(axis=-1)
    assert np.abs(found - (AWAY - 14))[near].max() < 0.7


def test_evidence_draws_the_surface_inside_of_the_bound():
    shell = (np.abs(AWAY - 9) < 1.5).astype(np.float32)
    found = solve(shell, AWAY - 9)
    inside = AWAY[found < 0]
    assert inside.max() < 10
    assert np.abs(found[shell > 0] - (AWAY - 9)[shell > 0]).max() < 0.5


def test_between_evidence_the_surface_goes_on_smoothly():
    shell = (np.abs(AWAY - 9) < 1.5) & (np.abs(GRID[..., 2]) > 3)
    found = solve(shell.astype(np.float32), AWAY - 9, pull=1e-5)
    line = found[:, 15, 15]
    outermost = np.interp(0, line[16:], np.arange(16, SIZE) - MIDDLE)
    assert outermost == pytest.approx(9, abs=1.0)  # where nothing was heard, between two caps


def test_free_space_wins_over_evidence_in_front_of_it():
    shell = (np.abs(AWAY - 13) < 1.5).astype(np.float32)
    found = solve(0.2 * shell, AWAY - 13, bound=AWAY - 9)
    assert AWAY[found < 0].max() < 11


def test_what_is_far_off_the_surface_hardly_counts():
    shell = (np.abs(AWAY - 9) < 1.5).astype(np.float32)
    wrong = AWAY - 9
    wrong[:, :, 12:14] += 12.0
    found = solve(shell, wrong)
    clean = solve(shell, AWAY - 9)
    assert np.abs(found - clean)[shell > 0].mean() < 0.5


def test_a_place_that_is_empty_is_carved_out():
    ahead = (GRID[..., 2] > 3).astype(np.float32)
    assert (solve(pull=0.01)[..., 24] < 0).any()
    assert not (solve(pull=0.01, empty=0.1 * ahead)[..., 24] < 0).any()


def test_the_clearance_is_exact_near_the_surface_and_has_the_right_sign_elsewhere():
    sources = np.array([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]])
    first = np.full((4, 1), 0.28)
    hull = EchoHull(sources, sources[:, None], first, -sources / 0.3)
    lattice = Lattice.over(np.full(3, -0.03), np.full(3, 0.03), 0.002)
    found = clearance_grid(hull, lattice).ravel()
    exact = hull.clearance(lattice.points())[0]
    near = np.abs(exact) < 0.004
    np.testing.assert_allclose(found[near], exact[near], atol=1e-12)
    assert (np.sign(found) == np.sign(exact)).all()


def test_where_no_pose_says_anything_all_is_behind():
    source = np.array([[0.3, 0, 0]])
    hull = EchoHull(source, source[:, None], np.full((1, 1), -np.inf), -source / 0.3)
    lattice = Lattice.over(np.full(3, -0.01), np.full(3, 0.01), 0.002)
    found = clearance_grid(hull, lattice)
    assert (found > 0).all()
    assert np.isfinite(found).all()
