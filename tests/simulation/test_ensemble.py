# SPDX-License-Identifier: MIT
import hashlib
import os
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest
import trimesh

from sononerf.errors import InputError, NumericalError, ResourceError, SonoNerfError
from sononerf.geometry.poses import Poses, look_at
from sononerf.run.simulate import simulator_of
from sononerf.scene.scene import Scene, check_aim, check_positions, check_reach, load_scene
from sononerf.settings.loading import validate_settings
from sononerf.simulation.ensemble import simulate_ensemble
from sononerf.simulation.simulator import ensemble_poses, pose_seed

SEED_OF = partial(pose_seed, 5)


def settings(**sections):
    return validate_settings({"scene": {"name": "sphere"}, **sections}, "test")


@pytest.fixture(scope="module")
def small():
    found = settings(
        simulation={"rays": 2000, "sources": 60}, poses={"count": 4, "validation": 1, "heldout": 1}
    )
    return simulator_of(load_scene("sphere"), found), ensemble_poses(found.poses)[0]


def test_poses_of_a_cylinder_look_level_at_its_axis():
    wanted = {"arrangement": "cylinder", "radius": 0.8, "heights": [0.1, 0.5], "count": 40}
    poses, split = ensemble_poses(settings(poses={**wanted, "aim_jitter_deg": 0.0}).poses)
    np.testing.assert_allclose(np.linalg.norm(poses.positions[:, :2], axis=1), 0.8)
    for number in (0, 1, 2):
        height = poses.positions[split == number][:, 2]
        assert 0.1 <= height.min() < 0.2 < 0.4 < height.max() <= 0.5
    inward = -poses.positions[:, :2] / 0.8
    np.testing.assert_allclose(poses.rotations[:, :2, 0], inward, atol=1e-12)
    np.testing.assert_allclose(poses.rotations[:, 2, 2], 1.0)


def test_poses_on_the_sphere_are_those_of_the_first_release():
    poses, split = ensemble_poses(settings().poses)
    rounded = [(np.round(v, 9) + 0.0).tobytes() for v in (poses.positions, poses.rotations)]
    found = hashlib.sha256(b"".join(rounded) + split.tobytes()).hexdigest()
    assert found == "917fc6f168f229fd2c8784c18f3219f5a59ce2e9f77726648c659fa318f1d5aa"


CAP = {"arrangement": "cap", "axis": [0.0, -1.0, 1.0], "half_angle_deg": 40.0}
VOLUME = {"arrangement": "volume", "radius_max": 0.8}


@pytest.mark.parametrize("chosen", [CAP, VOLUME, {**VOLUME, "half_angle_deg": 40.0}])
def test_all_sets_of_an_arrangement_lie_in_the_same_place(chosen):
    wanted = {**chosen, "count": 300, "validation": 200, "heldout": 200, "aim_jitter_deg": 0}
    poses, split = ensemble_poses(settings(poses=wanted).poses)
    assert np.bincount(split).tolist() == [300, 200, 200]
    distance = np.linalg.norm(poses.positions, axis=1)
    axis = np.array(chosen.get("axis", [1.0, 0.0, 0.0]))
    angle = np.degrees(np.arccos(poses.positions @ axis / np.linalg.norm(axis) / distance))
    for member in range(3):
        some = split == member
        assert angle[some].max() <= chosen.get("half_angle_deg", 180.0) + 1e-9
        assert angle[some].max() > 0.9 * chosen.get("half_angle_deg", 180.0)
        if "radius_max" in chosen:
            assert distance[some].min() > 0.4
            assert distance[some].max() < 0.8
            # half of the volume lies beyond this radius; 200 draws give the share to 0.035
            outer = distance[some] > ((0.4**3 + 0.8**3) / 2) ** (1 / 3)
            assert outer.mean() == pytest.approx(0.5, abs=0.12)
        else:
            np.testing.assert_allclose(distance[some], 0.4)
    np.testing.assert_allclose(
        poses.rotations[:, :, 0], -poses.positions / distance[:, None], atol=1e-9
    )
    more = ensemble_poses(settings(poses={**wanted, "count": 310, "validation": 0}).poses)[0]
    np.testing.assert_array_equal(more[310:].positions, poses[500:].positions)
    other = ensemble_poses(settings(poses={**wanted, "seed": 1}).poses)[0]
    assert (other[500:].positions != poses[500:].positions).any(axis=1).all()


@pytest.fixture
def flight(tmp_path):
    def write(rows):
        positions = np.stack([np.linspace(-0.5, 0.5, rows), *np.full((2, rows), 0.4)], axis=1)
        poses = Poses(positions, look_at(positions, np.zeros(3)))
        path = tmp_path / f"flight{rows}.csv"
        path.write_text(poses.table(), encoding="utf-8")
        return {"arrangement": "path", "path": str(path)}, poses

    return write


def test_a_path_keeps_its_order_and_gives_rows_to_each_set(flight):
    wanted, flown = flight(50)
    poses, split = ensemble_poses(settings(poses={**wanted, "validation": 4, "heldout": 6}).poses)
    np.testing.assert_array_equal(poses.positions, flown.positions)
    np.testing.assert_allclose(poses.rotations, flown.rotations, atol=1e-12)
    assert np.bincount(split).tolist() == [40, 4, 6]
    assert (np.diff(np.flatnonzero(split == 2)) > 1).any()  # drawn, not cut off
    assert (np.diff(np.flatnonzero(split == 1)) > 1).any()
    more = ensemble_poses(settings(poses={**wanted, "validation": 9, "heldout": 6}).poses)[1]
    np.testing.assert_array_equal(more == 2, split == 2)
    other = ensemble_poses(
        settings(poses={**wanted, "validation": 4, "heldout": 6, "seed": 1}).poses
    )[1]
    assert (other != split).any()


def test_a_path_too_short_to_train_on_is_refused(flight):
    wanted, _ = flight(30)
    with pytest.raises(InputError, match=r"flight30\.csv: 30 poses, .* none is left to train on"):
        ensemble_poses(settings(poses=wanted).poses)
    wanted, _ = flight(31)
    assert np.bincount(ensemble_poses(settings(poses=wanted).poses)[1]).tolist() == [1, 10, 20]


def reach(*positions, limits=(0.3, 0.5)):
    scene = load_scene("sphere", {"radius": 0.1})
    check_reach(scene, poses_at(*positions), bounces=1, range_min=limits[0], range_max=limits[1])


def test_poses_out_of_reach_are_told_of(caplog):
    far, good, near = [0.0, 0.0, 0.61], [0.0, 0.59, 0.0], [0.11, 0.0, 0.0]
    reach(good, good)
    assert not caplog.records
    reach(far, good, near, far)
    assert len(caplog.messages) == 2
    assert "2 of 4 poses (0, 3) are farther" in caplog.messages[0]
    assert "spectrogram.range_max" in caplog.messages[0]
    assert "1 of 4 poses (2) are nearer" in caplog.messages[1]
    assert "spectrogram.range_min" in caplog.messages[1]
    with pytest.raises(NumericalError, match="no pose received an echo"):
        reach(far, near)


@pytest.mark.slow
def test_poses_are_checked_fast_in_a_million_triangles():
    scene = Scene(trimesh.creation.icosphere(subdivisions=8, radius=1.0))
    assert len(scene.mesh.faces) > 1_300_000
    places = np.random.default_rng(0).normal(size=(430, 3))
    places *= 0.9 / np.linalg.norm(places, axis=1, keepdims=True)
    places[7] *= 1.2  # outside, and within the box
    started = time.process_time()
    with pytest.raises(InputError, match=r"429 of 430 poses \(0, 1, 2, 3, 4, 5, 6, 8, 9, 10,"):
        check_positions(scene, poses_at(*places), offsets=np.eye(3) * 0.01)
    assert time.process_time() - started < 20.0  # a look at every triangle for each takes minutes


def test_pose_seeds_are_those_of_the_pair():
    assert pose_seed(3, 7) == pose_seed(3, 7)
    assert len({pose_seed(seed, index) for seed in range(10) for index in range(10)}) == 100


def collect(small, indices, **options):
    found = {}
    simulate_ensemble(*small, indices, found.__setitem__, seed_of=SEED_OF, **options)
    return found


def test_a_pose_depends_on_its_index_alone(small):
    every = collect(small, range(6))
    assert list(every) == list(range(6))
    some = collect(small, [4, 2])
    assert list(some) == [4, 2]
    for index, spectrogram in some.items():
        np.testing.assert_array_equal(spectrogram, every[index])
    simulator, poses = small
    direct = simulator.spectrogram(poses.positions[2], poses.rotations[2], seed=pose_seed(5, 2))
    np.testing.assert_array_equal(direct, every[2])


def test_workers_change_nothing_and_say_nothing(small, capfd):
    alone, shared = collect(small, range(6)), collect(small, range(6), workers=2)
    assert sorted(shared) == list(range(6))
    for index, spectrogram in alone.items():
        np.testing.assert_array_equal(shared[index], spectrogram)
    assert capfd.readouterr() == ("", "")


def test_a_failing_pose_is_named(small):
    simulator, poses = small
    broken = Poses(poses.positions, poses.rotations)
    broken.positions[3] = np.nan
    try:
        with pytest.raises(SonoNerfError, match="pose 3 cannot be simulated: ValueError"):
            simulate_ensemble(simulator, broken, range(6), lambda *_: None, seed_of=SEED_OF)
        with pytest.raises(SonoNerfError, match="pose 3 cannot be simulated: ValueError"):
            simulate_ensemble(simulator, broken, [3], lambda *_: None, seed_of=SEED_OF, workers=2)
    finally:
        poses.positions[3] = 0.4


class Deadly:
    """A simulator that kills the process it runs in, so many times."""

    low = None

    def __init__(self, folder, times):
        self.folder, self.times = folder, times

    def spectrogram(self, position, rotation, *, seed):
        died = len(list(self.folder.iterdir()))
        if died < self.times and position[0] < 0.0:
            (self.folder / str(died)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return np.full((1, 1, 1), position[0], dtype=np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("times", [3, 99])
def test_a_pose_is_not_blamed_for_its_workers(tmp_path, caplog, times):
    found, poses = {}, poses_at([1.0, 0.0, 0.0], [-2.0, 0.0, 0.0], [3.0, 0.0, 0.0])
    task = (Deadly(tmp_path, times), poses, range(3), found.__setitem__)
    if times == 99:
        with pytest.raises(ResourceError, match=r"pose [0, ]*1?: every worker that took it was"):
            simulate_ensemble(*task, seed_of=SEED_OF, workers=2)
    else:
        simulate_ensemble(*task, seed_of=SEED_OF, workers=2)
        assert {index: values.item() for index, values in found.items()} == {0: 1, 1: -2, 2: 3}
        assert not caplog.records


class Slow:
    """A simulator whose second pose takes a minute."""

    low = None

    def spectrogram(self, position, rotation, *, seed):
        time.sleep(60.0 if position[0] < 0.0 else 0.5)
        return np.ones((1, 1, 1), dtype=np.float32)


@pytest.mark.slow
def test_a_fault_of_the_writer_ends_the_workers_at_once():
    def full(index, spectrogram):
        raise OSError("disk full")

    poses = poses_at([1.0, 0.0, 0.0], [-2.0, 0.0, 0.0])
    with pytest.raises(OSError, match="disk full"):
        simulate_ensemble(Slow(), poses, range(2), full, seed_of=SEED_OF, workers=2)
    found, started = {}, time.monotonic()
    poses = poses_at([1.0, 0.0, 0.0], [2.0, 0.0, 0.0])
    simulate_ensemble(
        Slow(), poses, range(2), found.__setitem__, seed_of=SEED_OF, workers=2
    )  # which does not wait for the minute
    assert sorted(found) == [0, 1]
    assert time.monotonic() - started < 20.0


class Deaf:
    """A simulator that returns whether Ctrl-C goes unheard where it runs."""

    low = None

    def spectrogram(self, position, rotation, *, seed):
        os.kill(os.getpid(), signal.SIGINT)
        return np.ones((1, 1, 1), dtype=np.float32)


SCRIPT = """
import signal
import subprocess
import sys
from sononerf.simulation.ensemble import simulate, simulate_ensemble
from tests.simulation.test_ensemble import Deaf, poses_at

found, poses = {}, poses_at([1.0, 0.0, 0.0], [-2.0, 0.0, 0.0])
simulate_ensemble(
    Deaf(), poses, range(2), found.__setitem__, seed_of=lambda index: index, workers=2
)
print([found[index].item() for index in range(2)])
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    print("heard")
"""


@pytest.mark.slow
def test_ctrl_c_is_for_us_and_not_for_our_workers():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout == "[1.0, 1.0]\nheard\n", done.stderr


def poses_at(*positions):
    positions = np.array(positions, dtype=float)
    return Poses(positions, look_at(positions, np.array([9.0, 9.0, 9.0])))


def test_poses_inside_are_refused_even_where_bodies_overlap():
    one, two = (trimesh.creation.icosphere(subdivisions=3, radius=0.1) for _ in range(2))
    two.apply_translation([0.1, 0.0, 0.0])
    scene = Scene(trimesh.util.concatenate([one, two]))
    check_positions(scene, poses_at([0.0, 0.0, 0.101], [-0.09, 0.09, 0.0], [0.3, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"3 of 4 poses \(0, 1, 3\) are inside"):
        # the second lies in both bodies, which a count of crossings takes for outside
        check_positions(scene, poses_at([-0.05, 0, 0], [0.05, 0, 0], [0, 0, 0.2], [0.15, 0, 0]))
    inverted = Scene(trimesh.Trimesh(one.vertices, one.faces[:, ::-1]))
    with pytest.raises(InputError, match="inside"):
        check_positions(inverted, poses_at([0.0, 0.0, 0.05]))


def test_ears_inside_are_refused():
    scene = load_scene("sphere", {"radius": 0.1})
    outside = Poses(np.array([[0.105, 0.0, 0.0]]), np.eye(3)[None])
    check_positions(scene, outside, offsets=np.array([[0.01, 0.0, 0.0]]))
    with pytest.raises(InputError, match="inside"):
        check_positions(scene, outside, offsets=np.array([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0]]))


def test_poses_that_look_away_or_are_all_the_same_are_told(caplog):
    scene = load_scene("sphere", {"radius": 0.1})
    right = Poses.sphere(12, radius=0.4)
    away = Poses(right.positions, right.rotations @ np.diag([-1.0, -1.0, 1.0]))
    check_aim(scene, right, is_directional=True)
    check_aim(scene, away, is_directional=False)
    assert caplog.messages == []
    check_aim(scene, away, is_directional=True)
    check_aim(scene, right[np.zeros(12, int)], is_directional=True)
    first, second = caplog.messages
    assert "look away from the body" in first
    assert second == "all 12 poses are at one place; check the table of poses"
