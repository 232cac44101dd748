# SPDX-License-Identifier: MIT
"""A damaged or changed file of a run is never taken for a result."""

from __future__ import annotations

import pytest

from sononerf import storage
from sononerf.checksums import NAME, differing, recorded, require_recorded
from sononerf.errors import InputError, StorageError


@pytest.fixture
def run(tmp_path):
    with recorded(tmp_path):
        storage.commit_bytes(tmp_path / "part" / "mesh.ply", b"first")
        storage.commit_json(tmp_path / "metrics.json", {"error": 1.0})
        storage.commit_bytes(tmp_path / "epochs" / "mip.png", b"picture")
        storage.commit_bytes(tmp_path / "last.ckpt", b"state")
    return tmp_path


def flip(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def test_a_flipped_bit_is_refused_and_named(run):
    mesh = run / "part" / "mesh.ply"
    require_recorded(run, mesh, "make it again")
    assert differing(run) == []
    flip(mesh)
    with pytest.raises(InputError, match=r"mesh\.ply: damaged, or changed .*; make it again"):
        require_recorded(run, mesh, "make it again")
    assert differing(run) == ["part/mesh.ply"]


def test_what_is_written_again_is_right_again(run):
    flip(run / "metrics.json")
    with recorded(run):
        storage.commit_json(run / "metrics.json", {"error": 2.0})
    require_recorded(run, run / "metrics.json", "")
    assert differing(run) == []


def test_content_older_than_the_newest_two_is_refused(run):
    for content in (b"second", b"third"):
        with recorded(run):
            storage.commit_bytes(run / "part" / "mesh.ply", content)
    (run / "part" / "mesh.ply").write_bytes(b"second")  # a crash before the rename leaves this
    require_recorded(run, run / "part" / "mesh.ply", "")
    (run / "part" / "mesh.ply").write_bytes(b"first")
    with pytest.raises(InputError, match="damaged, or changed"):
        require_recorded(run, run / "part" / "mesh.ply", "")
    assert differing(run) == ["part/mesh.ply"]


def test_a_missing_file_is_named_unless_it_was_removed(run):
    (run / "part" / "mesh.ply").unlink()
    with recorded(run):
        storage.remove_file(run / "metrics.json")
    assert differing(run) == ["part/mesh.ply"]


def test_a_process_that_dies_before_the_rename_leaves_the_old_file_valid(run, monkeypatch):
    def die(*names):
        raise KeyboardInterrupt

    mesh = run / "part" / "mesh.ply"
    with monkeypatch.context() as patch, recorded(run):
        patch.setattr("os.replace", die)
        with pytest.raises(KeyboardInterrupt):
            storage.commit_bytes(mesh, b"second")
    assert mesh.read_bytes() == b"first"
    require_recorded(run, run / "part" / "mesh.ply", "")
    assert differing(run) == []


def test_previews_and_files_with_checksums_of_their_own_are_left_out(run):
    flip(run / "epochs" / "mip.png")
    flip(run / "last.ckpt")
    assert differing(run) == []


def test_what_no_run_recorded_passes(run, tmp_path_factory):
    other = tmp_path_factory.mktemp("other") / "mesh.ply"
    with recorded(run):
        storage.commit_bytes(other, b"elsewhere")
    flip(other)
    require_recorded(run, other, "")
    storage.commit_bytes(run / "notes.txt", b"of the user")
    require_recorded(run, run / "notes.txt", "")
    assert differing(run) == []


def test_a_damaged_journal_hides_no_damage_of_other_files(run):
    journal = run / NAME
    lines = journal.read_bytes().split(b"\n")
    journal.write_bytes(b"\n".join([lines[0].replace(b"mesh", b"mash"), *lines[1:]]))
    flip(run / "metrics.json")
    assert differing(run) == ["metrics.json"]


def test_a_file_that_cannot_be_recorded_is_not_written(run):
    (run / NAME).unlink()
    (run / NAME).mkdir()
    with recorded(run), pytest.raises(StorageError, match=r"metrics\.json|checksums"):
        storage.commit_json(run / "metrics.json", {"error": 3.0})
    assert storage.read_json(run / "metrics.json") == {"error": 1.0}
