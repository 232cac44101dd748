# SPDX-License-Identifier: MIT
"""Base of the engines that solve the wave equation, one frequency after the other."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.fft
from threadpoolctl import threadpool_limits

from sononerf.array_types import Complexes, Floats, Ints, Singles
from sononerf.errors import ResourceError
from sononerf.geometry.plane import Plane
from sononerf.head.ears import Ears, beam_gain, ear_gain
from sononerf.memory import available_cores, available_memory
from sononerf.scene.scene import Scene
from sononerf.simulation.engine import Engine
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.reference.kirchhoff import Kirchhoff

logger = logging.getLogger("sononerf")

TAPER = 1.15  # the highest frequency over that from which the response falls
PATH = 12.0  # radii of the bounding sphere; later sound is more than 80 dB down
LEAD = 5.0  # over the taper's width; it puts less than -80 dB farther before an arrival
TAIL = 1.0  # over the taper's width, behind the last arrival
LONGEST = 7.0 * 86_400.0  # s; a longer computation is refused
MOST_THREADS = 8  # frequencies side by side; each has its own equations in memory


@dataclass(frozen=True, eq=False)
class Heads:
    """All poses at one frequency.

    Attributes:
        emitters ((P, 3), m): World frame.
        ears ((P, E, 3), m): World frame.
        rotations (P, 3, 3): Head to world.
        emitting (P, 3, 3): Emitter to world; that of an image also mirrors.
        gains: Tables of one frequency.
    """

    emitters: Floats
    ears: Floats
    rotations: Floats
    emitting: Floats
    gains: Ears

    def __len__(self) -> int:
        """Number of poses, P."""
        return len(self.emitters)

    def with_images(self, plane: Plane | None) -> Heads:
        """Return these and the same ears with emitters mirrored in a plane, (2 P,)."""
        if plane is None:
            return self
        return Heads(
            np.concatenate([self.emitters, plane.mirrored(self.emitters)]),
            np.concatenate([self.ears, self.ears]),
            np.concatenate([self.rotations, self.rotations]),
            np.concatenate([self.emitting, plane.turn @ self.emitting]),
            self.gains,
        )

    def __getitem__(self, some: slice | Ints) -> Heads:
        """Return some of the poses."""
        places = self.emitters[some], self.ears[some]
        return Heads(*places, self.rotations[some], self.emitting[some], self.gains)

    def beam(self, points: Floats) -> Floats:
        """Return the gains (P, N) of the emission towards points (N, 3) of the world, m."""
        towards = self._towards(points, self.emitters, self.emitting)
        return _by_pose(beam_gain(self.gains, towards), len(self))

    def gain(self, ear: int, points: Floats) -> Floats:
        """Return the gains (P, N) of an ear for sound from points (N, 3) of the world, m."""
        towards = self._towards(points, self.ears[:, ear], self.rotations)
        return _by_pose(ear_gain(self.gains, ear, towards), len(self))

    def _towards(self, points: Floats, places: Floats, rotations: Floats) -> Floats:
        """Return the ways from places (P, 3) to points in the head frame (P N, 3), m."""
        ways = (points[None] - places[:, None]) @ rotations
        return ways.reshape(-1, 3)


def _by_pose(gain: Singles, poses: int) -> Floats:
    return gain.reshape(poses, -1).astype(np.float64)


class Solved(Engine):
    r"""Echoes by a solution of the wave equation.

    Time runs as :math:`e^{j \omega t}`. The emitter sends :math:`B\, e^{-j k r} / r` with
    :math:`B` the gain of its beam, :math:`k = \omega / c - j \alpha \ln(10) / 20` and
    :math:`\alpha` the air's absorption in dB/m. A subclass gives the scattered pressure at
    the ears at one frequency (:meth:`respond`). The frequencies are the multiples of one over
    the duration of the response. Up to ``frequency_max`` / 1.15 the response is whole; from
    there to ``frequency_max`` it falls to zero as a raised cosine. At frequency zero it is zero:
    a rigid body scatters as the square of frequency.

    The response of a pose starts a whole number of samples before its first possible arrival,
    the shortest way from the emitter over the surface to the ear, and is laid into the record
    at that sample. So nothing is interpolated. Its duration is the time that sound takes for
    twelve radii of the sphere around the scene, and six times one over the width of the fall. All
    single echoes arrive within four radii of the first one. What is later than the duration wraps
    around; for ``three_spheres`` it is more than 80 dB below the greatest pressure.

    Args:
        frequency_max (Hz): Frequency at which the response has fallen to zero.

    Attributes:
        frequency ((K,), Hz): Those that are solved for.
        frequency_full (Hz): Up to which the response is whole.
        period: Samples of a response.
        side_by_side: Whether frequencies are solved for in several threads. It pays where the
            equations of one are small: the threads of BLAS itself then double the time.
    """

    prepares = True
    path: ClassVar[float] = PATH
    lead: ClassVar[float] = LEAD
    side_by_side: ClassVar[bool] = False

    def __init__(
        self,
        scene: Scene,
        hearing: Hearing,
        *,
        frequency_max: float,
        fall: float = TAPER,
    ) -> None:
        super().__init__(scene, hearing)
        rate = hearing.synthesis.sampling_rate
        self.frequency_max = min(frequency_max, rate / 2.0)
        self.frequency_full = self.frequency_max / fall
        self._lead = self.lead / (self.frequency_max - self.frequency_full)
        tail = TAIL / (self.frequency_max - self.frequency_full)
        duration = self.path * self.arrival.radius / hearing.speed_of_sound + self._lead + tail
        self.period = int(scipy.fft.next_fast_len(math.ceil(duration * rate), real=True))
        step = rate / self.period
        # At the highest of them the taper is zero already; it is not solved for.
        count = math.ceil(self.frequency_max / step) - 1
        self.frequency: Floats = np.arange(1.0, count + 0.5) * step
        self._known: dict[bytes, tuple[Ints, Floats]] = {}

    @property
    def parts(self) -> int:
        """Frequencies that are solved for; see :meth:`prepare`."""
        return len(self.frequency)

    def estimate(self, poses: int) -> tuple[float, float]:
        """Return the memory (bytes) and the time (s) that a number of poses will take.

        A subclass says it; nothing is refused where it does not.
        """
        del poses
        return 0.0, 0.0

    def respond(self, wavenumber: complex, poses: Heads) -> Complexes:
        """Scattered pressure at the ears at one frequency.

        Args:
            wavenumber (1/m): Wavenumber of sound in air; its imaginary part is not positive.

        Returns:
            pressure ((P, E) complex128): For an emission of pressure 1 at 1 m where the beam's gain
                is 1, ear's gain included.
        """
        raise NotImplementedError

    def prepare(
        self,
        positions: Floats,
        rotations: Floats,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Solve for all poses that are not known yet, and keep their responses.

        Poses that are no finite numbers are left out; :meth:`echo` refuses them.

        Args:
            positions ((P, 3), m): Places of the head, world frame.
            rotations (P, 3, 3): Head to world.
        """
        finite = np.isfinite(positions).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
        pairs = zip(positions[finite], rotations[finite], strict=True)
        wanted = {_key(*pose): pose for pose in pairs if _key(*pose) not in self._known}
        if not wanted:
            return
        self._refuse(len(wanted))
        places = np.stack([pose[0] for pose in wanted.values()])
        turns = np.stack([pose[1] for pose in wanted.values()])
        head = self.hearing.ears
        emitters = places + turns @ head.emitter
        ears = places[:, None] + np.einsum("pij,ej->pei", turns, head.positions)
        rate = self.hearing.synthesis.sampling_rate
        first = self.arrival.shortest(emitters, ears) / self.hearing.speed_of_sound
        start = np.floor((first - self._lead) * rate).astype(np.int64)
        spectrum = np.zeros((*start.shape, self.period // 2 + 1), dtype=np.complex128)
        absorbed = self.hearing.head.absorption(self.frequency) * (math.log(10.0) / 20.0)
        fall = self.taper(self.frequency)
        plane = self.hearing.head.plane

        def respond(index: int) -> Complexes:
            turn = 2.0 * math.pi * float(self.frequency[index])
            wavenumber = complex(turn / self.hearing.speed_of_sound, -absorbed[index])
            gains = self.hearing.head.tables(self.frequency[index : index + 1])
            heads = Heads(emitters, ears, turns, turns, gains).with_images(plane)
            # The responses to the emitter and its image add up.
            found = self.respond(wavenumber, heads).reshape(-1, *start.shape).sum(axis=0)
            return fall[index] * found * np.exp(1j * turn / rate * start)

        with self._in_threads(respond, len(self.frequency)) as found:
            for index, pressure in enumerate(found):
                spectrum[:, :, index + 1] = pressure
                if progress is not None:
                    progress(index + 1, len(self.frequency))
        response = scipy.fft.irfft(spectrum, n=self.period, axis=-1)
        for key, begins, pressure in zip(wanted, start, response, strict=True):
            self._known[key] = begins, pressure

    @contextmanager
    def _in_threads(
        self, respond: Callable[[int], Complexes], count: int
    ) -> Generator[Iterator[Complexes], None, None]:
        """Yield the responses at all frequencies in order; waiting ones are dropped on an error."""
        if not self.side_by_side:
            yield map(respond, range(count))
            return
        workers = min(available_cores(), MOST_THREADS)
        with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(workers) as pool:
            waiting = [pool.submit(respond, index) for index in range(count)]
            try:
                yield (future.result() for future in waiting)
            finally:
                pool.shutdown(cancel_futures=True)

    def taper(self, frequency: Floats) -> Floats:
        """Return the taper of the response (K,) at frequencies (K,) in Hz."""
        band = self.frequency_max - self.frequency_full
        fall = np.clip((frequency - self.frequency_full) / band, 0.0, 1.0)
        left: Floats = 0.5 * (1.0 + np.cos(np.pi * fall))
        return left

    def echo(
        self,
        position: Floats,
        rotation: Floats,
        *,
        seed: int,  # noqa: ARG002  (nothing is random)
    ) -> Floats:
        """Pressure at both ears; see :meth:`Engine.echo`. A pose not prepared is solved alone."""
        if not (np.isfinite(position).all() and np.isfinite(rotation).all()):
            raise ValueError("the pose is no finite number")
        self.prepare(np.asarray(position)[None], np.asarray(rotation)[None])
        start, response = self._known[_key(position, rotation)]
        record = np.zeros((len(start), self.hearing.synthesis.samples))
        for row, begins, pressure in zip(record, start, response, strict=True):
            low, high = np.clip([begins, begins + self.period], 0, len(row))
            row[low:high] = pressure[low - begins : high - begins]
        return record

    def hits(self, position: Floats, rotation: Floats, *, seed: int) -> tuple[Floats, Floats]:
        """Places that send sound straight back by physical optics; see :meth:`Kirchhoff.hits`."""
        optics = Kirchhoff(self.scene, self.hearing, frequency_max=self.frequency_full)
        return optics.hits(position, rotation, seed=seed)

    def _refuse(self, poses: int) -> None:
        memory, seconds = self.estimate(poses)
        memory += 16.0 * poses * len(self.hearing.ears.positions) * 2 * self.period
        free = available_memory()
        asked = f"{poses} poses at {len(self.frequency)} frequencies up to "
        asked += f"{self.frequency_max / 1e3:.3g} kHz need about "
        less = "lower simulation.frequency_max, or simulate fewer poses"
        if free is not None and memory > free:
            raise ResourceError(
                f"{asked}{memory / 1e9:.2g} GB of memory, {free / 1e9:.2g} GB are free; {less}"
            )
        if seconds > LONGEST:
            raise ResourceError(f"{asked}{seconds / 86_400.0:.2g} days of computation; {less}")


def _key(position: Floats, rotation: Floats) -> bytes:
    parts = (np.ascontiguousarray(part, dtype=np.float64) for part in (position, rotation))
    return b"".join(part.tobytes() for part in parts)
