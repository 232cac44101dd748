# SPDX-License-Identifier: MIT
"""The one write path: old or new, never neither, never silent."""

from __future__ import annotations

import builtins
import errno
import json
import os
import resource
import stat
import subprocess
import sys
import threading
from contextlib import contextmanager

import numpy as np
import pytest

from sononerf import storage
from sononerf.errors import InputError, NumericalError, StorageError


@contextmanager
def failing(monkeypatch, number, code, *, lasting):
    """Let the `number`-th operating system call of a commit fail, and all later ones if lasting."""
    count = 0

    def counted(real):
        def call(*args, **kwargs):
            nonlocal count
            count += 1
            if count == number or (lasting and count > number):
                raise OSError(code, os.strerror(code))
            return real(*args, **kwargs)

        return call

    with monkeypatch.context() as patch:
        patch.setattr(builtins, "open", counted(open))
        for name in ("fsync", "replace", "link", "mkdir"):
            patch.setattr(os, name, counted(getattr(os, name)))
        # A file's own methods cannot be replaced: the writers of these tests call this one.
        yield counted(lambda file, data: file.write(data))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_commit_writes_and_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a" / "b" / "file"
    storage.commit_bytes(path, b"old")
    storage.commit_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert names(path.parent) == ["file"]


def test_commit_is_durable_before_it_is_visible(tmp_path, monkeypatch):
    order = []
    real_fsync, real_replace = os.fsync, os.replace

    def fsync(descriptor):
        kind = "folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file"
        order.append(f"fsync {kind}")
        real_fsync(descriptor)

    def replace(source, target):
        order.append("replace")
        real_replace(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    storage.commit_bytes(tmp_path / "file", b"x")
    assert order == ["fsync file", "replace", "fsync folder"]


def test_new_folders_are_durable_too(tmp_path, monkeypatch):
    synced = []
    real = storage.sync_folder
    monkeypatch.setattr(
        storage, "sync_folder", lambda folder: (synced.append(folder), real(folder))
    )
    storage.commit_bytes(tmp_path / "a" / "b" / "file", b"x")
    assert synced == [tmp_path, tmp_path / "a", tmp_path / "a" / "b"]


@pytest.mark.parametrize("lasting", [False, True])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EACCES, errno.EROFS])
def test_a_fault_at_any_call_leaves_old_or_new_and_is_told(tmp_path, monkeypatch, code, lasting):
    path = tmp_path / "file"
    for number in range(1, 20):
        storage.commit_bytes(path, b"old")
        with failing(monkeypatch, number, code, lasting=lasting) as write:
            message = None
            try:
                storage.commit(path, lambda file, w=write: w(file, b"new"))
            except StorageError as error:
                message = str(error)
        assert path.read_bytes() in (b"old", b"new")
        assert names(tmp_path) == ["file"]
        if message is None:
            break
        assert str(path) in message
        assert "\n" not in message
    assert path.read_bytes() == b"new"
    assert number == 6  # open, write, fsync, replace, fsync; then nothing is left to fail


def test_a_file_size_limit_is_a_storage_error_and_keeps_the_old_file(tmp_path):
    path = tmp_path / "file"
    storage.commit_bytes(path, b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(StorageError, match="size limit"):
            storage.commit_bytes(path, bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["file"]


def test_an_interrupt_in_the_writer_leaves_no_temporary_file(tmp_path):
    def writer(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        storage.commit(tmp_path / "file", writer)
    assert names(tmp_path) == []


def test_threads_that_commit_one_name_do_not_mix_their_bytes(tmp_path):
    path = tmp_path / "file"

    def work(letter):
        for _ in range(20):
            storage.commit(path, lambda file: [file.write(letter) for _ in range(100)])

    threads = [threading.Thread(target=work, args=(letter,)) for letter in (b"a", b"b")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_bytes() in (b"a" * 100, b"b" * 100)


def test_json_converts_numpy_and_refuses_nan(tmp_path):
    path = tmp_path / "data.json"
    data = {"f": np.float32(0.5), "i": np.int64(3), "b": np.bool_(True), "a": np.arange(2)}
    storage.commit_json(path, data)
    assert storage.read_json(path) == {"f": 0.5, "i": 3, "b": True, "a": [0, 1]}
    assert path.read_text().startswith('{\n  "f"')
    for bad in (float("nan"), np.float32("inf"), np.array([np.nan])):
        with pytest.raises(NumericalError, match="NaN or infinite"):
            storage.commit_json(path, {"x": bad})
    assert storage.read_json(path)["i"] == 3


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000])
def test_read_json_tells_damage_in_one_line(tmp_path, content):
    path = tmp_path / "data.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"data\.json: damaged") as caught:
        storage.read_json(path)
    assert "\n" not in str(caught.value)


def test_read_json_of_nothing_and_of_a_folder(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        storage.read_json(tmp_path / "none.json")
    with pytest.raises(InputError, match="cannot be read"):
        storage.read_json(tmp_path)


def test_clean_leftovers_removes_those_of_the_dead_only(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / f".file.{dead.pid}.tmp").write_bytes(b"")
    (tmp_path / f".file.{dead.pid}-77.tmp").write_bytes(b"")
    (tmp_path / f".folder.{dead.pid}.tmp").mkdir()
    (tmp_path / f".folder.{dead.pid}.tmp" / "content").write_bytes(b"")
    alive = tmp_path / f".file.{os.getpid()}.tmp"
    alive.write_bytes(b"")
    (tmp_path / "file.tmp").write_bytes(b"")
    storage.clean_leftovers(tmp_path)
    assert names(tmp_path) == sorted([alive.name, "file.tmp"])
    storage.clean_leftovers(tmp_path / "none")


def test_remove_file_twice(tmp_path):
    storage.commit_bytes(tmp_path / "file", b"")
    storage.remove_file(tmp_path / "file")
    storage.remove_file(tmp_path / "file")
    storage.remove_file(tmp_path / "missing" / "file")
    assert names(tmp_path) == []


def test_probe_creates_the_folder_and_leaves_it_empty(tmp_path):
    created = storage.probe_writable(tmp_path / "a" / "b")
    assert created == [tmp_path / "a" / "b", tmp_path / "a"]
    assert names(tmp_path / "a" / "b") == []
    assert storage.probe_writable(tmp_path / "a") == []
    (tmp_path / "a" / "kept").touch()
    storage.remove_if_empty(created)
    assert names(tmp_path / "a") == ["kept"]


@pytest.mark.parametrize("number", range(1, 8))
def test_probe_that_fails_leaves_nothing_behind(tmp_path, monkeypatch, number):
    with failing(monkeypatch, number, errno.EROFS, lasting=True):
        with pytest.raises(StorageError, match=r"^\S*/a/b: cannot be written: .* read-only"):
            storage.probe_writable(tmp_path / "a" / "b")
    assert names(tmp_path) == []


def test_probe_below_a_file_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    for folder in (tmp_path / "file" / "folder", tmp_path / "file"):
        with pytest.raises(StorageError) as caught:
            storage.probe_writable(folder)
        assert str(caught.value) == (
            f"{folder}: cannot be written: a part of the path is a file; choose another folder"
        )
    assert names(tmp_path) == ["file"]


def test_messages_say_what_to_do(tmp_path):
    for code, hint in [(errno.ENOSPC, "free space"), (errno.EACCES, "permission"), (9999, "check")]:
        error = storage.storage_error("cannot be written", tmp_path, OSError(code, "reason"))
        assert hint in str(error)
    assert "odd" in str(storage.storage_error("cannot be written", tmp_path, OSError("odd")))
    assert json.loads(storage.to_json({"b": 1, "a": 2}, sort_keys=True)) == {"a": 2, "b": 1}


def test_a_file_in_place_of_a_folder_is_refused(tmp_path):
    (tmp_path / "taken").write_text("x")
    with pytest.raises(StorageError, match="taken"):
        storage.make_folder(tmp_path / "taken")
