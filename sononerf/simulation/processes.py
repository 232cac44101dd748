# SPDX-License-Identifier: MIT
"""Start of worker processes; light, so that it can be done first."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import BaseContext
from typing import Any

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that limit numerical libraries to one thread in each worker."""
SIMULATOR = "sononerf.simulation.ready"
"""What workers import."""


def process_context() -> BaseContext:
    """Return how workers are started.

    On Linux a server imports the simulator once and forks; elsewhere each process imports it.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([SIMULATOR])
    return context


def begin() -> None:
    """Let that server import the simulator while this process goes on."""
    process_context()
    if sys.platform == "linux":
        with starting_workers():
            forkserver.ensure_running()


_STARTING = threading.RLock()


@contextmanager
def starting_workers() -> Iterator[None]:
    """Give processes that start in the block one thread each, and block SIGINT in them.

    A terminal sends Ctrl-C to all processes. This one ends the workers, so that none of them
    prints a traceback. Workers do not run the script that started them: it need not be written
    for that.
    """
    with _STARTING:  # environment and script are put back before another thread changes them
        yield from _changed()


def _changed() -> Iterator[None]:
    script = vars(sys.modules["__main__"])
    kept: dict[str, Any] = {
        name: script[name] for name in ("__file__", "__spec__") if name in script
    }
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    # Where it is not running yet, its start would let the signal through again.
    resource_tracker.ensure_running()
    heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        script.update(dict.fromkeys(kept))
        yield
    finally:
        script.update(kept)
        signal.pthread_sigmask(signal.SIG_SETMASK, heard)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
