# SPDX-License-Identifier: MIT
"""The record of finished poses: torn lines are no records, order leaves no trace."""

from __future__ import annotations

import asyncio
import json

import pytest
from zarr.core.buffer import default_buffer_prototype

from sononerf.echoes.layout import DurableStore, Manifest, PoseRecord
from sononerf.errors import IncompatibleError, InputError

RECORDS = {index: PoseRecord(100 + index, f"{index:064x}") for index in (3, 0, 11)}


@pytest.fixture
def manifest(tmp_path):
    result = Manifest(tmp_path)
    for index, record in RECORDS.items():
        result.add(index, record)
    return result


def test_what_is_added_is_read_in_order(manifest):
    assert list(manifest.read().items()) == sorted(RECORDS.items())


def test_nothing_is_an_empty_record(tmp_path):
    assert Manifest(tmp_path).read() == {}


def test_sealing_keeps_all_and_leaves_one_file(manifest):
    manifest.seal()
    assert [p.name for p in manifest.path.parent.iterdir()] == ["manifest.json"]
    assert manifest.read() == RECORDS
    first = manifest.path.read_bytes()
    manifest.seal()
    assert manifest.path.read_bytes() == first


def test_the_journal_lies_over_the_sealed_file(manifest):
    manifest.seal()
    newer = PoseRecord(7, "f" * 64)
    manifest.add(3, newer)
    assert manifest.read() == {**RECORDS, 3: newer}


def test_any_damage_to_a_line_costs_that_line_only(manifest):
    whole = manifest.journal.read_bytes()
    second = whole.index(b"\n") + 1
    third = whole.index(b"\n", second) + 1
    for offset in range(second, third - 1):
        damaged = bytearray(whole)
        damaged[offset] ^= 1
        manifest.journal.write_bytes(damaged)
        assert manifest.read() == {3: RECORDS[3], 11: RECORDS[11]}


def test_a_line_cut_anywhere_is_no_record(manifest):
    whole = manifest.journal.read_bytes()
    last = whole.rindex(b"\n", 0, -1) + 1
    for end in range(last, len(whole) - 1):
        manifest.journal.write_bytes(whole[:end])
        assert 11 not in manifest.read()
        manifest.add(5, PoseRecord(1, "a"))
        assert manifest.read().keys() == {0, 3, 5}


def test_a_damaged_sealed_file_is_told(manifest):
    manifest.seal()
    data = json.loads(manifest.path.read_text())
    data["poses"]["3"]["size"] += 1
    manifest.path.write_text(json.dumps(data))
    with pytest.raises(InputError, match="damaged"):
        manifest.read()
    manifest.path.write_text("[]")
    with pytest.raises(InputError, match="damaged"):
        manifest.read()


def test_a_newer_sealed_file_is_refused(manifest):
    manifest.seal()
    data = json.loads(manifest.path.read_text())
    manifest.path.write_text(json.dumps({**data, "schema_version": 2}))
    with pytest.raises(IncompatibleError, match="schema_version 2"):
        manifest.read()


def test_a_store_of_zarr_commits_and_keeps_what_is_there(tmp_path):
    first, second = (default_buffer_prototype().buffer.from_bytes(x) for x in (b"one", b"two"))
    store = DurableStore(tmp_path)
    asyncio.run(store.set("a/key", first))
    asyncio.run(store.set_if_not_exists("a/key", second))
    assert (tmp_path / "a" / "key").read_bytes() == b"one"
    asyncio.run(store.set_if_not_exists("b/key", second))
    assert (tmp_path / "b" / "key").read_bytes() == b"two"
    reading = DurableStore(tmp_path, read_only=True)
    with pytest.raises(ValueError, match="read-only"):
        reading.set_sync("a/key", second)
    assert (tmp_path / "a" / "key").read_bytes() == b"one"
