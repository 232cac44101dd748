# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import trimesh

from sononerf.config import validate_settings
from sononerf.errors import InputError, ResourceError, SonoNerfError
from sononerf.geometry.poses import Poses, look_at
from sononerf.scene import Scene, load_scene
from sononerf.simulation import ensemble
from sononerf.simulation.ensemble import (
    check_poses,
    ensemble_poses,
    pose_seed,
    simulate_ensemble,
)
from sononerf.simulation.simulator import Simulator


def settings(**sections):
    return validate_settings({"scene": {"name": "sphere"}, **sections}, "test")


@pytest.fixture(scope="module")
def small():
    found = settings(simulation={"rays": 2000}, poses={"count": 4, "validation": 1, "heldout": 1})
    return Simulator.from_settings(load_scene("sphere"), found), ensemble_poses(found)[0]


def test_sets_follow_each_other_at_their_radius():
    poses, split = ensemble_poses(settings(poses={"count": 7, "validation": 2, "heldout": 3}))
    assert split.tolist() == [0] * 7 + [1] * 2 + [2] * 3
    assert split.dtype == np.int8
    np.testing.assert_allclose(np.linalg.norm(poses.positions, axis=1), 0.4)


def test_no_set_moves_another_and_the_seed_moves_all():
    def sets(**changes):
        wanted = {"count": 7, "validation": 2, "heldout": 3, **changes}
        return ensemble_poses(settings(poses=wanted))[0]

    base = sets()
    np.testing.assert_array_equal(base[-3:].rotations, sets(count=20)[-3:].rotations)
    np.testing.assert_array_equal(base[-3:].positions, sets(validation=9)[-3:].positions)
    np.testing.assert_array_equal(base[:7].rotations, sets(heldout=0)[:7].rotations)
    other = sets(seed=1)
    assert (base.rotations != other.rotations).any(axis=(1, 2)).all()
    assert (base.positions[7:9] != base.positions[9:11]).any()


def test_pose_seeds_are_those_of_the_pair():
    assert pose_seed(3, 7) == pose_seed(3, 7)
    assert len({pose_seed(seed, index) for seed in range(10) for index in range(10)}) == 100


def collect(small, indices, **options):
    found = {}
    simulate_ensemble(*small, indices, found.__setitem__, seed=5, **options)
    return found


def test_a_pose_depends_on_its_index_alone(small):
    steps = []
    every = collect(small, range(6), progress=lambda *step: steps.append(step))
    assert list(every) == list(range(6))
    assert steps == [(done, 6) for done in range(1, 7)]
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
            simulate_ensemble(simulator, broken, range(6), lambda *_: None, seed=0)
        with pytest.raises(SonoNerfError, match="pose 3 cannot be simulated: ValueError"):
            simulate_ensemble(simulator, broken, [3], lambda *_: None, seed=0, workers=2)
    finally:
        poses.positions[3] = 0.4


def test_faults_of_the_writer_are_not_blamed_on_a_pose(small):
    def full(index, spectrogram):
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        simulate_ensemble(*small, [0], full, seed=0)


def test_a_scheduler_that_is_not_there_is_named(small, monkeypatch):
    monkeypatch.setattr(ensemble, "CONNECT_SECONDS", 1)
    with pytest.raises(ResourceError, match=r"tcp://127\.0\.0\.1:9 cannot be reached"):
        simulate_ensemble(*small, [0], lambda *_: None, seed=0, scheduler="tcp://127.0.0.1:9")


def poses_at(*positions):
    positions = np.array(positions, dtype=float)
    return Poses(positions, look_at(positions, np.array([9.0, 9.0, 9.0])))


def test_poses_inside_are_refused_even_where_bodies_overlap():
    one, two = (trimesh.creation.icosphere(subdivisions=3, radius=0.1) for _ in range(2))
    two.apply_translation([0.1, 0.0, 0.0])
    scene = Scene(trimesh.util.concatenate([one, two]))
    check_poses(scene, poses_at([0.0, 0.0, 0.101], [-0.09, 0.09, 0.0], [0.3, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"3 of 4 poses are inside .*: 0, 1, 3;"):
        # the second lies in both bodies, which a count of crossings takes for outside
        check_poses(scene, poses_at([-0.05, 0, 0], [0.05, 0, 0], [0, 0, 0.2], [0.15, 0, 0]))
    inverted = Scene(trimesh.Trimesh(one.vertices, one.faces[:, ::-1]))
    with pytest.raises(InputError, match="inside"):
        check_poses(inverted, poses_at([0.0, 0.0, 0.05]))


def test_only_the_first_ten_are_listed():
    scene = load_scene("sphere", {"radius": 1.0})
    inside = poses_at(*np.linspace(-0.1, 0.1, 12)[:, None] * [1.0, 0.0, 0.0])
    with pytest.raises(InputError, match=r"12 of 12 .*: 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, \.\.\.;"):
        check_poses(scene, inside)


def test_ears_inside_are_refused():
    scene = load_scene("sphere", {"radius": 0.1})
    outside = Poses(np.array([[0.105, 0.0, 0.0]]), np.eye(3)[None])
    check_poses(scene, outside, offsets=np.array([[0.01, 0.0, 0.0]]))
    with pytest.raises(InputError, match="inside"):
        check_poses(scene, outside, offsets=np.array([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0]]))


def test_poses_that_are_no_numbers_are_refused():
    poses = Poses(np.array([[0.4, 0.0, 0.0], [np.nan, 0.0, 0.0]]), np.stack([np.eye(3)] * 2))
    with pytest.raises(InputError, match="1 of 2 poses are no finite numbers: 1;"):
        check_poses(load_scene("sphere"), poses)
