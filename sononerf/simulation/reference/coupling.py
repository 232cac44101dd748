# SPDX-License-Identifier: MIT
"""Scattering between rigid spheres, by partial waves."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from sononerf.array_types import Complexes, Floats
from sononerf.simulation.reference.partial_waves import (
    into_axis,
    legendre,
    log_outgoing,
    mirror,
    move,
    out_of_axis,
    seen_from,
    slopes,
)


@dataclass(frozen=True, eq=False)
class Ball:
    """A sphere.

    Attributes:
        centre ((3,), m): World frame.
        radius (m): Radius of its surface.
    """

    centre: Floats
    radius: float


@dataclass(frozen=True)
class Link:
    """The axis between two spheres.

    Attributes:
        one, two: Numbers of the spheres; the axis points from the first to the second.
        length (m): Between the centres.
        polar, azimuth (rad): Angles of the axis.
    """

    one: int
    two: int
    length: float
    polar: float
    azimuth: float


class Coupling:
    """Scattering between spheres at one wavenumber.

    Waves are arrays (K, P): for each sphere the harmonics ``n, m`` at row ``n (n + 1) + m`` of its
    rows, each relative to its Hankel function on the sphere; P poses.

    Args:
        wavenumber (1/m): Wavenumber of sound in air.
        turns (list of list of (2 n + 1, 2 n + 1) float64): Wigner's matrices of each link by
            degree.
    """

    def __init__(
        self,
        balls: list[Ball],
        degrees: list[int],
        wavenumber: complex,
        links: list[Link],
        turns: list[list[Floats]],
    ) -> None:
        self.balls, self.degrees, self.wavenumber = balls, degrees, wavenumber
        self.links, self.turns = links, turns
        ends = np.cumsum([0, *((degree + 1) ** 2 for degree in degrees)])
        self.rows = [slice(start, end) for start, end in itertools.pairwise(ends.tolist())]
        self.on_ball = [
            log_outgoing(degree, np.array([wavenumber * ball.radius]))
            for ball, degree in zip(balls, degrees, strict=True)
        ]
        known: dict[tuple[float, ...], list[Complexes]] = {}
        self._moves: list[tuple[list[Complexes], list[Complexes]]] = []
        for link in links:
            both = []
            for source, target in ((link.one, link.two), (link.two, link.one)):
                key = (
                    *(balls[source].radius, degrees[source]),
                    *(balls[target].radius, degrees[target], link.length),
                )
                if key not in known:
                    known[key] = self._along(source, target, link.length)
                both.append(known[key])
            self._moves.append((both[0], both[1]))

    def emitted(self, emitters: Floats) -> Complexes:
        """Return what the emission alone causes on the spheres (K, P), from (P, 3) m."""
        waves = np.zeros((self.rows[-1].stop, len(emitters)), dtype=np.complex128)
        for index, (ball, degree) in enumerate(zip(self.balls, self.degrees, strict=True)):
            distance, around = seen_from(emitters - ball.centre, degree)
            at_head = log_outgoing(
                degree, np.asarray(self.wavenumber * distance, dtype=np.complex128)
            )[0]
            radial = np.exp(at_head - self.on_ball[index][0])  # (N + 1, P)
            slope = self.wavenumber * slopes(self.wavenumber * ball.radius, self.on_ball[index][0])
            share = -1j * self.wavenumber * 4.0 * math.pi * slope * self._answer(index)
            radial *= share[:, None]
            order = 2 * np.arange(degree + 1) + 1
            waves[self.rows[index]] = around.conj() * np.repeat(radial, order, axis=0)
        return waves

    def heard(self, index: int, waves: Complexes, ears: Floats) -> Complexes:
        """Return the pressure (P,) that a sphere scatters, at a place (P, 3) m for each pose."""
        degree = self.degrees[index]
        distance, around = seen_from(ears - self.balls[index].centre, degree)
        at_ear = log_outgoing(degree, np.asarray(self.wavenumber * distance, dtype=np.complex128))[
            0
        ]
        ratio = np.exp(at_ear - self.on_ball[index][0])
        order = 2 * np.arange(degree + 1) + 1
        around = around * waves[self.rows[index]]
        around *= np.repeat(ratio, order, axis=0)
        pressure: Complexes = around.sum(axis=0)
        return pressure

    def apply(self, waves: Complexes) -> Complexes:
        """Return what waves (K, P) of each sphere cause on all others."""
        caused = np.zeros_like(waves)
        for link, turns, moves in zip(self.links, self.turns, self._moves, strict=True):
            one, two = self.rows[link.one], self.rows[link.two]
            forward = into_axis(waves[one], link.azimuth, turns)
            back = into_axis(waves[two], link.azimuth, turns)
            mirror(back)
            moved = move(moves[0], forward, self.degrees[link.two])
            caused[two] += out_of_axis(moved, link.azimuth, turns)
            moved = move(moves[1], back, self.degrees[link.one])
            mirror(moved)
            caused[one] += out_of_axis(moved, link.azimuth, turns)
        return caused

    def _answer(self, index: int) -> Complexes:
        """Return the waves (N,) that a slope of pressure on a sphere causes, m."""
        slope = self.wavenumber * self.on_ball[index][1][:, 0]
        answer: Complexes = -1.0 / slope
        return answer

    def _along(self, source: int, target: int, length: float) -> list[Complexes]:
        """Return the matrices (L - m + 1, N - m + 1) that translate along +z, by order m."""
        given, wanted = self.degrees[source], self.degrees[target]
        radius = self.balls[target].radius
        node, weight = np.polynomial.legendre.leggauss(given + wanted + 8)
        height, across = length + radius * node, radius * np.sqrt(1.0 - node**2)
        distance = np.hypot(height, across)
        log_h, slope = log_outgoing(given, self.wavenumber * distance)
        ratio = np.exp(log_h - self.on_ball[source][0])  # (N, Q)
        n = np.arange(given + 1)[:, None]
        bend = length / (radius * distance)  # of the polar angle, over its sine's ratio
        own = self.wavenumber * slope * ((radius + length * node) / distance)
        own = ratio * (own + n * (bend * height / distance))
        below = ratio * bend
        here = legendre(wanted, node) * (2.0 * math.pi * weight)
        there = legendre(given, height / distance)
        answer = self._answer(target)
        moves = []
        for m in range(min(given, wanted) + 1):
            degree = np.arange(m, given + 1)
            factor = np.sqrt((2 * degree + 1) / np.maximum(2 * degree - 1, 1) * (degree**2 - m**2))
            field = own[m:] * there[m, m:]
            field[1:] -= factor[1:, None] * below[m + 1 :] * there[m, m:-1]
            real = here[m, m:] @ np.ascontiguousarray(field.real.T)
            imaginary = here[m, m:] @ np.ascontiguousarray(field.imag.T)
            moves.append(answer[m:, None] * (real + 1j * imaginary))
        return moves
