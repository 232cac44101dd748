# SPDX-License-Identifier: MIT
"""The engine for rigid spheres: their multiple scattering, exactly, by partial waves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sononerf.array_types import Complexes, Floats, Ints
from sononerf.errors import InputError, NumericalError
from sononerf.scene.material import Material
from sononerf.scene.scene import Scene
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.reference.coupling import Ball, Coupling, Link
from sononerf.simulation.reference.partial_waves import inner_product, wigner
from sononerf.simulation.solved import Heads, Solved

ROUND = 1e-3  # of the radius, by which vertices may lie beside the sphere
TWICE = 1e-8  # of the scene's size, within which vertices stand at the same place
FILLED = 0.95  # of the sphere's volume, that the mesh encloses at least
APART = 0.01  # of the smaller radius, between any two spheres at least
DIGITS = 4.0  # of the partial waves' truncation
TOLERANCE = 1e-4  # of the pressure on the spheres
MOST_ITERATIONS = 60
MOST_WAVES = 300_000  # partial waves of all spheres together
BATCH_BYTES = 500e6  # for the waves of all poses of a batch
KEPT = 30  # arrays of the waves' size, while a batch is solved
SPEED = 6e9  # operations per second of one core


class Spheres(Solved):
    r"""Echoes of rigid spheres by multiple scattering.

    The pressure that sphere :math:`i` scatters is

    .. math:: \sum_{n m} f^i_{n m}\, \frac{h_n(k r_i)}{h_n(k a_i)}\, Y_{n m}(\vartheta_i, \varphi_i)

    with :math:`h_n` the outgoing spherical Hankel function (of the second kind), :math:`a_i` the
    radius and :math:`r_i, \vartheta_i, \varphi_i` coordinates about the centre. The normal
    velocity on sphere :math:`l` vanishes if

    .. math:: f^l_{n m} = -\frac{h_n(k a_l)}{k h_n'(k a_l)} \int \frac{\partial}{\partial r_l}
        \Bigl(p_0 + \sum_{i \neq l} p_i\Bigr) Y^*_{n m}\, d\Omega_l

    with :math:`p_0` the emission [1]_ and :math:`p_i` what the other spheres scatter. To project
    :math:`p_i` on the harmonics of sphere :math:`l`, the waves are turned to the axis between both
    centres, translated along it, and turned back [2]_. The translation along the axis is a
    Gauss-Legendre integral of the condition over the target's polar angle for each order
    :math:`m`. It needs no recursion, and no division by Bessel functions near their zeros. The
    turns are Wigner's matrices by the eigenvectors of the angular momentum [3]_.

    The coefficients follow by minimal residuals (GCR [4]_) over the orders of scattering, for
    all poses at once, until what is left is below 1e-4 of what the emission causes. The degrees go
    up to :math:`k a + 1.8\, d^{2/3} (k a)^{1/3}` for :math:`d = 4` digits [2]_, and higher where
    another sphere or the head is close: a sphere near by is mirrored in others at points that no
    fewer degrees than :math:`d \ln(10) / \mu` describe, with :math:`\mu` the sphere's bispherical
    coordinate.

    Beam and ears are taken towards the centres of the spheres.

    Args:
        orders: Sum orders of scattering up to this one and solve nothing: 1 leaves out what one
            sphere sends to another. For diagnosis.

    Attributes:
        balls: The spheres of the scene.

    References:
        .. [1] NIST Digital Library of Mathematical Functions, 10.60.1 and 10.60.2.
        .. [2] N. A. Gumerov and R. Duraiswami, "Fast Multipole Methods for the Helmholtz Equation
           in Three Dimensions", Elsevier 2004; the same, "Computation of scattering from N spheres
           using multipole reexpansion", Journal of the Acoustical Society of America 112, 2002.
        .. [3] X. M. Feng, P. Wang, W. Yang and G. R. Jin, "High-precision evaluation of Wigner's d
           matrix by exact diagonalization", Physical Review E 92, 043307, 2015.
        .. [4] S. C. Eisenstat, H. C. Elman and M. H. Schultz, "Variational iterative methods for
           nonsymmetric systems of linear equations", SIAM Journal on Numerical Analysis 20, 1983.
    """

    def __init__(
        self,
        scene: Scene,
        hearing: Hearing,
        *,
        frequency_max: float,
        orders: int | None = None,
    ) -> None:
        for material in scene.materials:
            _refuse_soft(material)
        self.balls = find_balls(scene)
        self.orders = orders
        super().__init__(scene, hearing, frequency_max=frequency_max)
        _refuse_close(self.balls)
        self._links = list(_links(self.balls))
        highest = 2.0 * math.pi * self.frequency[-1] / hearing.speed_of_sound
        _refuse_many(self.degrees(highest, math.inf), self.frequency[-1])
        self._turns: list[list[Floats]] = []

    def degrees(self, wavenumber: float, nearest: float) -> list[int]:
        """Highest degree of each sphere's partial waves.

        Args:
            wavenumber (1/m): Wavenumber of sound in air.
        """
        found = []
        for index, ball in enumerate(self.balls):
            size = wavenumber * ball.radius
            excess = 1.8 * DIGITS ** (2.0 / 3.0) * np.cbrt(size)
            close = math.log(10.0) * DIGITS / math.log(nearest)
            for other in self.balls[:index] + self.balls[index + 1 :]:
                apart = float(np.linalg.norm(other.centre - ball.centre))
                cosine = (apart**2 + ball.radius**2 - other.radius**2) / (2 * apart * ball.radius)
                close = max(close, math.log(10.0) * DIGITS / math.acosh(cosine))
            found.append(math.ceil(size + max(excess, close)))
        return found

    def estimate(self, poses: int) -> tuple[float, float]:
        """Memory (bytes) and time (s); see :meth:`Solved.estimate`."""
        wavenumbers = 2.0 * math.pi * self.frequency / self.hearing.speed_of_sound
        seconds, linked = 0.0, max(len(self.balls) - 1, 0)
        for wavenumber in wavenumbers[:: max(1, len(wavenumbers) // 20)]:
            cubes = sum((degree + 1.0) ** 3 for degree in self.degrees(wavenumber, math.inf))
            # Two turns and a translation of complex waves; six orders.
            seconds += 6.0 * linked * cubes * (32.0 / 3.0 + 16.0 / 3.0) * poses / SPEED
        degrees = self.degrees(float(wavenumbers[-1]), math.inf)
        turns = len(self._links) * 8.0 * 4.0 / 3.0 * (max(degrees) + 1.0) ** 3
        moves = 2 * len(self._links) * 16.0 / 3.0 * (max(degrees) + 1.0) ** 3
        return turns + moves + BATCH_BYTES, seconds * max(1, len(wavenumbers) // 20)

    def respond(self, wavenumber: complex, poses: Heads) -> Complexes:
        """Scattered pressure at the ears; see :meth:`Solved.respond`."""
        coupling = self._coupling(
            wavenumber, np.vstack([poses.emitters, poses.ears.reshape(-1, 3)])
        )
        size = 16.0 * KEPT * coupling.rows[-1].stop
        batch = max(1, int(BATCH_BYTES / size))
        parts = [
            self._respond(coupling, poses[start : start + batch])
            for start in range(0, len(poses), batch)
        ]
        return np.concatenate(parts)

    def field(self, wavenumber: complex, emitter: Floats, points: Floats) -> Complexes:
        """Scattered pressure at points, of an emitter that sends alike in all directions.

        Args:
            wavenumber (1/m): Wavenumber of sound in air; its imaginary part is not positive.
            emitter ((3,), m): World frame; its pressure is 1 at 1 m.
            points ((X, 3), m): World frame, outside the spheres or on them.

        Returns:
            pressure ((X,) complex128): Without the emission itself.
        """
        coupling = self._coupling(wavenumber, emitter[None])
        waves = self._scattered(coupling, coupling.emitted(emitter[None]))
        parts = [coupling.heard(index, waves, points) for index in range(len(self.balls))]
        return np.sum(parts, axis=0)

    def _coupling(self, wavenumber: complex, places: Floats) -> Coupling:
        """Return what the spheres send to one another, in degrees that suit heads at places."""
        nearest = min(
            float(np.linalg.norm(places - ball.centre, axis=1).min()) / ball.radius
            for ball in self.balls
        )
        if nearest <= 1.0:
            raise InputError("an emitter or an ear lies inside a sphere; move the poses")
        degrees = self.degrees(wavenumber.real, nearest)
        _refuse_many(degrees, wavenumber.real * self.hearing.speed_of_sound / (2.0 * math.pi))
        return Coupling(self.balls, degrees, wavenumber, self._links, self._all_turns(degrees))

    def _all_turns(self, degrees: list[int]) -> list[list[Floats]]:
        """Return Wigner's matrices of each link, by degree."""
        wanted = max(degrees)
        if not self._turns and self._links:
            self._turns = [[] for _ in self._links]
        if self._links and len(self._turns[0]) <= wanted:
            for degree in range(len(self._turns[0]), wanted + 1):
                matrices = wigner(degree, [link.polar for link in self._links])
                for known, matrix in zip(self._turns, matrices, strict=True):
                    known.append(matrix)
        return self._turns

    def _respond(self, coupling: Coupling, poses: Heads) -> Complexes:
        waves = coupling.emitted(poses.emitters)
        for ball, rows in zip(self.balls, coupling.rows, strict=True):
            waves[rows] *= poses.beam(ball.centre[None]).T
        waves = self._scattered(coupling, waves)
        ears = int(poses.ears.shape[1])
        heard = np.zeros((len(poses), ears), dtype=np.complex128)
        for ear in range(ears):
            for index, ball in enumerate(self.balls):
                gain = poses.gain(ear, ball.centre[None])[:, 0]
                heard[:, ear] += gain * coupling.heard(index, waves, poses.ears[:, ear])
        return heard

    def _scattered(self, coupling: Coupling, first: Complexes) -> Complexes:
        if self.orders is None:
            return self._solved(coupling, first)
        waves = first
        for _ in range(self.orders - 1):
            waves = first + coupling.apply(waves)
        return waves

    def _solved(self, coupling: Coupling, first: Complexes) -> Complexes:
        """Solve ``waves - coupling(waves) = first`` for each column by GCR."""
        residual, waves = first.copy(), np.zeros_like(first)
        scale = np.maximum(np.sqrt(inner_product(first, first).real), 1e-300)
        basis: list[tuple[Complexes, Complexes]] = []
        for _ in range(MOST_ITERATIONS):
            if (np.sqrt(inner_product(residual, residual).real) <= TOLERANCE * scale).all():
                return waves
            if len(basis) == (KEPT - 8) // 2:
                basis.clear()
            step = residual.copy()
            image = step - coupling.apply(step)
            for known, known_image in basis:
                part = inner_product(known_image, image)
                step -= part * known
                image -= part * known_image
            length = np.maximum(np.sqrt(inner_product(image, image).real), 1e-300)
            step /= length
            image /= length
            basis.append((step, image))
            part = inner_product(image, residual)
            waves += part * step
            residual -= part * image
        left = float((np.sqrt(inner_product(residual, residual).real) / scale).max())
        frequency = coupling.wavenumber.real * self.hearing.speed_of_sound / (2.0 * math.pi)
        raise NumericalError(
            f"the spheres' scattering at {frequency / 1e3:.4g} kHz did not converge: after "
            f"{MOST_ITERATIONS} steps {left:.1e} is left, at most {TOLERANCE:.0e} is allowed; move "
            "the spheres farther apart"
        )


def find_balls(scene: Scene) -> list[Ball]:
    """Recognise the spheres of a scene."""
    vertices = np.asarray(scene.mesh.vertices, dtype=np.float64)
    same = np.round(vertices / (TWICE * np.ptp(vertices, axis=0).max()))
    _, first, index = np.unique(same, axis=0, return_index=True, return_inverse=True)
    places, faces = vertices[first], index.reshape(-1)[np.asarray(scene.mesh.faces)]
    # By edges: spheres that touch may share a vertex.
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edge = np.unique(edges, axis=0, return_inverse=True)[1].reshape(-1)
    triangle = np.tile(np.arange(len(faces)), 3)
    join = coo_array((np.ones(len(edge)), (triangle, edge)), shape=(len(faces), edge.max() + 1))
    part = connected_components(join @ join.T, directed=False)[1]
    return [
        _ball(places, faces[part == number], name) for name, number in enumerate(np.unique(part))
    ]


def _ball(places: Floats, faces: Ints, name: int) -> Ball:
    points = places[np.unique(faces)]
    middle = points.mean(axis=0)
    # |x|^2 = 2 c x + (r^2 - c^2) is linear in the centre.
    away = points - middle
    system = np.column_stack([2.0 * away, np.ones(len(away))])
    centre = middle + np.linalg.lstsq(system, (away**2).sum(axis=1), rcond=None)[0][:3]
    distance = np.linalg.norm(points - centre, axis=1)
    radius = float(distance.mean())
    what = f"simulation.engine=spheres: body {name} of the mesh"
    worst = float(np.abs(distance / radius - 1.0).max())
    if worst > ROUND:
        raise InputError(
            f"{what} is no sphere: its vertices are up to {100 * worst:.2g} % of the radius off, "
            f"at most {100 * ROUND:g} % is allowed; take simulation.engine=rays"
        )
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    once = len(np.unique(edges, axis=0)) == len(edges)
    if not once or set(map(tuple, edges.tolist())) != set(map(tuple, edges[:, ::-1].tolist())):
        raise InputError(f"{what} is not closed; mend the mesh")
    corners = places[faces] - centre
    volume = np.einsum("td,td->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    filled = float(volume / (4.0 / 3.0 * math.pi * radius**3))
    if filled < 0.0:
        raise InputError(f"{what} is inside out; turn its triangles round")
    if filled < FILLED:
        raise InputError(
            f"{what} encloses {100 * filled:.0f} % of the sphere through its vertices, at least "
            f"{100 * FILLED:.0f} % is needed; give a finer mesh, or take simulation.engine=rays"
        )
    return Ball(centre, radius)


def _refuse_soft(material: Material) -> None:
    """Refuse what is not rigid."""
    if not material.rigid:
        least = min((*material.strength, *material.reflection))
        raise InputError(
            "simulation.engine=spheres solves for rigid surfaces alone, and a material of the "
            f"scene has lobes or a strength of {least:.3g}; take the material rigid, or "
            "simulation.engine=rays"
        )


def _refuse_close(balls: list[Ball]) -> None:
    for (i, one), (j, two) in itertools.combinations(enumerate(balls), 2):
        gap = float(np.linalg.norm(two.centre - one.centre)) - one.radius - two.radius
        least = APART * min(one.radius, two.radius)
        if gap < least:
            how = "overlap or enclose one another" if gap < 0.0 else "are too close"
            raise InputError(
                f"simulation.engine=spheres: bodies {i} and {j} {how}: {1e3 * gap:.3g} mm lie "
                f"between them, at least {1e3 * least:.3g} mm are needed; move them apart"
            )


def _refuse_many(degrees: list[int], frequency: float) -> None:
    waves = sum((degree + 1) ** 2 for degree in degrees)
    if waves > MOST_WAVES:
        raise InputError(
            f"simulation.engine=spheres: {len(degrees)} spheres need {waves} partial waves at "
            f"{frequency / 1e3:.3g} kHz, at most {MOST_WAVES} can be solved for; lower "
            "simulation.frequency_max, take fewer spheres, or move the poses away from them"
        )


def _links(balls: list[Ball]) -> Iterator[Link]:
    for one, two in itertools.combinations(range(len(balls)), 2):
        axis = balls[two].centre - balls[one].centre
        across = math.hypot(axis[0], axis[1])
        yield Link(
            *(one, two, float(np.linalg.norm(axis))),
            *(math.atan2(across, axis[2]), math.atan2(axis[1], axis[0])),
        )
