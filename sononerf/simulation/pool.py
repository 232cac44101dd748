# SPDX-License-Identifier: MIT
"""Processes of this machine that compute for this one; they are kept for the next time."""

from __future__ import annotations

import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from sononerf.errors import ResourceError, SonoNerfError
from sononerf.simulation.processes import process_context, starting_workers

QUEUED = 4
"""Tasks that a worker has at most: one that it computes, and others so that it need not wait."""
LOOK_SECONDS = 0.2
"""How often it is asked whether to stop, s."""
SENT_AGAIN = 3
"""Times that a task is sent again after its worker died."""


class TaskError(SonoNerfError):
    """A task failed in a worker.

    Attributes:
        number: Number of the task.
        exit_code: Exit code of the error that the worker raised.
    """

    def __init__(self, number: int, text: str, exit_code: int) -> None:
        super().__init__(text)
        self.number, self.exit_code = number, exit_code


@dataclass(eq=False)
class _Worker:
    """A process and the pipe to it.

    Attributes:
        process, pipe: Each worker has a pipe of its own: if it dies, nobody waits for the rest of
            its answer.
        tasks: Tasks that were sent and are unanswered; it computes the first one.
        ready: Whether it holds the object that the tasks are about.
    """

    process: BaseProcess
    pipe: Connection
    tasks: deque[int] = field(default_factory=deque)
    ready: bool = False

    @classmethod
    def start(cls) -> _Worker:
        context = process_context()
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs,), daemon=True)  # type: ignore[attr-defined]
        with starting_workers():
            process.start()
        theirs.close()
        return cls(process, ours)

    def forgets(self) -> bool:
        """Let it forget the object; return False if it is dead."""
        try:
            if self.ready:
                self.pipe.send(None)
        except OSError:
            return False
        self.ready = False
        return True

    def end(self) -> None:
        self.process.terminate()
        self.process.join()
        self.pipe.close()


_idle: list[_Worker] = []
os.register_at_fork(after_in_child=_idle.clear)


def _taken() -> _Worker:
    """Take an idle worker, or start one; other threads may take some at the same time."""
    try:
        return _idle.pop()
    except IndexError:
        return _Worker.start()


def computed(
    function: Callable[..., Any],
    thing: object,
    tasks: Mapping[int, tuple[Any, ...]],
    workers: int,
    *,
    what: str = "pose",
    stop: threading.Event | None = None,
) -> Generator[tuple[int, Any], None, None]:
    """Yield the number of each task and ``function(thing, *task)``, in any order.

    If a worker is killed, its tasks are sent to another one.

    Args:
        function: Function of a module; workers import it.
        thing: Common argument of all tasks; it is sent once to each worker, which drops it at the
            end.
        tasks: Further arguments of the function, by number; sent one by one.
        workers: Number of processes.
        what: Name of one task, for messages.
        stop: Ends it when set.

    Raises:
        CancelledError: If it was stopped.
        TaskError: If the function, or sending its argument, raises an error in a worker.
        ResourceError: If the workers of a task die again and again.
    """
    left, lost = deque(tasks), Counter[int]()
    crew = [_taken() for _ in range(workers)]
    try:
        while left or any(worker.tasks for worker in crew):
            for place, worker in enumerate(crew):
                try:
                    _feed(worker, left, tasks, (function, thing))
                except OSError:
                    crew[place] = _replaced(worker, left, lost, what)
            ready = wait(
                [worker.pipe for worker in crew if worker.tasks],
                None if stop is None else LOOK_SECONDS,
            )
            if stop is not None and stop.is_set():
                raise CancelledError
            for place, worker in enumerate(crew):
                if worker.pipe not in ready:
                    continue
                try:
                    answer, fault = worker.pipe.recv()
                except (EOFError, OSError):
                    crew[place] = _replaced(worker, left, lost, what)
                    continue
                number = worker.tasks.popleft()
                if fault is not None:
                    raise TaskError(number, *fault)
                yield number, answer
    finally:
        for worker in crew:
            if worker.tasks or not worker.forgets():
                worker.end()
            else:
                _idle.append(worker)


def _feed(
    worker: _Worker, left: deque[int], tasks: Mapping[int, tuple[Any, ...]], work: object
) -> None:
    """Send a worker as many tasks as it may have.

    Raises:
        OSError: If it is dead.
    """
    while left and len(worker.tasks) < QUEUED:
        worker.tasks.append(left.popleft())
        if not worker.ready:
            worker.pipe.send(work)
            worker.ready = True
        worker.pipe.send(tasks[worker.tasks[-1]])


def _replaced(worker: _Worker, left: deque[int], lost: Counter[int], what: str) -> _Worker:
    """Take a dead worker's tasks back; return another worker.

    Raises:
        ResourceError: If the task that it computed killed too many.
    """
    first = worker.tasks[0]
    left.extendleft(reversed(worker.tasks))
    worker.tasks.clear()
    worker.end()
    lost[first] += 1
    if lost[first] > SENT_AGAIN:
        raise ResourceError(
            f"{what} {first}: every worker that took it was killed; give workers more memory, or "
            "start fewer; the same command goes on with what is missing"
        )
    return _Worker.start()


def _serve(pipe: Connection) -> None:
    """Answer tasks until the other process closes the pipe or ends."""
    parent = parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
    try:
        while True:
            _answer(pipe)
    except (EOFError, OSError):
        return


def _answer(pipe: Connection) -> None:
    """Receive a function and an object, and compute until told to forget them.

    Raises:
        EOFError, OSError: If the other end is closed.
    """
    function, fault = None, None
    try:
        function, thing = pipe.recv()
    except (EOFError, OSError):
        raise
    except Exception as error:
        fault = (
            fault_of(error),
            SonoNerfError.exit_code,
        )  # the object cannot be made here: each task is told so
    while (task := pipe.recv()) is not None:
        answer = None
        if function is not None:
            fault = None
            try:
                answer = function(thing, *task)
            except Exception as error:
                fault = fault_of(error), getattr(error, "exit_code", SonoNerfError.exit_code)
        pipe.send((answer, fault))


def fault_of(error: Exception) -> str:
    """Return the text of an error in one line; of an error that is not ours, its kind too."""
    text = " ".join(str(error).split())
    return text if isinstance(error, SonoNerfError) else f"{type(error).__name__}: {text}"
