# SPDX-License-Identifier: MIT
"""One process at a time writes into a folder, and no link leads out of it."""

from __future__ import annotations

import os
import signal
import time

import pytest

from sononerf import storage
from sononerf.errors import LockedError, StorageError


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


def test_lock_refuses_the_second_until_the_first_is_done(tmp_path):
    with storage.lock(tmp_path):
        assert storage.is_held(tmp_path)
        with pytest.raises(LockedError, match="in use by another process"), storage.lock(tmp_path):
            pass
    assert not storage.is_held(tmp_path)
    with storage.lock(tmp_path):
        pass


def test_a_leftover_of_a_dead_process_is_removed(tmp_path):
    (tmp_path / ".metrics.json.999999.tmp").write_text("half")
    with storage.lock(tmp_path):
        assert names(tmp_path) == [".lock"]


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork.*:DeprecationWarning")  # only locks
def test_lock_dies_with_its_process(tmp_path):
    ready = tmp_path / "ready"

    def hold():
        with storage.lock(tmp_path):
            storage.commit_bytes(ready, b"")
            time.sleep(60)

    pid = fork(hold)
    while not ready.exists():
        time.sleep(0.005)
    with pytest.raises(LockedError), storage.lock(tmp_path):
        pass
    assert storage.is_held(tmp_path)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    assert not storage.is_held(tmp_path)
    with storage.lock(tmp_path):
        pass


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork.*:DeprecationWarning")  # only locks
def test_of_many_at_once_one_holds_the_lock_at_a_time(tmp_path):
    def work():
        deadline = time.monotonic() + 60
        for _ in range(10):
            while True:
                try:
                    with storage.lock(tmp_path):
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
        with storage.lock(run):
            pass
    assert outside.exists() == (kind != "nothing")
    assert kind != "file" or outside.read_text() == "precious"
    assert set(names(run)) == {name.partition("/")[0], ".lock"}


def test_a_folder_that_is_a_link_itself_is_held(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    with storage.lock(tmp_path / "run"):
        assert names(tmp_path / "disk") == [".lock"]


def test_a_folder_that_is_missing_is_made_to_be_locked(tmp_path):
    with storage.lock(tmp_path / "new" / "run"):
        assert storage.is_held(tmp_path / "new" / "run")
