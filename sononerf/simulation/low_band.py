# SPDX-License-Identifier: MIT
"""The wave equation at low frequencies: point sources inside the bodies make them rigid.

Rays do not simulate sound that creeps around a body. Where ka is below about 8 they are wrong by
several decibels; there the wave equation of small bodies is cheap. Both give pressure with level
and delay, so they are added: between the bands the low one falls as a raised cosine, and the rays
rise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from sononerf.errors import NumericalError, ResourceError
from sononerf.geometry.directions import spread_points
from sononerf.geometry.meshes import Plane
from sononerf.geometry.raycast import RayCaster
from sononerf.head.ears import Ears, beam_gain, ear_gain
from sononerf.numerics import Complexes, Floats, Ints
from sononerf.resources import available_cores, available_memory
from sononerf.scene.scene import Scene
from sononerf.simulation.hearing import Arrival, Hearing

POINTS = 1.5
"""Points of the surface per source where the boundary condition holds; 2 gave the same error."""
DEPTH = 1.5
"""Depth of a source below the surface, in distances between sources. Deeper sources are more exact
on smooth meshes, but on reconstructed meshes the equations become ill-conditioned."""
INSIDE = 0.3
"""Greatest depth of a source, as a fraction of the thickness of the body there."""
REGULARISATION = 1e-8
"""Added to the normal equations, as a fraction of their mean diagonal. On a reconstructed mesh less
of it lets the response ring; more of it loses accuracy."""
DIPOLE = 0.1
"""Dipole moment of a source over that which makes it silent towards its back. 0.03 leaves some of
the resonances; 1 makes the error half as great again."""
CHECKS = 200
"""Points of the surface that are left out of the solution and give its error."""


class Equations:
    """The equations of one frequency, factorised. In: spacing (m), wavenumber (1/m)."""

    @property
    def bytes(self) -> int:
        """Memory of the matrices."""
        return self._adjoint.nbytes + self._factor.nbytes + self._checks.nbytes

    def __init__(
        self,
        surface: tuple[Floats, Floats, Floats],
        count: int,
        spacing: float,
        wavenumber: complex,
    ) -> None:
        points, normals, thickness = surface
        depth = np.minimum(DEPTH * spacing, INSIDE * thickness[:count])
        self.places = points[:count] - depth[:, None] * normals[:count]
        self._asked = round(POINTS * count)
        # The last points stand in the gaps between all others.
        self.chosen = np.r_[: self._asked, len(points) - CHECKS : len(points)]
        self.points, self.normals = points[self.chosen], normals[self.chosen]
        self.axes = normals[:count]
        matrix = _slopes(self.points, self.normals, self.places, wavenumber, self.axes)
        self._checks = matrix[self._asked :]
        self._adjoint = np.ascontiguousarray(matrix[: self._asked].T).conj()
        # The squares of the equations need double precision, their solutions do not.
        used = np.asfortranarray(matrix[: self._asked], dtype=np.complex128)
        normal = scipy.linalg.blas.zherk(1.0, used, trans=2, lower=1)
        diagonal = np.einsum("ii->i", normal)
        diagonal += REGULARISATION * float(diagonal.real.mean())
        try:
            factor, _ = scipy.linalg.cho_factor(
                normal, lower=True, overwrite_a=True, check_finite=False
            )
            self._factor = factor.astype(np.complex64)
        except scipy.linalg.LinAlgError as error:
            raise NumericalError(
                f"the equivalent sources at wavenumber {wavenumber.real:.3g} / m cannot be solved "
                "for; set simulation.engine=rays"
            ) from error

    def solve(self, incident: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the sources' strengths (M, P) for normal slopes of pressure (N, P)."""
        wanted = self._adjoint @ -incident[: self._asked]
        return scipy.linalg.cho_solve(
            (self._factor, True), wanted, overwrite_b=True, check_finite=False
        )

    def error(self, incident: NDArray[np.complex64], strength: NDArray[np.complex64]) -> float:
        """Return the relative error of the normal slope at the points that were left out."""
        arriving = incident[self._asked :]
        left = self._checks @ strength + arriving
        return float(np.linalg.norm(left) / np.linalg.norm(arriving))


def _slopes(
    points: Floats, normals: Floats, places: Floats, wavenumber: complex, axes: Floats | None = None
) -> NDArray[np.complex64]:
    r"""Return :math:`\partial_n` of pressure at points (N, 3) for sources (M, 3).

    The pressure is :math:`e^{-j k r} / 4 \pi r`. Where axes (M, 3) are given, each source has a
    dipole too, which makes it loudest along its axis; see :class:`LowBand`.
    """
    square = _squares(points, places)
    distance = np.sqrt(square)
    across = np.einsum("nd,nd->n", points, normals)[:, None] - normals @ places.T
    slope = _turned(distance, wavenumber)
    slope /= (square * distance).astype(np.float32)
    across = across.astype(np.float32)
    grown = (1.0 + 1j * wavenumber * distance).astype(np.complex64)
    if axes is None:
        slope *= -across * grown
        return slope
    along = points @ axes.T - np.einsum("md,md->m", places, axes)
    both = along.astype(np.float32) * across
    gradient = (normals @ axes.T).astype(np.float32) - both * (3.0 / square).astype(np.float32)
    dipole = grown * gradient
    dipole += both * np.complex64(wavenumber**2)
    dipole *= np.complex64(-1j * DIPOLE / wavenumber.real)
    dipole -= across * grown
    slope *= dipole
    return slope


def waves(
    points: Floats, places: Floats, wavenumber: complex, axes: Floats
) -> NDArray[np.complex64]:
    r"""Return the pressure at points (N, 3) of sources (M, 3) with dipoles; see :func:`_slopes`."""
    distance = np.sqrt(_squares(points, places))
    wave = _turned(distance, wavenumber)
    wave /= distance.astype(np.float32)
    cosine = (points @ axes.T - np.einsum("md,md->m", places, axes)) / distance
    grown = 1j * wavenumber + 1.0 / distance
    wave *= (1.0 - 1j * DIPOLE / wavenumber.real * cosine * grown).astype(np.complex64)
    return wave


def _turned(distance: Floats, wavenumber: complex) -> NDArray[np.complex64]:
    r"""Return :math:`e^{-j k r} / 4 \pi` at distances (N, M); phases keep their full precision."""
    turns = distance * (wavenumber.real / (2.0 * math.pi))
    turns -= np.rint(turns)
    phase = turns.astype(np.float32)
    phase *= np.float32(-2.0 * math.pi)
    size = np.exp((wavenumber.imag * distance).astype(np.float32))
    size *= np.float32(0.25 / math.pi)
    wave = np.zeros(distance.shape, dtype=np.complex64)
    np.multiply(size, np.cos(phase), out=wave.real)
    np.multiply(size, np.sin(phase), out=wave.imag)
    return wave


def _squares(points: Floats, places: Floats) -> Floats:
    """Return squared distances (N, M), m²; products suffice, for coordinates are as small."""
    square = np.square(points).sum(axis=1)[:, None] + np.square(places).sum(axis=1)
    square -= 2.0 * points @ places.T
    return square


def arriving(
    points: Floats, normals: Floats, emitters: Floats, wavenumber: complex
) -> NDArray[np.complex64]:
    r"""Return :math:`\partial_n e^{-j k r} / r` at points (N, 3) for emitters (P, 3)."""
    return np.float32(4.0 * math.pi) * _slopes(points, normals, emitters, wavenumber)


CROSSOVER = 1.3
"""Highest frequency of the low band over the one from which it gives way to the rays. A wider
crossing keeps more of the error of the rays, a narrower one rings longer."""
MIN_BAND_RATIO = 1.5
"""Least highest frequency of the low band over the lowest analysed one; below, little is gained."""
LARGEST_ERROR = 0.1
"""Error of the velocity on the surface above which the rays do all; 10 % is about 1 dB."""
PER_WAVELENGTH = 3.0
"""Sources along one wavelength at the highest frequency. With 3 the velocity errs by 3 %."""
FEWEST_SOURCES = 0.5
"""Sources at low frequencies over those at the highest. The error is then below 0.5 %."""
LEVELS = 4
"""Different numbers of sources between these two. The error jumps where the number changes."""
SHALLOWEST = 0.8
"""Least depth, in distances between sources. Above it the pattern of single sources is heard."""
MAX_THIN_FRACTION = 0.05
"""Greatest fraction of the surface where the body is too thin for the least depth."""
CONTROL_POINTS = 100
"""Points of the surface at which the gains of beam and ears are looked up."""
ORDER = 3
"""Degree of the polynomial over position that is fitted to these gains. 5 gave the same echoes."""
BLOCK = 64
"""Poses that are solved for together. It is fixed, so that the rounding of a pose's result does not
depend on the other poses."""
FEW_POSES = 8
"""Poses that are solved for together where the equations are kept and poses come one by one. With
64 a single pose takes 0.7 s, with 8 or 2 it takes 0.25 s."""
LEAD = 2.5
"""Time kept before the first arrival, over the inverse width of the fall of the band."""
TAIL = 1.0
"""Time kept behind the last arrival, over the inverse width of the fall of the band."""
PATH = 5.0
"""Length of the path over which the response is kept after the first arrival, in radii of a sphere
around the scene. Later sound wraps around; for ``three_spheres`` it is 60 dB down."""
MAX_MEMORY_FRACTION = 0.25
"""Fraction of the free memory that factorised equations may take where they are kept."""
LARGEST_KA = 12.0
"""Wavenumber times radius above which rays are as good, see ``docs/simulator.md``."""
MOST_THREADS = 8
"""Frequencies that are solved for side by side; each has its own equations in memory."""


@dataclass(frozen=True, eq=False)
class HeadPoses:
    """All poses of a head at one frequency."""

    emitters: Floats  # (P, 3), m: World frame
    ears: Floats  # (P, E, 3), m: World frame
    rotations: Floats  # (P, 3, 3): Head to world
    emitting: Floats  # (P, 3, 3): Emitter to world; that of an image also mirrors
    gains: Ears  # Tables of one frequency

    def __len__(self) -> int:
        """Number of poses, P."""
        return len(self.emitters)

    def with_images(self, plane: Plane | None) -> HeadPoses:
        """Return these and the same ears with emitters mirrored in a plane, (2 P,)."""
        if plane is None:
            return self
        return HeadPoses(
            np.concatenate([self.emitters, plane.mirrored(self.emitters)]),
            np.concatenate([self.ears, self.ears]),
            np.concatenate([self.rotations, self.rotations]),
            np.concatenate([self.emitting, plane.reflection @ self.emitting]),
            self.gains,
        )

    def __getitem__(self, some: slice | Ints) -> HeadPoses:
        """Return some of the poses."""
        places = self.emitters[some], self.ears[some]
        return HeadPoses(*places, self.rotations[some], self.emitting[some], self.gains)

    def beam(self, points: Floats) -> Floats:
        """Return the gains (P, N) of the emission towards points (N, 3) of the world, m."""
        towards = (points[None] - self.emitters[:, None]) @ self.emitting
        return self._by_pose(beam_gain(self.gains, towards.reshape(-1, 3)))

    def gain(self, ear: int, points: Floats) -> Floats:
        """Return the gains (P, N) of an ear for sound from points (N, 3) of the world, m."""
        towards = (points[None] - self.ears[:, ear][:, None]) @ self.rotations
        return self._by_pose(ear_gain(self.gains, ear, towards.reshape(-1, 3)))

    def _by_pose(self, gain: NDArray[np.float32]) -> Floats:
        return gain.reshape(len(self), -1).astype(np.float64)


class LowBand:
    r"""Echoes by equivalent sources [1]_, also called the method of fundamental solutions.

    Sources lie inside the bodies, 1.5 of their distances below the surface. Their strengths
    :math:`q` make the normal velocity on the surface zero, by least squares at points
    :math:`x_i`, 1.5 per source,

    .. math:: \sum_j q_j\, \partial_n
        \left( 1 - \frac{j \beta}{k}\, \nu_j \cdot \nabla_{y_j} \right)
        \frac{e^{-j k |x_i - y_j|}}{4 \pi |x_i - y_j|} = -\partial_n p_{in}(x_i)

    with :math:`\nu_j` the normal of the surface above and :math:`\beta` a tenth, ``DIPOLE``.
    Without dipoles the solution is not unique at the resonances of the volume that the sources
    enclose [2]_, and the response rings at these frequencies.

    Time runs as :math:`e^{j \omega t}`. The emitter sends :math:`B\, e^{-j k r} / r` with
    :math:`B` the gain of its beam, :math:`k = \omega / c - j \alpha \ln(10) / 20` and
    :math:`\alpha` the air's absorption in dB/m. The frequencies are the multiples of one over the
    duration of the response. At frequency zero it is zero: a rigid body scatters as the square of
    frequency. The response of a pose starts a whole number of samples before its first possible
    arrival, and is laid into the record at that sample, so nothing is interpolated. What is later
    than the duration wraps around.

    The error is measured at further points of the surface. Bodies with sharp edges, such as a box,
    have a large error, and bodies thinner than about three distances between sources cannot be
    solved for; :func:`low_band` leaves both to the rays.

    Attributes:
        frequency ((K,), Hz): Frequencies that are solved for.
        frequency_full (Hz): Highest frequency at which the response is whole.
        frequency_max (Hz): Frequency at which it has fallen to zero.
        period: Samples of a response.
        keeps: True if the factorised equations are kept. Further poses are then solved for at once,
            in blocks of ``FEW_POSES``.
        error: Error of the normal velocity on the surface relative to the incident one, root mean
            square over all poses solved for, by frequency in Hz.

    References:
        .. [1] G. H. Koopmann, L. Song and J. B. Fahnline, "A method for computing acoustic fields
           based on the principle of wave superposition", JASA 86, 1989.
        .. [2] A. J. Burton and G. F. Miller, "The application of integral equation methods to the
           numerical solution of some exterior boundary-value problems", Proc. Royal Society of
           London A 323, 1971.
    """

    def __init__(self, scene: Scene, hearing: Hearing, arrival: Arrival, *, most: int) -> None:
        self.scene, self.hearing, self.arrival, self.most = scene, hearing, arrival, most
        self.area = float(scene.mesh.area)
        rate = hearing.synthesis.sampling_rate
        highest = resolved_frequency(scene, most, speed_of_sound=hearing.speed_of_sound)
        self.frequency_max = min(highest, rate / 2.0)
        self.frequency_full = self.frequency_max / CROSSOVER
        width = self.frequency_max - self.frequency_full
        self._lead = LEAD / width
        duration = PATH * arrival.radius / hearing.speed_of_sound + self._lead + TAIL / width
        self.period = int(scipy.fft.next_fast_len(math.ceil(duration * rate), real=True))
        step = rate / self.period
        # At the highest of them the taper is zero already; it is not solved for.
        count = math.ceil(self.frequency_max / step) - 1
        self.frequency: Floats = np.arange(1.0, count + 0.5) * step
        self.error: dict[float, float] = {}
        self.keeps = False
        self._equations: dict[float, Equations] = {}
        self._responses: dict[bytes, tuple[Ints, Floats]] = {}

    @cached_property
    def surface(self) -> tuple[Floats, Floats, Floats]:
        """Points (N, 3), m, of which any first ones are spread evenly; normals; thickness (N,)."""
        points, normals = spread_points(self.scene.mesh, round(POINTS * self.most) + CHECKS)
        caster = RayCaster(self.scene.mesh)
        hits = caster.first_hit(points - 4.0 * caster.lift * normals, -normals)
        thickness = np.full(len(points), np.inf)
        thickness[hits.ray] = hits.distance
        return points, normals, thickness

    @cached_property
    def _blend(self) -> Floats:
        """Weights (N, C) by which the gains at control points make those at all points.

        A polynomial over the place is fitted to them. Tables have bends between their nodes, and
        no sources inside the body make a field that bends so.
        """
        points = self.surface[0] - self.surface[0].mean(axis=0)
        points /= np.abs(points).max()
        powers = [
            power for power in itertools.product(range(ORDER + 1), repeat=3) if sum(power) <= ORDER
        ]
        terms = np.stack([np.prod(points**power, axis=1) for power in powers], axis=1)
        return terms @ np.linalg.pinv(terms[:CONTROL_POINTS], rcond=1e-6)

    @property
    def thin(self) -> float:
        """Fraction of the surface below which the body is too thin for the sources."""
        spacing = math.sqrt(self.area / self.most)
        return float(np.mean(INSIDE * self.surface[2] < SHALLOWEST * spacing))

    def sources(self, frequency: float) -> int:
        """Return the number of sources at a frequency, Hz, on a few levels."""
        wanted = np.square(frequency / self.frequency_max)
        level = (
            math.ceil(max(wanted - FEWEST_SOURCES, 0.0) / (1.0 - FEWEST_SOURCES) * LEVELS) / LEVELS
        )
        return round((FEWEST_SOURCES + (1.0 - FEWEST_SOURCES) * min(level, 1.0)) * self.most)

    def trial(self) -> float:
        """Return the error, see :attr:`error`, at the highest frequency, seen from three sides."""
        points = self.surface[0]
        middle, size = points.mean(axis=0), np.ptp(points, axis=0).max()
        emitters = middle + 2.0 * size * np.eye(3)
        wavenumber = complex(2.0 * math.pi * self.frequency[-1] / self.hearing.speed_of_sound)
        equations = self._equations_at(float(self.frequency[-1]), wavenumber)
        incident = arriving(equations.points, equations.normals, emitters, wavenumber)
        return equations.error(incident, equations.solve(incident))

    def taper(self, frequency: Floats) -> Floats:
        """Return the taper of the response (K,) at frequencies (K,) in Hz."""
        band = self.frequency_max - self.frequency_full
        fall = np.clip((frequency - self.frequency_full) / band, 0.0, 1.0)
        return 0.5 * (1.0 + np.cos(np.pi * fall))

    def prepare(
        self, positions: Floats, rotations: Floats, done: Callable[[], None] | None = None
    ) -> None:
        """Solve for all poses that have not been solved for yet, and keep their responses.

        Poses that are no finite numbers are left out.

        In: positions ((P, 3), m), rotations (P, 3, 3).
        """
        finite = np.isfinite(positions).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
        pairs = zip(positions[finite], rotations[finite], strict=True)
        new = {_key(*pose): pose for pose in pairs if _key(*pose) not in self._responses}
        if not new:
            return
        places, turns = (np.stack(part) for part in zip(*new.values(), strict=True))
        head = self.hearing.ears
        self._require_memory(len(new), len(head.positions))
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
            poses = HeadPoses(emitters, ears, turns, turns, gains).with_images(plane)
            # The responses to the emitter and its image add up.
            heard = self.respond(wavenumber, poses).reshape(-1, *start.shape).sum(axis=0)
            return fall[index] * heard * np.exp(1j * turn / rate * start)

        threads = min(available_cores(), MOST_THREADS)
        # The equations of one frequency are small: the threads of BLAS itself double the time.
        with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(threads) as pool:
            waiting = [pool.submit(respond, index) for index in range(len(self.frequency))]
            try:
                for index, future in enumerate(waiting):
                    spectrum[:, :, index + 1] = future.result()
                    if done is not None:
                        done()
            finally:
                pool.shutdown(cancel_futures=True)
        response = scipy.fft.irfft(spectrum, n=self.period, axis=-1)
        for key, begins, pressure in zip(new, start, response, strict=True):
            self._responses[key] = begins, pressure

    def echo(self, position: Floats, rotation: Floats) -> Floats:
        """Return the pressure at the ears (E, S); a pose not prepared is solved for alone."""
        self.prepare(np.asarray(position)[None], np.asarray(rotation)[None])
        start, response = self._responses[_key(position, rotation)]
        record = np.zeros((len(start), self.hearing.synthesis.samples))
        for row, begins, pressure in zip(record, start, response, strict=True):
            low, high = np.clip([begins, begins + self.period], 0, len(row))
            row[low:high] = pressure[low - begins : high - begins]
        return record

    def respond(self, wavenumber: complex, poses: HeadPoses) -> Complexes:
        """Return the scattered pressure at the ears at one frequency.

        In: wavenumber (1/m). Out: pressure ((P, E) complex128).
        """
        frequency = wavenumber.real * self.hearing.speed_of_sound / (2.0 * math.pi)
        equations = self._equations_of(frequency, wavenumber)
        ears, control = poses.ears.shape[1], self.surface[0][:CONTROL_POINTS]
        points = self._blend[equations.chosen].T
        sources = self._blend[: len(equations.places)].T
        heard = np.zeros((len(poses), ears), dtype=np.complex128)
        squares = []
        block = FEW_POSES if self.keeps else BLOCK
        for start in range(0, len(poses), block):
            some = poses[np.arange(start, start + block).clip(max=len(poses) - 1)]
            incident = arriving(equations.points, equations.normals, some.emitters, wavenumber)
            incident *= (some.beam(control) @ points).T.astype(np.float32)
            strength = equations.solve(incident)
            squares.append(np.square(equations.error(incident, strength)))
            count = min(block, len(poses) - start)
            for ear in range(ears):
                wave = waves(some.ears[:, ear], equations.places, wavenumber, equations.axes)
                wave *= (some.gain(ear, control) @ sources).astype(np.float32)
                heard[start : start + count, ear] = np.einsum("pm,mp->p", wave, strength)[:count]
        self.error[frequency] = math.sqrt(float(np.mean(squares)))
        return heard

    def _equations_at(self, frequency: float, wavenumber: complex) -> Equations:
        count = self.sources(frequency)
        return Equations(self.surface, count, math.sqrt(self.area / count), wavenumber)

    def _equations_of(self, frequency: float, wavenumber: complex) -> Equations:
        if frequency in self._equations:
            return self._equations[frequency]
        equations = self._equations_at(frequency, wavenumber)
        free = available_memory() or 0
        if self.keeps and equations.bytes * len(self.frequency) < MAX_MEMORY_FRACTION * free:
            self._equations[frequency] = equations
        return equations

    def _require_memory(self, poses: int, ears: int) -> None:
        free, needed = available_memory(), 32.0 * poses * ears * self.period
        if free is not None and needed > free:
            raise ResourceError(
                f"{poses} poses need about {needed / 1e9:.2g} GB of memory at low frequencies, "
                f"{free / 1e9:.2g} GB are free; simulate fewer poses, or set simulation.engine=rays"
            )


def resolved_frequency(scene: Scene, sources: int, *, speed_of_sound: float) -> float:
    """Return the highest frequency (Hz) that a number of sources over a surface can do."""
    spacing = math.sqrt(float(scene.mesh.area) / sources)
    return speed_of_sound / (PER_WAVELENGTH * spacing)


def sources_worth(scene: Scene) -> int:
    r"""Return the number of sources that reach the frequency above which rays are as good.

    A sphere of radius a has the area :math:`4 \pi a^2`; for a body that is none, a is what its
    area says.
    """
    per_body = math.pi * (PER_WAVELENGTH * LARGEST_KA / math.pi) ** 2
    return round(per_body * max(scene.mesh.body_count, 1))


def low_band(
    scene: Scene, hearing: Hearing, arrival: Arrival, *, sources: int, frequency_min: float
) -> LowBand | str:
    """Return the low band of a scene, or the reason for its absence. In: frequency_min (Hz)."""
    if not all(material.rigid for material in scene.materials):
        return "a material is not rigid"
    if not scene.mesh.is_watertight:
        return "the surface is open"
    most = min(sources, sources_worth(scene))
    highest = resolved_frequency(scene, most, speed_of_sound=hearing.speed_of_sound)
    if highest < MIN_BAND_RATIO * frequency_min:
        return (
            f"the scene is so large that {most} sources reach {highest / 1e3:.2g} kHz; "
            "simulation.sources raises that"
        )
    band = LowBand(scene, hearing, arrival, most=most)
    if band.thin > MAX_THIN_FRACTION:
        return "the body is too thin for equivalent sources"
    error = band.trial()
    if error > LARGEST_ERROR:
        return f"equivalent sources err by {100 * error:.0f} % on the surface"
    return band


def _key(position: Floats, rotation: Floats) -> bytes:
    parts = (np.ascontiguousarray(part, dtype=np.float64) for part in (position, rotation))
    return b"".join(part.tobytes() for part in parts)
