# SPDX-License-Identifier: MIT
"""Cores, memory, and one executor: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures import ProcessPoolExecutor as ProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing import forkserver
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any, TypeVar

from sononerf.errors import ResourceError, SettingsError, SonoNerfError


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


Part = TypeVar("Part")
Result = TypeVar("Result")


def in_threads(work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Return the result of each part, computed in as many threads as there are cores.

    It pays where the work is in NumPy or in compiled functions, beside which other threads can run.
    """
    with ThreadPoolExecutor(available_cores()) as pool:
        return list(pool.map(work, parts))


def available_memory() -> int | None:
    """Return the memory that can still be taken, in bytes; None where the system does not say."""
    free: list[int] = []
    meminfo = Path("/proc/meminfo")
    if meminfo.is_file():
        for line in meminfo.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(int(line.split()[1]) * 1024)
    else:
        try:
            free.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        except (AttributeError, ValueError, OSError):
            return None
    # A container may be held to less than the machine has.
    limit, used = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")
    if limit.is_file() and used.is_file():
        bound = limit.read_text(encoding="ascii").strip()
        if bound != "max":
            free.append(int(bound) - int(used.read_text(encoding="ascii")))
    return max(0, min(free)) if free else None


def require_memory(needed: float, what: str, remedy: str) -> None:
    """Refuse work that needs more memory than is free, before it begins."""
    free = available_memory()
    if free is not None and needed > free:
        raise ResourceError(
            f"{what} needs about {gigabytes(needed)} of memory, and {gigabytes(free)} are free; "
            f"{remedy}"
        )


def require_disk(needed: float, folder: Path, what: str, remedy: str) -> None:
    """Refuse files that need more space than the disk has free, before they are written."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    free = shutil.disk_usage(there).free
    if needed > free:
        raise ResourceError(
            f"{what} needs about {gigabytes(needed)} of disk, and {gigabytes(free)} are free at "
            f"{there}; {remedy}"
        )


def gigabytes(count: float) -> str:
    """Return a number of bytes as text."""
    return f"{count / 1e9:.2g} GB" if count < 10e9 else f"{count / 1e9:,.0f} GB"


@contextmanager
def memory_faults() -> Iterator[None]:
    """Turn the errors that NumPy and torch raise where memory is short into one of ours."""
    free = available_memory()
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        said = str(error)
        full = ("allocate memory", "not enough memory", "out of memory")  # torch has no own class
        if not isinstance(error, MemoryError) and not any(word in said for word in full):
            raise
        amount = f", of which {gigabytes(free)} were free at the start" if free is not None else ""
        raise ResourceError(
            f"this needs more memory than there is{amount}; use smaller batches (fit.batch_poses), "
            "a smaller region, a coarser field or spectrogram, fewer poses at once, or a larger "
            "machine"
        ) from error


logger = logging.getLogger("sononerf")

QUEUED = 4
"""Tasks per worker that are submitted at once: one is computed, the others save waiting."""
ATTEMPTS = 4
"""Times in a row that workers may be killed before any task is finished."""
CONNECT_SECONDS = 10
"""Time to wait for a Dask scheduler, s; across a network it answers in one."""
_DEAD = ("KilledWorker", "CancelledError", "FutureCancelledError")
"""Names of Dask's errors for a task whose workers, or whose scheduler, are gone."""
_preloaded: list[str] = []


def preload(module: str) -> None:
    """Let worker processes that start from now on have imported a module."""
    if module not in _preloaded:
        _preloaded.append(module)


class TaskError(SonoNerfError):
    """A task failed in a worker.

    Attributes:
        number: Number of the task.
        exit_code: Exit code of the error that the worker raised.
    """

    def __init__(self, number: int, error: Exception) -> None:
        text = " ".join(str(error).split())
        known = isinstance(error, SonoNerfError)
        super().__init__(text if known else f"{type(error).__name__}: {text}")
        self.number, self.exit_code = number, getattr(error, "exit_code", SonoNerfError.exit_code)


def computed(
    function: Callable[..., Any],
    thing: object,
    tasks: Mapping[int, tuple[Any, ...]],
    workers: int,
    *,
    scheduler: str | None = None,
    what: str = "pose",
) -> Generator[tuple[int, Any], None, None]:
    """Yield the number of each task and ``function(thing, *task)``, in any order.

    If a worker is killed, its task is computed once more.
    """
    left, attempts = dict(tasks), 0
    while left:
        attempts += 1
        try:
            with _executor(thing, workers, scheduler) as (executor, held, count):
                for number, answer in _answers(executor, function, held, left, count):
                    del left[number]
                    attempts = 0
                    yield number, answer
        except BrokenExecutor as error:
            if attempts == ATTEMPTS or scheduler is not None:
                raise ResourceError(
                    f"{what} {min(left)}: every worker that took it was killed; give workers more "
                    "memory, or start fewer; the same command goes on with what is missing"
                ) from error


def _answers(
    executor: Executor,
    function: Callable[..., Any],
    held: Any,
    tasks: Mapping[int, tuple[Any, ...]],
    count: int,
) -> Iterator[tuple[int, Any]]:
    waiting, running = iter(list(tasks.items())), dict[Future[Any], int]()
    while True:
        while len(running) < QUEUED * count and (task := next(waiting, None)):
            with without_script():
                running[executor.submit(_call, function, held, *task[1])] = task[0]
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            number = running.pop(future)
            try:
                answer = future.result()
            except BrokenExecutor:
                raise
            except Exception as error:
                if type(error).__name__ in _DEAD:
                    raise BrokenExecutor from error
                raise TaskError(number, error) from error
            yield number, answer


@contextmanager
def _executor(
    thing: object, workers: int, scheduler: str | None
) -> Iterator[tuple[Executor, Any, int]]:
    """Open an executor; give it, the thing as its tasks take it, and the number of workers."""
    if scheduler is not None:
        with _client(scheduler) as client:
            count = sum(client.nthreads().values())
            if not count:
                logger.warning("the Dask scheduler has no workers; waiting for some")
            # As a task, so that it is made again if its worker dies.
            held = client.submit(_same, thing, pure=False)
            yield client.get_executor(pure=False), held, max(1, count)
        return
    pool = ProcessPool(workers, process_context(), _begin, (pickle.dumps(thing),))
    try:
        yield pool, None, workers
    finally:
        pool.shutdown(cancel_futures=True)


def _same(thing: object) -> object:
    return thing


_sent: list[bytes] = []
_made: list[Any] = []


def _begin(thing: bytes) -> None:
    """Begin a worker process: it leaves Ctrl-C to its parent, and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _sent.append(thing)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _call(function: Callable[..., Any], held: Any, *task: Any) -> Any:
    if held is None and _sent:
        if not _made:
            _made.append(pickle.loads(_sent[0]))
        held = _made[0]
    return function(held, *task)


def process_context() -> BaseContext:
    """Return the start method of workers: on Linux by a server that has imported what they need."""
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_preloaded)
    return context


def may_start_processes() -> bool:
    """Return False in a worker of ``multiprocessing.Pool``, which may not start any."""
    return not multiprocessing.current_process().daemon


def begin() -> None:
    """Let that server import while this process goes on."""
    process_context()
    if sys.platform == "linux":
        forkserver.ensure_running()


_STARTING = threading.RLock()


@contextmanager
def without_script() -> Iterator[None]:
    """Start workers that do not run the script that starts them: it need not be written for it."""
    with _STARTING:
        script = vars(sys.modules["__main__"])
        kept: dict[str, Any] = {n: script[n] for n in ("__file__", "__spec__") if n in script}
        script.update(dict.fromkeys(kept))
        try:
            yield
        finally:
            script.update(kept)


def check_scheduler(scheduler: str) -> None:
    """Connect to a Dask scheduler once, and raise :class:`ResourceError` if it does not answer."""
    with _client(scheduler):
        pass


@contextmanager
def _client(scheduler: str) -> Iterator[Any]:
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise SettingsError(
            "--scheduler: Dask is not installed; pip install 'sononerf[cluster]'"
        ) from error
    with ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.admin.log-level": "error"}))
        try:
            client = stack.enter_context(Client(scheduler, timeout=CONNECT_SECONDS))
        except (OSError, ValueError, RuntimeError) as error:
            raise ResourceError(f"{scheduler} cannot be reached: {error}") from error
        yield client
