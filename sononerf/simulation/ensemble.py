# SPDX-License-Identifier: MIT
"""Many poses: which ones, whether they make sense, and all their spectrograms."""

from __future__ import annotations

import logging
import math
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.config import Settings
from sononerf.errors import InputError, ResourceError, SonoNerfError
from sononerf.geometry.poses import Poses, random_sphere_poses, sphere_poses
from sononerf.scene import Scene
from sononerf.simulation.simulator import Simulator

if TYPE_CHECKING:
    from distributed import Client

Write = Callable[[int, NDArray[np.float32]], None]
Progress = Callable[[int, int], None]

TRAIN, VALIDATION, TEST = 0, 1, 2
CONNECT_SECONDS = 30  # a scheduler across a network answers in one
QUEUED_PER_WORKER = 4  # results wait in memory; more than this would only fill it


def ensemble_poses(settings: Settings) -> tuple[Poses, NDArray[np.int8]]:
    """Poses of an experiment: the training spiral, then those for validation, then for the test.

    Each set draws from a generator of its own, so that the number of one does not move another.

    Parameters
    ----------
    settings : Settings
        Section ``poses``.

    Returns
    -------
    poses : Poses
        All of them.
    split : (P,) int8
        0 train, 1 validation, 2 test.
    """
    wanted = settings.poses
    sets = (
        (TRAIN, wanted.count, sphere_poses),
        (VALIDATION, wanted.validation, random_sphere_poses),
        (TEST, wanted.heldout, random_sphere_poses),
    )
    made, split = [], []
    for member, count, draw in sets:
        generator = np.random.default_rng(np.random.SeedSequence([wanted.seed, member]))
        jitter = math.radians(wanted.aim_jitter_deg)
        made.append(draw(count, radius=wanted.radius, aim_jitter=jitter, generator=generator))
        split.append(np.full(count, member, dtype=np.int8))
    positions = np.concatenate([poses.positions for poses in made])
    rotations = np.concatenate([poses.rotations for poses in made])
    return Poses(positions, rotations), np.concatenate(split)


def pose_seed(seed: int, index: int) -> int:
    """Seed of one pose of an ensemble; who simulates it, and when, does not matter."""
    state = np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)
    return int(state[0])


def check_poses(scene: Scene, poses: Poses, *, offsets: NDArray[np.float64] | None = None) -> None:
    """Refuse poses that are no numbers or lie inside the surface.

    Parameters
    ----------
    scene : Scene
        What is ensonified.
    poses : Poses
        To be checked.
    offsets : (K, 3) float64, m, optional
        Further points of the head that must be outside, such as emitter and ears; head frame.

    Raises
    ------
    InputError
        Naming the first ten.
    """
    finite = np.isfinite(poses.positions).all(axis=1) & np.isfinite(poses.rotations).all((1, 2))
    _refuse(~finite, "no finite numbers")
    points = np.zeros((1, 3)) if offsets is None else np.vstack([np.zeros((1, 3)), offsets])
    places = poses.positions[:, None] + np.einsum("pij,kj->pki", poses.rotations, points)
    lower, upper = np.asarray(scene.mesh.bounds)
    inside = np.zeros(places.shape[:2], dtype=bool)
    corners = np.asarray(scene.mesh.triangles, dtype=np.float64)
    for pose, point in np.argwhere(((places >= lower) & (places <= upper)).all(axis=2)):
        inside[pose, point] = abs(_winding(corners, places[pose, point])) > 0.5
    _refuse(inside.any(axis=1), "inside the scene's surface")


def _refuse(bad: ArrayLike, what: str) -> None:
    bad = np.asarray(bad)
    indices = np.flatnonzero(bad)
    if len(indices):
        more = ", ..." if len(indices) > 10 else ""
        named = ", ".join(str(index) for index in indices[:10])
        raise InputError(
            f"{len(indices)} of {len(bad)} poses are {what}: {named}{more}; "
            "move them, or raise poses.radius"
        )


def _winding(corners: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    """How often the surface winds round a point; holds for overlapping bodies, unlike parity."""
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("td,td->t", a, np.cross(b, c))
    spread = la * lb * lc
    spread += (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(np.arctan2(volume, spread).sum() / (2.0 * math.pi))


def simulate_ensemble(
    simulator: Simulator,
    poses: Poses,
    indices: Iterable[int],
    write: Write,
    *,
    seed: int,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> None:
    """Simulate poses and hand over each spectrogram as it comes.

    The result of a pose depends on ``seed`` and its index alone, not on workers or order.

    Parameters
    ----------
    simulator : Simulator
        Scene and head.
    poses : Poses
        All poses of the ensemble.
    indices : iterable of int
        Which of them to simulate.
    write : callable
        Takes an index and its spectrogram (E, R, F); called here, one at a time.
    seed : int
        Of the ensemble.
    workers : int
        Processes on this machine; one means this process.
    scheduler : str, optional
        Address of a Dask scheduler whose workers are used instead.
    progress : callable, optional
        Takes how many are done and how many there are.

    Raises
    ------
    SonoNerfError
        If a pose fails, naming it.
    ResourceError
        If the workers cannot be reached.
    """
    wanted = [int(index) for index in indices]
    if scheduler is None and workers <= 1:
        results = _simulate_here(simulator, poses, wanted, seed)
        _hand_over(results, len(wanted), write, progress)
    elif wanted:
        with _workers(workers, scheduler) as client:
            results = _simulate_there(client, simulator, poses, wanted, seed)
            _hand_over(results, len(wanted), write, progress)


def _hand_over(
    results: Iterator[tuple[int, NDArray[np.float32]]],
    total: int,
    write: Write,
    progress: Progress | None,
) -> None:
    for done, (index, spectrogram) in enumerate(results, start=1):
        write(index, spectrogram)
        if progress is not None:
            progress(done, total)


def _failed(index: int, error: BaseException) -> SonoNerfError:
    text = " ".join(str(error).split())
    return SonoNerfError(f"pose {index} cannot be simulated: {type(error).__name__}: {text}")


def _simulate_here(
    simulator: Simulator, poses: Poses, indices: list[int], seed: int
) -> Iterator[tuple[int, NDArray[np.float32]]]:
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


def _one(
    simulator: Simulator, position: NDArray[np.float64], rotation: NDArray[np.float64], seed: int
) -> NDArray[np.float32]:
    return simulator.spectrogram(position, rotation, seed=seed)


def _simulate_there(
    client: Client, simulator: Simulator, poses: Poses, indices: list[int], seed: int
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    from concurrent.futures import FIRST_COMPLETED, Future, wait

    executor = client.get_executor(pure=False)
    # Sent once, as a task: a worker that dies takes nothing with it that cannot be sent again.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sending large graph", category=UserWarning)
        sent = client.submit(_receive, simulator, pure=False)
    left, running = deque(indices), dict[Future[Any], int]()
    limit = QUEUED_PER_WORKER * max(1, len(client.ncores()))
    while left or running:
        while left and len(running) < limit:
            index = left.popleft()
            pose = poses.positions[index], poses.rotations[index]
            running[executor.submit(_one, sent, *pose, pose_seed(seed, index))] = index
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            index = running.pop(future)
            try:
                spectrogram = future.result()
            except Exception as error:
                raise _failed(index, error) from error
            yield index, spectrogram


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
                cluster = LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )
                scheduler = stack.enter_context(cluster)
            client = stack.enter_context(Client(scheduler, timeout=CONNECT_SECONDS))
        except (OSError, ValueError, RuntimeError) as error:
            where = scheduler if isinstance(scheduler, str) else f"{workers} local workers"
            raise ResourceError(f"{where} cannot be reached: {error}") from error
        yield client


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    log = logging.getLogger(name)
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level)
