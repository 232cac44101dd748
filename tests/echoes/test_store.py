# SPDX-License-Identifier: MIT
"""The ensemble: each pose whole or missing, whatever kills the process; bytes that repeat."""

from __future__ import annotations

import hashlib
import json
import pickle

import numpy as np
import pytest
import zarr

from sononerf import storage
from sononerf.echoes.memory_ensemble import draw_split, pose_groups, repeats, seal, split_of
from sononerf.echoes.store import EnsembleStore, SubtractedStore
from sononerf.errors import IncompatibleError, InputError, NumericalError
from sononerf.geometry.poses import Poses
from sononerf.head.front_end import compress

POSES, RANGES, FREQUENCIES = 9, 7, 5


def axes(**changes):
    generator = np.random.default_rng(0)
    return {
        "positions": generator.normal(size=(POSES, 3)),
        "rotations": np.tile(np.eye(3), (POSES, 1, 1)),
        "split": np.arange(POSES) % 3,
        "range": np.linspace(0.15, 0.75, RANGES),
        "frequency": np.linspace(10e3, 100e3, FREQUENCIES),
        "attributes": {"echo_hash": "a1", "units": {"range": "m"}, "speed_of_sound": 343.0},
        **changes,
    }


def spectrogram(index, shape=(2, RANGES, FREQUENCIES)):
    return np.random.default_rng([7, index]).random(shape, dtype=np.float32)


def filled(path, order=range(POSES)):
    store = EnsembleStore.create(path, **axes())
    for index in order:
        store.write_pose(index, spectrogram(index))
    return store


def tree(path):
    files = sorted(p for p in path.rglob("*") if p.is_file() and p.name != ".lock")
    return {str(p.relative_to(path)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def chunk(path, index):
    return path / "spectrogram" / f"c.{index}.0.0.0"


def test_what_is_written_is_read(tmp_path):
    filled(tmp_path / "s")
    store = EnsembleStore.open(tmp_path / "s")
    wanted = axes()
    assert len(store) == POSES
    np.testing.assert_array_equal(store.positions, wanted["positions"])
    np.testing.assert_array_equal(store.rotations, wanted["rotations"])
    np.testing.assert_array_equal(store.split, wanted["split"])
    np.testing.assert_array_equal(store.range, wanted["range"])
    np.testing.assert_array_equal(store.frequency, wanted["frequency"])
    assert store.attributes == wanted["attributes"]
    for index in range(POSES):
        values = store.read_pose(index)
        assert values.dtype == np.float32
        assert values.flags.writeable
        np.testing.assert_array_equal(values, spectrogram(index))
    assert store.missing() == []
    np.testing.assert_array_equal(store.indices("val"), [1, 4, 7])
    with pytest.raises(InputError, match="train, val, test"):
        store.indices("validation")


def test_zarr_alone_reads_it_and_names_its_dimensions(tmp_path):
    EnsembleStore.create(tmp_path / "s", **axes()).write_pose(1, spectrogram(1))
    array = zarr.open_array(tmp_path / "s", path="spectrogram", mode="r")
    assert array.metadata.dimension_names == ("pose", "ear", "range", "frequency")
    np.testing.assert_array_equal(array[1], spectrogram(1))
    assert np.isnan(array[0]).all()  # a missing pose is no silence
    range_axis = zarr.open_array(tmp_path / "s", path="range", mode="r")
    assert range_axis.metadata.dimension_names == ("range",)


def test_bytes_know_no_order_of_writing(tmp_path):
    filled(tmp_path / "a").update_attributes(reference=1e-3, noise_floor=0.5)
    other = filled(tmp_path / "b", order=reversed(range(POSES)))
    other.update_attributes(noise_floor=0.5)
    other.update_attributes(reference=np.float64(1e-3))
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e30, -1.0])
def test_magnitudes_that_are_none_are_refused_with_their_place(tmp_path, poison):
    store, values = filled(tmp_path / "s"), spectrogram(4)
    values[1, 3, 2] = poison
    zarr.open_array(store.path, path="spectrogram", mode="r+")[4] = values  # by a stranger
    words = r"pose 4 holds the magnitude \S+ \(receiver 1, range slice 3, frequency 2\)"
    with pytest.raises(InputError, match=words):
        EnsembleStore.open(tmp_path / "s").read_pose(4)
    with pytest.raises(NumericalError, match=words):
        store.write_pose(4, values)


def test_a_store_is_sealed_when_its_reference_is_known_and_no_pose_is_missing(tmp_path):
    store = filled(tmp_path / "s")
    assert not EnsembleStore.open(tmp_path / "s").is_sealed  # killed here
    store.update_attributes(reference=1e-3)
    assert EnsembleStore.open(tmp_path / "s").is_sealed
    chunk(tmp_path / "s", 3).unlink()
    assert not EnsembleStore.open(tmp_path / "s").is_sealed


def test_a_missing_pose_is_named_never_silent(tmp_path):
    store = filled(tmp_path / "s")
    chunk(tmp_path / "s", 3).unlink()
    assert store.missing() == [3]
    with pytest.raises(InputError, match="pose 3 is missing"):
        store.read_pose(3)


def test_a_damaged_pose_can_be_removed_and_is_missing_then(tmp_path):
    store = filled(tmp_path / "s")
    data = bytearray(chunk(tmp_path / "s", 3).read_bytes())
    data[len(data) // 2] ^= 1
    chunk(tmp_path / "s", 3).write_bytes(data)
    assert (store.missing(), store.damaged()) == ([], [3])
    store.remove_damaged()
    assert (store.missing(), store.damaged()) == ([3], [])


def test_poses_of_another_process_are_found(tmp_path):
    reader = EnsembleStore.create(tmp_path / "s", **axes())
    EnsembleStore.open(tmp_path / "s", mode="r+").write_pose(4, spectrogram(4))
    np.testing.assert_array_equal(reader.read_pose(4), spectrogram(4))
    assert 4 not in reader.missing()


def test_a_folder_that_is_locked_is_no_foreign_one(tmp_path):
    with storage.lock(tmp_path / "s"):
        assert len(filled(tmp_path / "s")) == POSES


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_none_are_refused(tmp_path, bad):
    store = EnsembleStore.create(tmp_path / "s", **axes())
    values = spectrogram(0)
    values[1, 2, 3] = bad
    with pytest.raises(NumericalError, match="pose 0"):
        store.write_pose(0, values)
    assert 0 in store.missing()
    with pytest.raises(NumericalError, match="attribute"):
        store.update_attributes(reference=bad)
    with pytest.raises(NumericalError, match="range"):
        EnsembleStore.create(tmp_path / "t", **axes(range=np.full(RANGES, bad)))
    assert not (tmp_path / "t").exists()


def test_wrong_shapes_and_numbers_are_refused(tmp_path):
    store = EnsembleStore.create(tmp_path / "s", **axes())
    with pytest.raises(InputError, match="shape"):
        store.write_pose(0, spectrogram(0)[:, :-1])
    for index in (-1, POSES):
        with pytest.raises(InputError, match=f"no pose {index}; there are 0 to {POSES - 1}"):
            store.write_pose(index, spectrogram(0))
        with pytest.raises(InputError, match="no pose"):
            store.read_pose(index)
    for changes, message in [
        ({"positions": np.zeros((POSES, 2))}, "position: shape"),
        ({"rotations": np.zeros((POSES - 1, 3, 3))}, "differ in length"),
        ({"split": np.full(POSES, 3)}, "split: expected 0"),
        ({"range": []}, "range: shape"),
    ]:
        with pytest.raises(InputError, match=message):
            EnsembleStore.create(tmp_path / "t", **axes(**changes))


def test_reading_refuses_writing(tmp_path):
    filled(tmp_path / "s")
    store = EnsembleStore.open(tmp_path / "s")
    for call in (lambda: store.write_pose(0, spectrogram(0)), store.update_attributes):
        with pytest.raises(InputError, match="opened for reading"):
            call()


def test_create_opens_the_same_and_refuses_another(tmp_path):
    filled(tmp_path / "s")
    assert EnsembleStore.create(tmp_path / "s", **axes()).missing() == []
    with pytest.raises(IncompatibleError, match="other settings"):
        EnsembleStore.create(tmp_path / "s", **axes(attributes={"echo_hash": "b2"}))
    moved = axes()["positions"] + 1.0
    with pytest.raises(IncompatibleError, match="position differs"):
        EnsembleStore.create(tmp_path / "s", **axes(positions=moved))


def test_create_refuses_a_folder_of_something_else(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "thesis.tex").write_text("")
    with pytest.raises(InputError, match=r"thesis\.tex"):
        EnsembleStore.create(tmp_path / "s", **axes())
    with pytest.raises(InputError, match="is a file"):
        EnsembleStore.create(tmp_path / "s" / "thesis.tex", **axes())


def edited(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("name", "change", "error", "message"),
    [
        ("zarr.json", lambda d: d["attributes"].update(schema_version=2), IncompatibleError, "2"),
        ("zarr.json", lambda d: d["attributes"].pop("format"), InputError, "no ensemble of"),
        ("zarr.json", lambda d: d.pop("node_type"), InputError, "damaged"),
        ("spectrogram/zarr.json", lambda d: d["codecs"].pop(), InputError, "codecs"),
        ("spectrogram/zarr.json", lambda d: d.update(fill_value=0), InputError, "fill value"),
        ("position/zarr.json", lambda d: d["shape"].insert(0, 9), InputError, "position"),
        ("range/zarr.json", lambda d: d.update(shape=[10**12]), InputError, "range"),
    ],
)
def test_damaged_or_foreign_stores_are_refused_in_one_line(tmp_path, name, change, error, message):
    filled(tmp_path / "s")
    edited(tmp_path / "s" / name, change)
    with pytest.raises(error, match=message) as caught:
        EnsembleStore.open(tmp_path / "s")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["position", "rotation", "split", "range", "frequency"])
def test_a_lost_axis_is_refused(tmp_path, name):
    filled(tmp_path / "s")
    for file in (tmp_path / "s" / name).glob("c.*"):
        file.unlink()
    with pytest.raises(InputError, match=name):
        EnsembleStore.open(tmp_path / "s")


def test_nothing_there(tmp_path):
    with pytest.raises(InputError, match="no ensemble store"):
        EnsembleStore.open(tmp_path / "none")


def test_a_store_travels_to_another_process(tmp_path):
    store = pickle.loads(pickle.dumps(filled(tmp_path / "s")))
    np.testing.assert_array_equal(store.read_pose(2), spectrogram(2))


KILL_POSES, KILL_SHAPE = 30, (2, 40, 16)


# The child uses nothing that a thread of its parent may hold.
def store_of(path, levels):
    store = EnsembleStore.create(
        path,
        positions=np.zeros((3, 3)),
        rotations=np.stack([np.eye(3)] * 3),
        split=[0, 0, 2],
        range=[0.1, 0.2],
        frequency=[1e4, 2e4],
        attributes={"echo_hash": "x"},
        receivers=1,
    )
    for index, level in enumerate(levels):
        store.write_pose(index, np.full((1, 2, 2), level))
    return store


def test_decibels_start_60_db_below_the_loudest_training_pose(tmp_path):
    store = store_of(tmp_path / "s", [0.5, 2.0, 9.0])
    seal(store, {2: np.full((1, 2, 2), 4.5, np.float32)}, silent="nothing")
    known = EnsembleStore.open(tmp_path / "s").attributes
    assert known["reference"] == pytest.approx(2e-3)
    apart = compress(9.0, 2e-3) - compress(4.5, 2e-3)
    assert known["noise_floor_mae_db"] == pytest.approx(apart)
    assert known["noise_floor_mae_db_active"] == pytest.approx(apart)


def test_without_repeats_there_is_no_noise_floor(tmp_path):
    seal(store_of(tmp_path / "s", [1.0, 2.0, 3.0]), {}, silent="nothing")
    known = EnsembleStore.open(tmp_path / "s").attributes
    assert known["noise_floor_mae_db"] is known["noise_floor_mae_db_active"] is None


def test_silence_is_told(tmp_path):
    with pytest.raises(NumericalError, match="nothing was heard"):
        seal(store_of(tmp_path / "s", [0.0, 0.0, 3.0]), {}, silent="nothing was heard")


def store(path, values, *, poses=range(POSES), **changes):
    attributes = {"echo_hash": path.name, "reference": 2e-3, "noise_floor_mae_db": 0.1}
    made = EnsembleStore.create(path, **axes(attributes=attributes, **changes))
    for index in poses:
        made.write_pose(index, values(index))
    return path


@pytest.fixture
def whole(tmp_path):
    """The loudest cell of the training poses is 2."""

    def loud(index):
        values = spectrogram(index)
        values.flat[0] = 2.0
        return values

    return store(tmp_path / "whole", loud)


def test_power_is_taken_off_and_nothing_is_less_than_silent(whole, tmp_path):
    """0.6² + 0.8² = 1; what sounded louder alone is silent."""
    alone = store(tmp_path / "alone", lambda i: np.full_like(spectrogram(i), 0.6))
    left = SubtractedStore(whole, alone)
    for index in (0, POSES - 1):
        together = EnsembleStore.open(whole).read_pose(index)
        found = left.read_pose(index)
        assert found.dtype == np.float32
        loud = together > 0.6
        np.testing.assert_allclose(found[loud] ** 2 + 0.36, together[loud] ** 2, rtol=1e-5)
        assert not found[~loud].any()
        assert 0 < loud.mean() < 1


def test_the_reference_is_that_of_what_is_left_and_the_floor_is_not_known(whole, tmp_path):
    def alone(index):
        """All of the loudest cell but a hundredth of its power, nothing else."""
        values = np.zeros_like(spectrogram(index))
        values.flat[0] = np.sqrt(4.0 - 0.04)
        return values

    left = SubtractedStore(whole, store(tmp_path / "alone", alone))
    loudest = max(left.read_pose(int(i)).max() for i in left.indices("train"))
    assert loudest < 1.0
    assert left.attributes["reference"] == pytest.approx(1e-3 * loudest, rel=1e-6)
    assert left.attributes["noise_floor_mae_db"] is None
    assert left.attributes["noise_floor_mae_db_active"] is None
    assert left.attributes["echo_hash"] == "whole"


def test_it_goes_to_other_processes_whole(whole, tmp_path):
    alone = store(tmp_path / "alone", lambda i: np.full_like(spectrogram(i), 0.6))
    left = SubtractedStore(whole, alone)
    again = pickle.loads(pickle.dumps(left))
    np.testing.assert_array_equal(again.read_pose(3), left.read_pose(3))


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"positions": np.zeros((POSES, 3))}, "position"),
        ({"split": np.zeros(POSES, int)}, "split"),
        ({"frequency": np.linspace(10e3, 90e3, 5)}, "frequency"),
    ],
)
def test_a_background_of_other_poses_or_axes_is_refused(whole, tmp_path, changes, name):
    other = store(tmp_path / "other", spectrogram, **changes)
    with pytest.raises(IncompatibleError, match=f"other: its {name} differs from that of") as error:
        SubtractedStore(whole, other)
    assert "\n" not in str(error.value)


def test_a_background_that_is_not_whole_is_refused(whole, tmp_path):
    part = store(tmp_path / "part", spectrogram, poses=[0, 1, 3])
    with pytest.raises(InputError, match="pose 2 is missing; finish it"):
        SubtractedStore(whole, part)
    with pytest.raises(InputError, match="no ensemble store"):
        SubtractedStore(whole, tmp_path / "nowhere")


def test_the_same_ensemble_leaves_nothing(whole):
    with pytest.raises(NumericalError, match="nothing is left; is it the same ensemble"):
        _ = SubtractedStore(whole, whole).attributes


def poses_of(count):
    generator = np.random.default_rng(0)
    return Poses.sphere(count, radius=0.4, aim_jitter=0.1, generator=generator)


def split(poses, **given):
    return draw_split(poses, where="t", **given)


@pytest.mark.parametrize(
    ("count", "expected"), [(2, [2, 0, 0]), (3, [1, 1, 1]), (40, [34, 2, 4]), (1000, [970, 10, 20])]
)
def test_sizes_follow_the_number_of_poses(count, expected):
    assert np.bincount(split(poses_of(count)), minlength=3).tolist() == expected


def test_numbers_and_seed_decide():
    found = split(poses_of(30), validation=5, heldout=7)
    assert np.bincount(found).tolist() == [18, 5, 7]
    assert (split(poses_of(30), seed=1) != split(poses_of(30))).any()
    with pytest.raises(InputError, match="t: 3 poses, of which 1 validate and 2 are held out"):
        split(poses_of(3), validation=1, heldout=2)


@pytest.mark.parametrize("stated", [["train", "test", "val"], [0, 2, 1], np.array([0, 2, 1])])
def test_what_is_stated_counts(stated):
    assert split_of(poses_of(3), stated).tolist() == [0, 2, 1]
    assert np.bincount(split_of(poses_of(40), None)).tolist() == [34, 2, 4]


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ([0, 1], r"shape \(2,\), expected \(3,\)"),
        (["train", "test", "eval"], "found 'eval', expected train, val or test"),
        ([0, 1, 3], "found 3"),
        ([2, 1, 1], "no pose is for training"),
    ],
)
def test_a_wrong_split_is_refused(stated, message):
    with pytest.raises(InputError, match=message):
        split_of(poses_of(3), stated)


def test_repeats_stay_together_and_pair_up():
    once = poses_of(20)
    twice = Poses(np.repeat(once.positions, 2, axis=0), np.repeat(once.rotations, 2, axis=0))
    assert len(np.unique(pose_groups(twice))) == 20
    found = split(twice)
    np.testing.assert_array_equal(found[::2], found[1::2])
    pairs = repeats(twice, found)
    assert len(pairs) == 2
    assert all(found[a] == found[b] == 2 and b == a + 1 for a, b in pairs.items())
    assert repeats(once, split(once)) == {}
