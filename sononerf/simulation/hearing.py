# SPDX-License-Identifier: MIT
"""Reception of sound from points: which hits are heard, by ears and beam, and when."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.geometry.meshes import Plane
from sononerf.head.ears import beam_gain, ear_gain
from sononerf.head.head import Head
from sononerf.numerics import Bools, Complexes, Floats, Ints, Singles, compiled
from sononerf.scene.scene import Scene
from sononerf.simulation.impulse_response import (
    NODE_SPACING,
    Synthesis,
    air_loss,
    deposit,
    plan_synthesis,
    synthesise,
)
from sononerf.simulation.paths import Bounce

RESOLVED_FREQUENCY = 80e3
"""Frequency at which bundles of rays and shadows resolve the surface, Hz; near the top of the
default band, 100 kHz."""
RESOLVED = 1.0
"""Bend of the path over a bundle up to which a mirror point in it is resolved, rad."""
MAX_PHASE = 4.0
"""Phase from a bundle to a mirror point up to which the point counts, rad; it has e^-4 there."""
MAX_BUNDLE_SIDES = 1.0
"""Distance from the middle of a bundle to a mirror point of its own, sides of the bundle."""
MAX_BUNDLE_WIDTH = 5e-4
"""Width of a bundle, m, above which it may hold a mirror point of the next bounce that its ray does
not show."""
EXPLORE = 0.1
"""Weight of such a bundle, as a fraction of that of one with a mirror point."""
EARS_APART = 0.03
"""Distance between receivers, m, up to which the middle between them stands for each of them."""


@dataclass(frozen=True)
class Audibility:
    """Test of the hits of later bounces for audibility."""

    wavenumber: float  # rad/m: At the frequency that bundles must resolve
    farthest: float  # m: Longest detour that is heard
    radius: float  # m: Radius of the scene
    bounces: int  # Largest number of hits of a ray

    def judge(self, bounce: Bounce, listeners: Floats, least: float) -> tuple[Bools, Floats]:
        """Return the mask (H,) of audible hits, and the possible error of each (H,).

        Hits with sharper mirror paths than ``least`` (m/rad²) are no cells of the integral.
        """
        count = len(bounce.ray)
        audible, doubt = np.zeros(count, dtype=np.bool_), np.zeros(count)
        # Sound that continues from here may be heard, whatever the view from the head.
        explore = EXPLORE / self.radius if 1 < bounce.number < self.bounces else 0.0
        angle = np.atleast_1d(np.asarray(bounce.solid_angle, dtype=np.float64))
        tube = np.ascontiguousarray(bounce.footprint.tube)
        for place in listeners:
            paths = bounce.paths_to(place)
            _judge(
                audible, doubt, paths.distance, paths.rise, paths.detour, paths.stiffness,
                paths.softness > least, tube, angle, self.wavenumber, self.farthest, explore,
            )  # fmt: skip
        return audible, doubt


@compiled
def _judge(
    audible: Bools,
    doubt: Floats,
    distance: Floats,
    rise: Singles,
    detour: Singles,
    stiffness: Singles,
    is_sharp: Bools,
    tube: Singles,
    solid_angle: Floats,
    k: float,
    farthest: float,
    explore: float,
) -> None:
    """Add one listener to the audible hits (H,) and their doubts (H,).

    In: audible, doubt (H,), distance, rise, detour, stiffness, is_sharp (H,), tube ((H,), m²/sr),
    solid_angle ((H,) or (1,), sr), k (rad/m), farthest (m), explore (1/m).
    """
    for i in range(len(distance)):
        angle = solid_angle[i if len(solid_angle) > 1 else 0]
        side, width = math.sqrt(angle), math.sqrt(tube[i])
        level = angle * width
        # Seen from an ear either may be somewhat different from the middle between the ears.
        facing = rise[i] * distance[i] > -EARS_APART
        if is_sharp[i] or (facing and detour[i] < 1.25 * farthest):
            audible[i] = True
        # Counted in turns of the ray at the emitter, the mirror point is this far from the cell.
        off = math.sqrt(2.0 * detour[i] / max(stiffness[i], 1e-12)) - MAX_BUNDLE_SIDES * side
        least = 0.5 * stiffness[i] * max(off, 0.0) ** 2
        turns = k * stiffness[i] * angle
        if facing and turns > RESOLVED and k * least < MAX_PHASE and not is_sharp[i]:
            found = level / distance[i] * math.exp(-k * least) * min(turns, 10.0)
            doubt[i] = max(doubt[i], found)
        if side * width > MAX_BUNDLE_WIDTH:
            doubt[i] = max(doubt[i], explore * level)


POINT_SPACING = 0.05
"""Distance between points at which the first arrival is sought, in radii of a sphere around the
scene. The path is then at most 0.1 % of that radius too long."""
SILENT_TIME = 0.21 / NODE_SPACING
"""Time before the first arrival up to which the echo is zero, s (26 us). With half an analysis
window of 32 us nothing is heard more than 10 mm before the nearest point."""


class Arrival:
    """The shortest ways from an emitter over the surface of a scene to an ear.

    Attributes:
        radius (m): Radius of a sphere around the scene.
    """

    def __init__(self, scene: Scene) -> None:
        corners = np.asarray(scene.mesh.vertices, dtype=np.float64)[np.asarray(scene.mesh.faces)]
        corners = corners.reshape(-1, 3)
        self._middle = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
        self.radius = float(np.linalg.norm(corners - self._middle, axis=1).max())
        vertices, faces = trimesh.remesh.subdivide_to_size(
            scene.mesh.vertices, scene.mesh.faces, POINT_SPACING * self.radius, max_iter=20
        )
        used = np.asarray(vertices, dtype=np.float64)[np.unique(faces)]
        self._points: Floats = np.unique(used, axis=0) - self._middle

    def shortest(self, emitters: Floats, ears: Floats) -> Floats:
        """Return the shortest way (P, E), m. In: emitters ((P, 3), m), ears ((P, E, 3), m)."""
        lengths = np.zeros(ears.shape[:2])
        square = np.einsum("nd,nd->n", self._points, self._points)
        for pose, heads in enumerate(np.concatenate([emitters[:, None], ears], axis=1)):
            heads = heads - self._middle
            # Products suffice: coordinates count from the middle of the scene.
            lengths_via = square - 2.0 * heads @ self._points.T
            lengths_via += np.einsum("hd,hd->h", heads, heads)[:, None]
            np.sqrt(np.maximum(lengths_via, 0.0, out=lengths_via), out=lengths_via)
            lengths[pose] = (lengths_via[:1] + lengths_via[1:]).min(axis=1)
        return lengths


def silence_before(echo: Floats, first: Floats, *, sampling_rate: float) -> Floats:
    """Set the echo before the first possible arrival to zero.

    The gains of beam and ears are real, so their responses are even in time: one half precedes the
    echo. Everything that is more than 26 us earlier than the first possible arrival is set to zero.
    Onsets and free space are then found from sound that has arrived.

    In: echo (E, S), first ((E,), s), sampling_rate (Hz). Out: echo (E, S).
    """
    before = first[:, None] - np.arange(echo.shape[1]) / sampling_rate
    return np.where(before < SILENT_TIME, echo, 0.0)


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
            emitted = emitted @ self.image.reflection
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
            quadrature, dim, passed = shaded
            part = gain.take(dim, axis=0)
            quadrature.add(ear, delay.take(dim), spread.take(dim), part * passed.imag)
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
    return Hearing(head, plan_synthesis(head.spectrogram, head.samples))


def _into_head(vectors: Floats, rotation: Floats) -> Floats:
    return vectors @ rotation
