# SPDX-License-Identifier: MIT
"""Simulate poses in this process, in other processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import logging
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from sononerf.array_types import Floats, Singles
from sononerf.errors import ResourceError, SettingsError, SonoNerfError
from sononerf.geometry.poses import Poses
from sononerf.memory import available_cores
from sononerf.simulation.hybrid import tracer_of
from sononerf.simulation.pool import QUEUED, SENT_AGAIN, TaskError, computed, fault_of
from sononerf.simulation.simulator import Simulator

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger("sononerf")

MOST_WORKERS = 8
WORTH_RAYS = 250_000
"""Rays of all poses from which other processes save time: fewer are traced before these start."""
RAYS_FOR_OTHERS = 4_000
"""Number of rays that a pose counts for if its engine traces none: from 63 poses on processes save
time."""
CONNECT_SECONDS = 30
"""Time to wait for a Dask scheduler, s; across a network it answers in one."""
PATIENCE_SECONDS = 10
"""Time without a result after which a cluster without workers is warned of, s."""

Results = Generator[tuple[int, Singles], None, None]
SeedOf = Callable[[int], int]
"""Gives the seed of a pose by its index."""


def useful_workers(poses: int, rays: int) -> int:
    """Return the number of processes that simulates the poses soonest; one means this process."""
    return min(available_cores(), MOST_WORKERS) if poses * rays >= WORTH_RAYS else 1


def simulated(
    simulator: Simulator,
    poses: Poses,
    indices: list[int],
    seed_of: SeedOf,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Results:
    """Yield indices and spectrograms of poses, in any order.

    Args:
        simulator: Scene and head.
        poses: All of them.
        indices: Indices of the wanted ones.
        seed_of: Gives the seed of a pose by its index.
        workers: Processes on this machine; one means this process. Where None, as many as there are
            cores, at most 8, if they save time.
        scheduler: Address of a Dask scheduler whose workers are used instead.
    """
    engine = simulator.engine
    if workers is None:
        tracer = tracer_of(engine)
        rays = RAYS_FOR_OTHERS if tracer is None else tracer.rays
        workers = 1 if engine.prepares else useful_workers(len(indices), rays)
    if engine.prepares and (scheduler is not None or workers > 1):
        logger.warning(
            "%s solves for all poses at once, in this process; workers and scheduler are not used",
            type(engine).__name__,
        )
        workers, scheduler = 1, None
    engine.prepare(poses.positions[indices], poses.rotations[indices])
    if scheduler is not None:
        return on_cluster(simulator, poses, indices, seed_of, scheduler)
    if workers > 1:
        return in_processes(simulator, poses, indices, seed_of, workers)
    return in_this_process(simulator, poses, indices, seed_of)


def in_this_process(
    simulator: Simulator, poses: Poses, indices: list[int], seed_of: SeedOf
) -> Results:
    """Simulate poses one after the other."""
    for index in indices:
        try:
            spectrogram = _one(simulator, *_pose(poses, index), seed_of(index))
        except Exception as error:
            raise _failed(index, fault_of(error)) from error
        yield index, spectrogram


def in_processes(
    simulator: Simulator, poses: Poses, indices: list[int], seed_of: SeedOf, workers: int
) -> Results:
    """Simulate poses in other processes of this machine; they come in any order.

    Raises:
        ResourceError: If the workers of a pose die again and again.
    """
    tasks = {index: (*_pose(poses, index), seed_of(index)) for index in indices}
    try:
        yield from computed(_one, simulator, tasks, workers)
    except TaskError as error:
        raise _failed(error.number, str(error)) from error


def _one(simulator: Simulator, position: Floats, rotation: Floats, seed: int) -> Singles:
    return simulator.spectrogram(position, rotation, seed=seed)


def _pose(poses: Poses, index: int) -> tuple[Floats, Floats]:
    return poses.positions[index], poses.rotations[index]


def _failed(index: int, text: str) -> SonoNerfError:
    return SonoNerfError(f"pose {index} cannot be simulated: {text}")


def on_cluster(
    simulator: Simulator, poses: Poses, indices: list[int], seed_of: SeedOf, scheduler: str
) -> Results:
    """Simulate poses on the workers of a Dask scheduler; they come in any order.

    Raises:
        SettingsError: If Dask is not installed.
        ResourceError: If the scheduler is gone, or the workers of a pose die again and again.
    """
    with _client(scheduler) as client:
        executor, sent = client.get_executor(pure=False), _send(client, simulator)
        left, running, lost = deque(indices), dict[Future[Any], int](), Counter[int]()
        told = False
        while left or running:
            # Workers come and go.
            threads = _threads(client)
            while left and len(running) < QUEUED * max(1, threads):
                index = left.popleft()
                task = *_pose(poses, index), seed_of(index)
                running[executor.submit(_one, sent, *task)] = index
            done = wait(running, PATIENCE_SECONDS, return_when=FIRST_COMPLETED).done
            if not (done or threads or told):  # others may start some tomorrow
                logger.warning("the Dask scheduler has no workers; waiting for some")
            told = not (done or threads)
            for future in done:
                index = running.pop(future)
                try:
                    spectrogram = future.result()
                except CancelledError as error:
                    raise _unreachable(error) from error
                except Exception as error:
                    if type(error).__name__ != "KilledWorker":
                        raise _failed(index, fault_of(error)) from error
                    # A pose is blamed only after repeated deaths of its workers.
                    lost[index] += 1
                    if lost[index] > SENT_AGAIN:
                        raise ResourceError(
                            f"pose {index}: every worker that took it was killed; give workers "
                            "more memory, or start fewer on a machine"
                        ) from error
                    left.appendleft(index)
                    if sent.status == "error":
                        sent = _send(client, simulator)
                    continue
                yield index, spectrogram


def _receive(simulator: Simulator) -> Simulator:
    return simulator


def _send(client: Client, simulator: Simulator) -> Any:
    """Send the simulator once, as a task, so that it can be rebuilt if its worker dies."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sending large graph", category=UserWarning)
        return client.submit(_receive, simulator, pure=False)


def _threads(client: Client) -> int:
    try:
        return sum(client.nthreads().values())
    except OSError as error:
        raise _unreachable(error) from error


def _unreachable(error: BaseException) -> ResourceError:
    return ResourceError(
        f"the Dask scheduler is gone ({type(error).__name__}); the same command goes on with what "
        "is missing"
    )


@contextmanager
def _client(scheduler: str) -> Iterator[Client]:
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise SettingsError(
            "--scheduler: Dask is not installed; pip install 'sononerf[cluster]'"
        ) from error
    with ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.admin.log-level": "error"}))
        stack.enter_context(_quiet("distributed"))
        try:
            client = stack.enter_context(Client(scheduler, timeout=CONNECT_SECONDS))
        except (OSError, ValueError, RuntimeError) as error:
            raise ResourceError(f"{scheduler} cannot be reached: {error}") from error
        yield client


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Silence a package's loggers; it has given some of them levels of their own."""
    names = [known for known in logging.root.manager.loggerDict if known.split(".")[0] == name]
    levels = {known: logging.getLogger(known).level for known in names}
    for known in names:
        logging.getLogger(known).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for known, level in levels.items():
            logging.getLogger(known).setLevel(level)
