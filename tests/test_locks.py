# SPDX-License-Identifier: MIT
"""One process at a time writes into a folder, and no link leads out of it."""

from __future__ import annotations

import errno
import os
import signal
import time
from pathlib import Path

import pytest

from sononerf import locks, storage
from sononerf.errors import LockedError, StorageError

OPEN = Path("/proc/self/fd")
"""Lists the files that this process has open, on Linux."""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def fork(work):
    """Run `work` in a forked child; return its pid."""
    pid = os.fork()
    if pid == 0:
        try:
            work()
        except BaseException:
            os._exit(1)
        os._exit(0)
    return pid


def test_lock_refuses_the_second_and_names_the_first(tmp_path):
    with locks.lock(tmp_path):
        with pytest.raises(LockedError, match=rf"process {os.getpid()} on .* since \d{{4}}-"):
            with locks.lock(tmp_path):
                pass
    with locks.lock(tmp_path):
        pass
    assert names(tmp_path) == []


def test_lock_is_not_taken_on_a_name_that_its_last_owner_removed(tmp_path, monkeypatch):
    real, names_removed = locks.fcntl.flock, []

    def flock(descriptor, operation):
        if not names_removed:
            names_removed.append((tmp_path / ".lock").unlink())
        real(descriptor, operation)

    monkeypatch.setattr(locks.fcntl, "flock", flock)
    with locks.lock(tmp_path):
        assert names(tmp_path) == [".lock"]
        with pytest.raises(LockedError), locks.lock(tmp_path):
            pass


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork.*:DeprecationWarning")  # only locks
def test_lock_dies_with_its_process(tmp_path):
    ready = tmp_path / "ready"

    def hold():
        with locks.lock(tmp_path):
            storage.commit_bytes(ready, b"")
            time.sleep(60)

    pid = fork(hold)
    while not ready.exists():
        time.sleep(0.005)
    with pytest.raises(LockedError, match=f"process {pid} "):
        with locks.lock(tmp_path):
            pass
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    with locks.lock(tmp_path):
        pass


def test_nothing_of_a_dead_owner_stays_in_the_lock(tmp_path):
    (tmp_path / ".lock").write_text("process 1 " + 500 * "x")
    with locks.lock(tmp_path):
        text = (tmp_path / ".lock").read_text()
    assert text.startswith(f"process {os.getpid()} on ")
    assert "xx" not in text


def test_only_the_lock_of_a_dead_process_is_removed(tmp_path):
    (tmp_path / ".lock").write_text("process 1 on a machine that lost its power\n")
    (tmp_path / ".metrics.json.999999.tmp").write_text("half")
    locks.remove_dead(tmp_path)
    assert names(tmp_path) == []
    with locks.lock(tmp_path):
        locks.remove_dead(tmp_path)
        assert names(tmp_path) == [".lock"]


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork.*:DeprecationWarning")  # only locks
def test_of_many_at_once_one_holds_the_lock_at_a_time(tmp_path):
    def work():
        deadline = time.monotonic() + 20
        for _ in range(10):
            while True:
                try:
                    with locks.lock(tmp_path):
                        descriptor = os.open(tmp_path / "inside", os.O_CREAT | os.O_EXCL)
                        os.close(descriptor)
                        os.unlink(tmp_path / "inside")  # noqa: PTH108
                    break
                except LockedError:
                    if time.monotonic() > deadline:
                        raise
                    time.sleep(0.0005)

    pids = [fork(work) for _ in range(4)]
    assert [os.waitpid(pid, 0)[1] for pid in pids] == [0] * 4


@pytest.mark.parametrize("name", [".lock", "metrics.json", "checkpoints", "epochs/0001/mip_x.png"])
@pytest.mark.parametrize("kind", ["file", "folder", "nothing"])
def test_a_folder_with_links_is_not_held(tmp_path, name, kind):
    outside, run = tmp_path / "outside", tmp_path / "run"
    if kind == "file":
        outside.write_text("precious")
    elif kind == "folder":
        outside.mkdir()
    (run / name).parent.mkdir(parents=True)
    (run / name).symlink_to(outside)
    with pytest.raises(StorageError, match=f"{name}: .*is a link.*; put the file"):
        with locks.lock(run):
            pass
    assert outside.exists() == (kind != "nothing")
    assert kind != "file" or outside.read_text() == "precious"
    assert names(run) == [name.partition("/")[0]]


def test_a_folder_that_is_a_link_itself_is_held(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    with locks.lock(tmp_path / "run"):
        assert names(tmp_path / "disk") == [".lock"]


@pytest.mark.skipif(not OPEN.is_dir(), reason="no list of open files")
def test_a_refused_lock_leaves_no_file_open(tmp_path, monkeypatch):
    with locks.lock(tmp_path):
        before = len(names(OPEN))
        for _ in range(3):
            with pytest.raises(LockedError), locks.lock(tmp_path):
                pass
        assert len(names(OPEN)) == before

    def fail(descriptor, operation):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(locks.fcntl, "flock", fail)
    before = len(names(OPEN))
    with pytest.raises(StorageError, match="cannot be locked"), locks.lock(tmp_path):
        pass
    assert len(names(OPEN)) == before


def test_a_folder_that_is_missing_is_made_to_be_locked(tmp_path):
    with locks.lock(tmp_path / "new" / "run"):
        assert locks.is_held(tmp_path / "new" / "run")
