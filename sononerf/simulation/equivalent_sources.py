# SPDX-License-Identifier: MIT
"""The engine for low frequencies: point sources inside the bodies, whose sound makes them rigid."""

from __future__ import annotations

import itertools
import math
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from sononerf.array_types import Complexes, Floats
from sononerf.errors import NumericalError
from sononerf.geometry.directions import spread_points
from sononerf.memory import available_memory
from sononerf.scene.scene import Scene
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.solved import Heads, Solved

PER_WAVELENGTH = 3.0
"""Sources along one wavelength at the highest frequency. With 3 the velocity errs by 3 %."""
FEWEST = 0.5
"""Sources at low frequencies over those at the highest. The error is then below 0.5 %."""
LEVELS = 4
"""Different numbers of sources between these two. The error jumps where the number changes."""
POINTS = 1.5
"""Points of the surface per source where the boundary condition holds; 2 gave the same error."""
DEPTH = 1.5
"""Depth of a source below the surface, in distances between sources. Deeper sources are more exact
on smooth meshes, but on reconstructed meshes the equations become ill-conditioned."""
INSIDE = 0.3
"""Greatest depth of a source, as a fraction of the thickness of the body there."""
SHALLOWEST = 0.8
"""Least depth, in distances between sources. Above it the pattern of single sources is heard."""
THIN = 0.05
"""Greatest fraction of the surface where the body is too thin for the least depth."""
REGULARISATION = 1e-8
"""Added to the normal equations, as a fraction of their mean diagonal. On a reconstructed mesh less
of it lets the response ring; more of it loses accuracy."""
DIPOLE = 0.1
"""Dipole moment of a source over that which makes it silent towards its back. 0.03 leaves some of
the resonances; 1 makes the error half as great again."""
CHECKS = 200
"""Points of the surface that are left out of the solution and give its error."""
CONTROL = 100
"""Points of the surface at which the gains of beam and ears are looked up."""
ORDER = 3
"""Degree of the polynomial over position that is fitted to these gains. 5 gave the same echoes."""
BLOCK = 64
"""Poses that are solved for together. It is fixed, so that the rounding of a pose's result does not
depend on the other poses."""
FEW = 8
"""Poses that are solved for together where the equations are kept and poses come one by one. With
64 a single pose takes 0.7 s, with 8 or 2 it takes 0.25 s."""
LEAD = 2.5
"""Time kept before the first arrival, over the inverse width of the fall of the band."""
PATH = 5.0
"""Length of the path over which the response is kept after the first arrival, in radii of a sphere
around the scene. Later sound wraps around; for ``three_spheres`` it is 60 dB down."""
KEPT = 0.25
"""Fraction of the free memory that factorised equations may take where they are kept."""
LARGEST_KA = 12.0
"""Wavenumber times radius above which rays are as good, see ``docs/simulator.md``."""


class Sources(Solved):
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

    The error is measured at further points of the surface. Bodies with sharp edges, such as a box,
    have a large error, and bodies thinner than about three distances between sources cannot be
    solved for; :func:`hybrid` leaves both to the rays. A smooth body needs a tenth of
    the unknowns of boundary elements, so this engine solves the low band of :class:`Hybrid`.

    Attributes:
        keeps: Whether the factorised equations are kept. Further poses are then solved for at once,
            in blocks of ``FEW``.
        error: Error of the normal velocity on the surface relative to the incident one, root mean
            square over all poses solved for, by frequency in Hz.

    References:
        .. [1] G. H. Koopmann, L. Song and J. B. Fahnline, "A method for computing acoustic fields
           based on the principle of wave superposition", JASA 86, 1989.
        .. [2] A. J. Burton and G. F. Miller, "The application of integral equation methods to the
           numerical solution of some exterior boundary-value problems", Proc. Royal Society of
           London A 323, 1971.
    """

    path, lead, side_by_side = PATH, LEAD, True

    def __init__(
        self,
        scene: Scene,
        hearing: Hearing,
        *,
        most: int,
        fall: float,
    ) -> None:
        self.most = most
        self._area = float(scene.mesh.area)
        super().__init__(
            scene,
            hearing,
            frequency_max=resolved_frequency(scene, most, speed_of_sound=hearing.speed_of_sound),
            fall=fall,
        )
        self.error: dict[float, float] = {}
        self.keeps = False
        self._kept: dict[float, _System] = {}
        self._surface: tuple[Floats, Floats, Floats] | None = None

    @property
    def surface(self) -> tuple[Floats, Floats, Floats]:
        """Points (N, 3), m, of which any first ones are spread evenly; normals; thickness (N,)."""
        if self._surface is None:
            points, normals = spread_points(self.scene.mesh, round(POINTS * self.most) + CHECKS)
            start = points - 4.0 * self.caster.lift * normals
            hits = self.caster.first_hit(start, -normals)
            thickness = np.full(len(points), np.inf)
            thickness[hits.ray] = hits.distance
            self._surface = points, normals, thickness
        return self._surface

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
        blend: Floats = terms @ np.linalg.pinv(terms[:CONTROL], rcond=1e-6)
        return blend

    @property
    def thin(self) -> float:
        """Fraction of the surface below which the body is too thin for the sources."""
        spacing = math.sqrt(self._area / self.most)
        return float(np.mean(INSIDE * self.surface[2] < SHALLOWEST * spacing))

    def sources(self, frequency: float) -> int:
        """Return how many sources are used at a frequency in Hz, on a few levels."""
        wanted = np.square(frequency / self.frequency_max)
        level = math.ceil(max(wanted - FEWEST, 0.0) / (1.0 - FEWEST) * LEVELS) / LEVELS
        return round((FEWEST + (1.0 - FEWEST) * min(level, 1.0)) * self.most)

    def trial(self) -> float:
        """Return the error, see :attr:`error`, at the highest frequency, seen from three sides."""
        points = self.surface[0]
        middle, size = points.mean(axis=0), np.ptp(points, axis=0).max()
        emitters = middle + 2.0 * size * np.eye(3)
        wavenumber = 2.0 * math.pi * self.frequency[-1] / self.hearing.speed_of_sound
        system = _System(self, float(self.frequency[-1]), complex(wavenumber))
        incident = _arriving(system.points, system.normals, emitters, complex(wavenumber))
        return system.error(incident, system.solve(incident))

    def _system(self, frequency: float, wavenumber: complex) -> _System:
        """Return the equations of a frequency, those that were kept where they are there."""
        if frequency in self._kept:
            return self._kept[frequency]
        system = _System(self, frequency, wavenumber)
        if self.keeps and system.bytes * len(self.frequency) < KEPT * (available_memory() or 0):
            self._kept[frequency] = system
        return system

    def respond(self, wavenumber: complex, poses: Heads) -> Complexes:
        """Scattered pressure at the ears at one frequency; see :meth:`Solved.respond`."""
        frequency = wavenumber.real * self.hearing.speed_of_sound / (2.0 * math.pi)
        system = self._system(frequency, wavenumber)
        ears, control = poses.ears.shape[1], self.surface[0][:CONTROL]
        points, sources = self._blend[system.chosen].T, self._blend[: len(system.places)].T
        heard = np.zeros((len(poses), ears), dtype=np.complex128)
        squares = []
        block = FEW if self.keeps else BLOCK
        for start in range(0, len(poses), block):
            some = poses[np.arange(start, start + block).clip(max=len(poses) - 1)]
            incident = _arriving(system.points, system.normals, some.emitters, wavenumber)
            incident *= (some.beam(control) @ points).T.astype(np.float32)
            strength = system.solve(incident)
            squares.append(np.square(system.error(incident, strength)))
            count = min(block, len(poses) - start)
            for ear in range(ears):
                wave = _waves(some.ears[:, ear], system.places, wavenumber, system.axes)
                wave *= (some.gain(ear, control) @ sources).astype(np.float32)
                heard[start : start + count, ear] = np.einsum("pm,mp->p", wave, strength)[:count]
        self.error[frequency] = math.sqrt(float(np.mean(squares)))
        return heard


class _System:
    """The equations of one frequency, factorised."""

    @property
    def bytes(self) -> int:
        """Memory of the matrices."""
        return self._adjoint.nbytes + self._factor.nbytes + self._checks.nbytes

    def __init__(self, engine: Sources, frequency: float, wavenumber: complex) -> None:
        points, normals, thickness = engine.surface
        count = engine.sources(frequency)
        spacing = math.sqrt(engine._area / count)
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
                f"the equivalent sources at {frequency / 1e3:.3g} kHz cannot be solved for; "
                "set simulation.engine=rays"
            ) from error

    def solve(self, incident: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Return the sources' strengths (M, P) for normal slopes of pressure (N, P)."""
        wanted = self._adjoint @ -incident[: self._asked]
        strength: NDArray[np.complex64] = scipy.linalg.cho_solve(
            (self._factor, True), wanted, overwrite_b=True, check_finite=False
        )
        return strength

    def error(self, incident: NDArray[np.complex64], strength: NDArray[np.complex64]) -> float:
        """Return what is left of the normal slope at the points that were left out, relative."""
        arriving = incident[self._asked :]
        left = self._checks @ strength + arriving
        return float(np.linalg.norm(left) / np.linalg.norm(arriving))


def resolved_frequency(scene: Scene, sources: int, *, speed_of_sound: float) -> float:
    """Return the highest frequency (Hz) that a number of sources over a surface can do."""
    spacing = math.sqrt(float(scene.mesh.area) / sources)
    return speed_of_sound / (PER_WAVELENGTH * spacing)


def sources_worth(scene: Scene) -> int:
    r"""Return how many sources reach the frequency above which rays are as good.

    A sphere of radius a has the area :math:`4 \pi a^2`; for a body that is none, a is what its
    area says.
    """
    per_body = math.pi * (PER_WAVELENGTH * LARGEST_KA / math.pi) ** 2
    return round(per_body * max(scene.mesh.body_count, 1))


def _slopes(
    points: Floats,
    normals: Floats,
    places: Floats,
    wavenumber: complex,
    axes: Floats | None = None,
) -> NDArray[np.complex64]:
    r"""Return :math:`\partial_n` of pressure at points (N, 3) for sources (M, 3).

    The pressure is :math:`e^{-j k r} / 4 \pi r`. Where axes (M, 3) are given, each source has a
    dipole too, which makes it loudest along its axis; see :class:`Sources`.
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
    turned = (normals @ axes.T).astype(np.float32) - both * (3.0 / square).astype(np.float32)
    dipole = grown * turned
    dipole += both * np.complex64(wavenumber**2)
    dipole *= np.complex64(-1j * DIPOLE / wavenumber.real)
    dipole -= across * grown
    slope *= dipole
    return slope


def _waves(
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
    found: Floats = square
    return found


def _arriving(
    points: Floats,
    normals: Floats,
    emitters: Floats,
    wavenumber: complex,
) -> NDArray[np.complex64]:
    r"""Return :math:`\partial_n e^{-j k r} / r` at points (N, 3) for emitters (P, 3)."""
    return np.float32(4.0 * math.pi) * _slopes(points, normals, emitters, wavenumber)
