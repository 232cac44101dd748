# SPDX-License-Identifier: MIT
"""Reception of sound from points: beam, ears, air, and arrival times."""

from __future__ import annotations

import copy
import math
from functools import cached_property, lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sononerf.array_types import Complexes, Floats, Ints, Singles
from sononerf.geometry.plane import Plane
from sononerf.head.ears import beam_gain, ear_gain
from sononerf.head.head import Head
from sononerf.simulation.impulse_response import (
    Synthesis,
    air_loss,
    deposit,
    plan_synthesis,
    synthesise,
)


class Listener(Protocol):
    """Receiver of the echoes of points, one by one; see :meth:`Sound.add`."""

    def add(
        self, ear: int, delay: NDArray[Any], spread: NDArray[Any], strength: NDArray[Any]
    ) -> None:
        """Take echoes of one ear."""


class Sound:
    """Sound at the ears of one pose, while it is collected.

    Attributes:
        bins: Bins of each ear.
        heard: True if any echo was added.
    """

    def __init__(self, synthesis: Synthesis, ears: int) -> None:
        self._synthesis = synthesis
        self.bins = [synthesis.silence() for _ in range(ears)]
        self.heard = False

    def add(
        self, ear: int, delay: NDArray[Any], spread: NDArray[Any], strength: NDArray[Any]
    ) -> None:
        """Add echoes: delay (N,) s, spread (N,) s, strength (N, F)."""
        self.heard = True
        deposit(self._synthesis, self.bins[ear], delay, spread, strength)


class Hearing:
    """Response of a head to echoes of points.

    Attributes:
        ears: Gains at the nodes of the synthesis.
        absorption ((F,), dB/m): Absorption of the air at the nodes.
        speed_of_sound (m/s): Speed of the air.
        image: The plane in which the emitter is mirrored, see :meth:`from_image`; None where the
            emitter itself calls.
    """

    image: Plane | None = None

    def __init__(self, head: Head, synthesis: Synthesis) -> None:
        self.head, self.synthesis = head, synthesis
        self.ears = head.tables(synthesis.nodes)
        self.absorption = head.absorption(synthesis.nodes)
        self.speed_of_sound = head.speed_of_sound

    @cached_property
    def _air(self) -> Singles:
        decay = self.absorption * (math.log(10.0) / 20.0) * self.speed_of_sound
        return air_loss(self.synthesis, decay).astype(np.float32)

    @property
    def from_image(self) -> Hearing:
        """The same, with the image of the emitter in the support in place of the emitter."""
        other = copy.copy(self)
        other.image = self.head.plane
        return other

    def places(self, position: Floats, rotation: Floats) -> tuple[Floats, Floats]:
        """Return the emitter (3,) and the ears (E, 3) of a pose, m, world frame."""
        emitter, ears = self.head.places(position, rotation)
        return emitter if self.image is None else self.image.mirrored(emitter), ears

    def silence(self) -> Sound:
        """Return nothing heard yet."""
        return Sound(self.synthesis, len(self.ears.positions))

    def beam(self, emitted: Floats, rotation: Floats) -> Singles:
        """Return the beam's gain (N, F) towards directions (N, 3) of the world."""
        if self.image is not None:
            emitted = emitted @ self.image.turn
        return beam_gain(self.ears, _into_head(emitted, rotation))

    def gain(self, ear: int, towards: Floats, rotation: Floats) -> Singles:
        """Return an ear's gain (N, F) for sound from directions (N, 3) of the world."""
        return ear_gain(self.ears, ear, _into_head(towards, rotation))

    def add(
        self,
        sound: Listener,
        ear: int,
        points: Floats,
        *,
        length: Floats,
        spread: NDArray[np.floating[Any]],
        level: NDArray[np.floating[Any]],
        position: Floats,
        rotation: Floats,
        shaded: tuple[Listener, Ints, NDArray[np.complex64]] | None = None,
    ) -> None:
        r"""Add what one ear hears of points.

        A point adds :math:`(j f / c)\, a\, e^{-j k (r_1 + r_2)} / r_2` times the ear's gain and
        the air's loss to the pressure, with :math:`a` its level and :math:`r_2` the way to the
        ear.

        In: points ((N, 3), m), length ((N,), m), spread ((N,), m), level ((N, F) or (N, 1), m),
        position ((3,), m), rotation (3, 3).
        """
        place = position + rotation @ self.ears.positions[ear]
        towards = points - place
        distance = np.sqrt(np.einsum("nd,nd->n", towards, towards))
        towards /= distance[:, None]
        gain = self.gain(ear, towards, rotation)
        gain *= level
        gain /= (self.speed_of_sound * distance).astype(np.float32)[:, None]
        delay, spread = (length + distance) / self.speed_of_sound, spread / self.speed_of_sound
        if shaded is not None:
            turned, dim, passed = shaded
            part = gain.take(dim, axis=0)
            turned.add(ear, delay.take(dim), spread.take(dim), part * passed.imag)
            gain[dim] = part * passed.real
        sound.add(ear, delay, spread, gain)

    def echo(self, sound: Sound, basis: Complexes | None = None) -> Floats:
        """Return the pressure at the ears for a call that is one sample of height 1.

        In: basis ((K, F) complex128). Out: echo (E, S).
        """
        filters = self.synthesis.basis if basis is None else basis
        return np.stack(
            [synthesise(self.synthesis, bins, self._air, filters) for bins in sound.bins]
        )


@lru_cache(maxsize=2)  # tables of many receivers are large
def hearing_of(head: Head) -> Hearing:
    """Return the response of a head, with its time bins; computed once per head."""
    return Hearing(head, plan_synthesis(head.analysis, head.samples))


def _into_head(vectors: Floats, rotation: Floats) -> Floats:
    turned: Floats = vectors @ rotation
    return turned
