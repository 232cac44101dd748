# SPDX-License-Identifier: MIT
import numpy as np
import pytest
import torch

from sononerf.echoes.store import EnsembleStore
from sononerf.errors import SettingsError
from sononerf.field.datamodule import PoseReader, SliceStream, WholePoses, seed_of

POSES, RANGES, FREQUENCIES = 11, 6, 5
TRAIN = [0, 2, 3, 5, 7, 8, 10]


def value(pose, ear, row, frequency):
    """What stands in each cell: its own address."""
    return 1000 * pose + 100 * ear + 10 * row + frequency


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    split = np.ones(POSES, int)
    split[TRAIN] = 0
    split[9] = 2
    store = EnsembleStore.create(
        tmp_path_factory.mktemp("data") / "store",
        positions=np.arange(3.0 * POSES).reshape(POSES, 3),
        rotations=np.arange(9.0 * POSES).reshape(POSES, 3, 3),
        split=split,
        range=0.2 + 0.01 * np.arange(RANGES),
        frequency=1e4 * (1 + np.arange(FREQUENCIES)),
        attributes={"echo_hash": "a"},
    )
    cells = np.meshgrid(*map(np.arange, (2, RANGES, FREQUENCIES)), indexing="ij")
    for pose in range(POSES):
        store.write_pose(pose, value(pose, *cells))
    return store


def stream(store, **options):
    given = {
        "whole_poses": True, "batch": 3, "batch_frequencies": None, "seed": 1,
        "memory_bytes": 10**6, **options,
    }  # fmt: skip
    return SliceStream(store, "train", **given)


def same(one, two):
    return all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


KINDS = pytest.mark.parametrize("whole", [True, False])


@KINDS
@pytest.mark.parametrize("frequencies", [None, 2])
def test_a_batch_is_what_the_store_holds(store, whole, frequencies):
    found = stream(store, whole_poses=whole, batch_frequencies=frequencies)[5]
    size = RANGES if whole else 1
    assert found.spectrum.shape == (3, 2, size, frequencies or FREQUENCIES)
    assert found.rows.shape == (3, size)
    assert found.position.dtype == found.rotation.dtype == torch.float32
    for n, pose in enumerate(found.pose.tolist()):
        assert pose in TRAIN
        assert found.position[n].tolist() == [3 * pose, 3 * pose + 1, 3 * pose + 2]
        assert found.rotation[n, 2, 1] == 9 * pose + 7
        for ear in (0, 1):
            for r, row in enumerate(found.rows[n].tolist()):
                expected = [value(pose, ear, row, f) for f in found.bins.tolist()]
                assert found.spectrum[n, ear, r].tolist() == expected


@KINDS
def test_batch_k_depends_on_seed_and_k_alone(store, whole):
    options = {"whole_poses": whole, "batch_frequencies": 2}
    forwards = stream(store, **options)
    once = [forwards[k] for k in range(12)]
    other = stream(store, **options)
    for k in (11, 3, 0, 7, 3):
        assert same(other[k], once[k])
    turned = stream(store, **options, seed=2)
    assert not all(same(turned[k], once[k]) for k in range(12))
    # Each pass has an order of its own, and each step its frequencies.
    per_pass = len(forwards)
    assert not torch.equal(forwards[0].pose, forwards[per_pass].pose)
    assert len({tuple(batch.bins.tolist()) for batch in once}) > 3


@KINDS
def test_a_pass_meets_everything_once(store, whole):
    found = stream(store, whole_poses=whole, batch=1 if whole else 6)
    per_pass = len(found)
    assert per_pass == 7
    for turn in (0, 1):
        met = []
        for step in range(turn * per_pass, (turn + 1) * per_pass):
            batch = found[step]
            met += [(p, r) for p, rows in zip(batch.pose, batch.rows, strict=True) for r in rows]
        met = [(int(pose), int(row)) for pose, row in met]
        assert sorted(met) == [(pose, row) for pose in TRAIN for row in range(RANGES)]


def test_of_silent_slices_a_share_is_met_and_of_the_others_all(store):
    # In pose p, row r the loudest cell is 1000 p + 100 + 10 r + 4: with 3134 as the bound the rows
    # 0 to 2 of pose 3 are silent, and all of poses 0 and 2.
    options = {"whole_poses": False, "batch": 1, "silent_below": 3134.0}
    sounding = {(3, row) for row in (3, 4, 5)} | {(p, r) for p in TRAIN[3:] for r in range(RANGES)}

    def met(**more):
        found = stream(store, **options, **more)
        batches = [found[step] for step in range(len(found))]
        return [(int(batch.pose), int(batch.rows)) for batch in batches]

    assert sorted(met(silent_share=0.0)) == sorted(sounding)
    some = met(silent_share=0.4)
    assert len(some) == len(set(some)) == len(sounding) + 6  # of 15
    assert sounding < set(some)
    assert met(silent_share=0.4, seed=5) != some
    assert len(met(silent_share=1.0)) == RANGES * len(TRAIN)


def test_frequencies_are_drawn_evenly_and_in_order(store):
    found = stream(store, batch_frequencies=2, memory_bytes=10**6)
    drawn = [found[step].bins.tolist() for step in range(300)]
    assert all(a < b for a, b in drawn)
    counts = np.bincount(np.ravel(drawn), minlength=FREQUENCIES)
    # 120 each; five standard deviations of a binomial of 300 and 2/5.
    assert np.abs(counts - 120).max() < 5 * np.sqrt(300 * 0.4 * 0.6)


@KINDS
@pytest.mark.parametrize("devices", [2, 3])
def test_shares_part_the_batch(store, whole, devices):
    options = {"whole_poses": whole, "batch": 5, "batch_frequencies": 2}
    alone = stream(store, **options)
    shares = [stream(store, **options, share=(rank, devices)) for rank in range(devices)]
    for step in range(5):
        whole_batch, parts = alone[step], [share[step] for share in shares]
        assert all(torch.equal(part.bins, whole_batch.bins) for part in parts)
        wanted = sorted(zip(whole_batch.pose.tolist(), whole_batch.rows.tolist(), strict=True))
        found = [pair for p in parts for pair in zip(p.pose.tolist(), p.rows.tolist(), strict=True)]
        assert sorted(found) == wanted


def test_a_batch_that_leaves_a_device_without_work_is_refused(store):
    assert len(stream(store, batch=2, share=(1, 2))[0].pose) == 1
    with pytest.raises(SettingsError, match="batch of 1 cannot be shared by 2 devices"):
        stream(store, batch=1, share=(1, 2))


def test_whole_poses_with_and_without_measurements(store):
    positions, rotations = torch.rand(2, 3), torch.rand(2, 3, 3)
    given = WholePoses(positions, rotations, RANGES, FREQUENCIES)
    assert len(given) == 2
    assert given[1].spectrum.shape == (1, 0, RANGES, FREQUENCIES)
    assert given[1].pose.tolist() == [1]
    torch.testing.assert_close(given[1].position, positions[1:])
    reader, numbers = PoseReader(store, 10**6), torch.tensor([1, 4])
    found = WholePoses(positions, rotations, RANGES, FREQUENCIES, reader, numbers)[1]
    assert found.pose.tolist() == [4]
    assert found.rows.tolist() == [list(range(RANGES))]
    assert found.spectrum.shape == (1, 2, RANGES, FREQUENCIES)
    assert found.spectrum[0, 1, 2, 3] == value(4, 1, 2, 3)


def test_seeds_depend_on_every_part_and_fit_into_torch():
    seeds = [seed_of(a, b, c) for a in range(4) for b in range(4) for c in range(4)]
    assert len(set(seeds)) == 64
    assert all(0 <= seed < 2**63 for seed in seeds)
    torch.manual_seed(max(seeds))
