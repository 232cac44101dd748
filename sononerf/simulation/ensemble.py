# SPDX-License-Identifier: MIT
"""Many poses: which ones, whether they make sense, and all their spectrograms."""

from __future__ import annotations

import logging
import signal
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sononerf.array_types import Bools, Floats, Singles
from sononerf.echoes.echoes import Echoes
from sononerf.echoes.store import EnsembleStore, seal
from sononerf.errors import InputError, NumericalError, ResourceError, SonoNerfError
from sononerf.geometry.poses import Poses
from sononerf.geometry.raycast import winding_numbers
from sononerf.memory import available_cores
from sononerf.progress import Progress
from sononerf.scene.scene import Scene
from sononerf.settings.schema import SimulationSettings
from sononerf.simulation.simulator import Simulator

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger("sononerf")

Write = Callable[[int, Singles], None]

MOST_WORKERS = 8
WORTH_WORKERS = 64
"""Number of poses from which other processes save time: fewer are done before these start."""
CONNECT_SECONDS = 30  # a scheduler across a network answers in one
QUEUED_PER_WORKER = 4  # results wait in memory; more than this would only fill it
PATIENCE_SECONDS = 10  # without a result, before workers are looked for
GIVEN_UP_AFTER = 6  # such times on end without any worker of our own: none will come again
SENT_AGAIN = 3  # times, and each time Dask itself tries four workers


def pose_seed(seed: int, index: int) -> int:
    """Seed of one pose of an ensemble; who simulates it, and when, does not matter."""
    state = np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)
    return int(state[0])


def check_poses(scene: Scene, poses: Poses, *, offsets: Floats | None = None) -> None:
    """Refuse poses that are no numbers or lie inside the surface.

    Args:
        scene: What is ensonified.
        poses: To be checked.
        offsets ((K, 3), m): Further points of the head that must be outside, such as emitter and
            ears; head frame.
    """
    finite = np.isfinite(poses.positions).all(axis=1) & np.isfinite(poses.rotations).all((1, 2))
    _refuse(~finite, "no finite numbers")
    points = np.zeros((1, 3)) if offsets is None else np.vstack([np.zeros((1, 3)), offsets])
    places = poses.positions[:, None] + np.einsum("pij,kj->pki", poses.rotations, points)
    winding = winding_numbers(scene.mesh.vertices, scene.mesh.faces, places.reshape(-1, 3))
    inside = np.abs(winding.reshape(places.shape[:2])) > 0.5
    _refuse(inside.any(axis=1), "inside the scene's surface")


def _refuse(bad: ArrayLike, what: str) -> None:
    bad = np.asarray(bad)
    if bad.any():
        raise InputError(f"{_named(bad)} {what}; move them, or raise poses.radius")


def _named(bad: Bools) -> str:
    """Say how many poses there are of a kind, and which are the first ten."""
    indices = np.flatnonzero(bad)
    listed = ", ".join(str(index) for index in indices[:10])
    return (
        f"{len(indices)} of {len(bad)} poses ({listed}{', ...' if len(indices) > 10 else ''}) are"
    )


def check_reach(
    scene: Scene, poses: Poses, *, bounces: int, range_min: float, range_max: float
) -> None:
    """Warn of poses that no echo can reach within the range limits.

    Args:
        scene: What is ensonified.
        poses: To be checked.
        bounces: How often sound may hit.
        range_min, range_max (m): The limits of the spectrograms.

    Raises:
        NumericalError: If it is so for all poses; the tails of the analysis would pass for echoes.
    """
    lower, upper = np.asarray(scene.mesh.bounds)
    radius = float(np.linalg.norm(upper - lower)) / 2.0
    nearest = np.linalg.norm(poses.positions - np.clip(poses.positions, lower, upper), axis=1)
    distance = np.linalg.norm(poses.positions - (lower + upper) / 2.0, axis=1)
    far, near = nearest > range_max, distance + bounces * radius < range_min
    if (far | near).all():
        raise NumericalError(deaf(range_min, range_max))
    for bad, what, limit in (
        (far, "farther from the scene than range_max", range_max),
        (near, "nearer to all of the scene than range_min", range_min),
    ):
        if bad.any():
            logger.warning(
                "%s %s (%g m) and will hear nothing; set spectrogram.range_%s, or move them",
                *(_named(bad), what, limit, "max" if bad is far else "min"),
            )


def deaf(range_min: float, range_max: float) -> str:
    """Say that no pose hears anything within the range limits."""
    return (
        f"no pose received an echo between {range_min} and {range_max} m; check poses.radius, "
        "the scene's size (of a file, its unit) and the range limits"
    )


def simulate(
    simulator: Simulator,
    poses: Poses,
    store: EnsembleStore,
    options: SimulationSettings,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress,
) -> Echoes:
    """Simulate what is missing of a store, and seal it.

    The test poses are simulated twice, with other rays, which gives the noise floor.

    Args:
        simulator: Scene and head.
        poses: Those of the store.
        store: Opened for writing.
        options: Seed, and number of test poses for the noise floor.
        workers: Processes; as many as there are cores, at most 8, where None.
        scheduler: Address of a Dask scheduler to use instead.
        progress: Where to show it.
    """
    missing = store.missing()
    if workers is None:
        cores = min(available_cores(), MOST_WORKERS)
        alone = simulator.engine.prepares or len(missing) < WORTH_WORKERS
        workers = 1 if alone else cores
    test = store.indices("test")[: options.noise_floor_poses]
    again: dict[int, Singles] = {}
    wanted = [*missing, *test]
    simulator.prepare(poses.positions[wanted], poses.rotations[wanted], progress)
    with progress.task("simulating", len(missing) + len(test)) as task:
        # The second simulation of the test poses goes first where it can share the processes.
        def keep(index: int, spectrogram: Singles) -> None:
            if index < len(poses):
                store.write_pose(index, spectrogram)
            else:
                again[int(test[index - len(poses)])] = spectrogram
            task.advance()

        both = Poses(
            np.concatenate((poses.positions, poses.positions[test])),
            np.concatenate((poses.rotations, poses.rotations[test])),
        )
        # A pose's seed is a function of its number, so the second time has other rays.
        extra = range(len(poses), len(poses) + len(test))
        simulate_ensemble(
            simulator,
            both,
            [*missing, *extra],
            keep,
            seed=options.seed,
            workers=workers,
            scheduler=scheduler,
        )
    analysis = simulator.head.analysis
    silent = deaf(analysis.range_min, analysis.range_max)
    seal(store, {int(i): again[int(i)] for i in test}, silent=silent)
    return Echoes(store, simulator.head)


def simulate_ensemble(
    simulator: Simulator,
    poses: Poses,
    indices: Iterable[int],
    write: Write,
    *,
    seed: int,
    workers: int = 1,
    scheduler: str | None = None,
) -> None:
    """Simulate poses and hand over each spectrogram as it comes.

    The result of a pose depends on ``seed`` and its index alone, not on workers or order.

    Args:
        simulator: Scene and head.
        poses: All poses of the ensemble.
        indices: Which of them to simulate.
        write: Takes an index and its spectrogram (E, R, F); called here, one at a time.
        seed: Of the ensemble.
        workers: Processes on this machine; one means this process.
        scheduler: Address of a Dask scheduler whose workers are used instead.
    """
    wanted = [int(index) for index in indices]
    engine = simulator.engine
    if engine.prepares and (scheduler is not None or workers > 1):
        logger.warning(
            "%s solves for all poses at once, in this process; workers and scheduler are not used",
            type(engine).__name__,
        )
        workers, scheduler = 1, None
    engine.prepare(poses.positions[wanted], poses.rotations[wanted])
    if scheduler is None and workers <= 1:
        for index, spectrogram in _simulate_here(simulator, poses, wanted, seed):
            write(index, spectrogram)
    elif wanted:
        with _workers(workers, scheduler) as client:
            ours = scheduler is None
            results = _simulate_there(client, simulator, poses, wanted, seed, ours=ours)
            for index, spectrogram in results:
                write(index, spectrogram)


def _failed(index: int, error: BaseException) -> SonoNerfError:
    text = " ".join(str(error).split())
    return SonoNerfError(f"pose {index} cannot be simulated: {type(error).__name__}: {text}")


def _simulate_here(
    simulator: Simulator, poses: Poses, indices: list[int], seed: int
) -> Iterator[tuple[int, Singles]]:
    for index in indices:
        try:
            spectrogram = simulator.spectrogram(
                poses.positions[index], poses.rotations[index], seed=pose_seed(seed, index)
            )
        except Exception as error:
            raise _failed(index, error) from error
        yield index, spectrogram


def _receive(simulator: Simulator) -> Simulator:
    return simulator


def _one(simulator: Simulator, position: Floats, rotation: Floats, seed: int) -> Singles:
    return simulator.spectrogram(position, rotation, seed=seed)


def _simulate_there(
    client: Client,
    simulator: Simulator,
    poses: Poses,
    indices: list[int],
    seed: int,
    *,
    ours: bool,
) -> Iterator[tuple[int, Singles]]:
    from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait

    from distributed import KilledWorker

    executor, sent = client.get_executor(pure=False), _send(client, simulator)
    left, running, lost = deque(indices), dict[Future[Any], int](), Counter[int]()
    idle = 0
    while left or running:
        # Workers come and go.
        threads = _threads(client)
        while left and len(running) < QUEUED_PER_WORKER * max(1, threads):
            index = left.popleft()
            pose = poses.positions[index], poses.rotations[index]
            running[executor.submit(_one, sent, *pose, pose_seed(seed, index))] = index
        done = wait(running, PATIENCE_SECONDS, return_when=FIRST_COMPLETED).done
        idle = idle + 1 if not done and not threads else 0
        if idle == 1:
            logger.warning("the Dask scheduler has no workers; waiting for some")
        if ours and idle >= GIVEN_UP_AFTER:  # on a cluster others may start some tomorrow
            raise ResourceError(
                "all workers on this machine were killed, and none came back; give them more "
                "memory, or start fewer; the same command goes on with what is missing"
            )
        for future in done:
            index = running.pop(future)
            try:
                spectrogram = future.result()
            except KilledWorker as error:
                # Whose workers died is not to blame, until it has happened again and again.
                lost[index] += 1
                if lost[index] > SENT_AGAIN:
                    raise ResourceError(
                        f"pose {index}: every worker that took it was killed; give workers more "
                        "memory, or start fewer on a machine"
                    ) from error
                left.appendleft(index)
                if sent.status == "error":
                    sent = _send(client, simulator)
                continue
            except CancelledError as error:
                raise _unreachable(error) from error
            except Exception as error:
                raise _failed(index, error) from error
            yield index, spectrogram


def _send(client: Client, simulator: Simulator) -> Any:
    """Send the simulator once, as a task: what dies with a worker can be made again."""
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
def _workers(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Connect to a scheduler, or start processes here that end with the block."""
    import dask
    from distributed import Client, LocalCluster

    with ExitStack() as stack:
        # Its workers run numerical libraries on one thread each; that is Dask's own default.
        stack.enter_context(dask.config.set({"distributed.admin.log-level": "error"}))
        stack.enter_context(_quiet("distributed"))
        try:
            if scheduler is None:
                with _deaf_to_interrupts():
                    cluster = LocalCluster(
                        n_workers=workers,
                        threads_per_worker=1,
                        processes=True,
                        dashboard_address="127.0.0.1:0",  # none would still take port 8787
                        silence_logs=logging.CRITICAL,
                    )
                scheduler = stack.enter_context(cluster)
            client = stack.enter_context(Client(scheduler, timeout=CONNECT_SECONDS))
        except (OSError, ValueError, RuntimeError) as error:
            where = scheduler if isinstance(scheduler, str) else f"{workers} local workers"
            raise ResourceError(f"{where} cannot be reached: {error}") from error
        yield client


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from threads and processes that are started in the block, and those of theirs.

    A terminal sends it to all of them; we alone end them, and without a traceback of each.
    """
    # Where it is not running yet, its start would let the signal through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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
