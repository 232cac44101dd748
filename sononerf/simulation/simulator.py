# SPDX-License-Identifier: MIT
"""The echo simulator: a scene, a head, a pose in; the pressure at both ears out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.acoustics.air import air_absorption, speed_of_sound
from sononerf.acoustics.ears import Ears, beam_gain, ear_gain, synthetic_ears
from sononerf.acoustics.spectrogram import frequency_axis, range_axis, spectrogram
from sononerf.config import Settings, SpectrogramSettings
from sononerf.geometry.directions import CapSpiral
from sononerf.geometry.raycast import RayCaster
from sononerf.scene import Scene
from sononerf.simulation.impulse_response import (
    OVERSAMPLING,
    Synthesis,
    deposit,
    plan_synthesis,
    synthesise,
)
from sononerf.simulation.paths import Bounce, aim, echo_paths
from sononerf.simulation.reflection import REACH, Reflection, lobe_exponent, reflection

DEFAULT_SPEED = 343.0  # m/s
DIVIDED_SHARE = 0.6  # of the rays, kept for where they hit more than once
DEFAULT_TEMPERATURE = 20.0  # °C, for absorption where only the speed is fixed


class Simulator:
    r"""Echoes of a scene by rays.

    Rays fill the cap under which the emitter sees the scene, each standing for the same solid
    angle :math:`d\Omega`. Every hit is heard by every ear that sees it, with the amplitude

    .. math:: s \frac{f}{c}\, d\Omega\, \frac{r_1}{r_2}\,
        e^{-\theta^2 / 2 w^2}\, 10^{-\alpha (r_1 + r_2) / 20}\, B\, E \prod k

    where :math:`s, w, k` are the material's strength, lobe width and kept part of earlier
    bounces, :math:`r_1` the path from the emitter to the hit, :math:`r_2` from there to the ear,
    :math:`\theta` the angle off the mirror direction, :math:`\alpha` the air's absorption,
    :math:`B, E` the gains of beam and ear. It is Kirchhoff's integral
    :math:`(1/\lambda) \int \cos\vartheta\, dA / (r_1 r_2)`, with the area that a ray lights,
    :math:`dA = r_1^2 d\Omega / \cos\vartheta`, so the level does not depend on how many rays
    there are. After a bounce off a curved surface a ray lights more than that; the spread is
    left out, as in the original.

    Parameters
    ----------
    scene : Scene
        What is ensonified.
    ears : Ears
        At the frequencies of the spectrogram.
    node_ears : Ears
        The same at the nodes of the synthesis.
    synthesis : Synthesis
        Nodes and filters.
    analysis : SpectrogramSettings
        How echoes become spectrograms.
    absorption : (F,) float64, dB/m
        Of the air at the nodes.
    speed_of_sound : float, m/s
        Of the air.
    rays : int
        Per pose.
    bounces : int
        How often a ray may hit.

    Attributes
    ----------
    range : (R,) float64, m
        Axis of the spectrograms.
    frequency : (F,) float64, Hz
        Axis of the spectrograms.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        ears: Ears,
        node_ears: Ears,
        synthesis: Synthesis,
        analysis: SpectrogramSettings,
        absorption: NDArray[np.float64],
        speed_of_sound: float,
        rays: int,
        bounces: int,
    ) -> None:
        self.scene = scene
        self.ears = ears
        self.speed_of_sound = speed_of_sound
        self.analysis = analysis
        self.range = range_axis(analysis, speed_of_sound)
        self.frequency = frequency_axis(analysis)
        self.rays = rays
        self.bounces = bounces
        self._node_ears = node_ears
        self._synthesis = synthesis
        self._decay = absorption * (math.log(10.0) / 20.0)  # 1/m
        self._reflection: Reflection = reflection(scene.material, synthesis.nodes)
        vertices = np.asarray(scene.mesh.vertices, dtype=np.float64)
        self._centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        self._radius = float(np.linalg.norm(vertices - self._centre, axis=1).max())
        self._caster: RayCaster | None = None

    @classmethod
    def from_settings(cls, scene: Scene, settings: Settings) -> Simulator:
        """Build the simulator that settings describe.

        Raises
        ------
        ValueError
            If the settings' ranges hold no analysis frame.
        """
        air = settings.air
        given = air.temperature_c
        speed = DEFAULT_SPEED if given is None else speed_of_sound(given)
        synthesis = plan_synthesis(settings.spectrogram, speed)
        return cls(
            scene,
            ears=synthetic_ears(settings.ears, frequency_axis(settings.spectrogram)),
            node_ears=synthetic_ears(settings.ears, synthesis.nodes),
            synthesis=synthesis,
            analysis=settings.spectrogram,
            absorption=air_absorption(
                synthesis.nodes,
                temperature_c=DEFAULT_TEMPERATURE if given is None else given,
                relative_humidity=air.relative_humidity,
                pressure=air.pressure_pa,
            ),
            speed_of_sound=speed,
            rays=settings.simulation.rays,
            bounces=settings.simulation.bounces,
        )

    def __getstate__(self) -> dict[str, Any]:
        # The search tree cannot be pickled; who receives the mesh builds it anew.
        return {**self.__dict__, "_caster": None}

    @property
    def caster(self) -> RayCaster:
        """The scene's ray caster, built when it is first needed."""
        if self._caster is None:
            self._caster = RayCaster(self.scene.mesh)
        return self._caster

    def echo(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64], *, seed: int
    ) -> NDArray[np.float64]:
        """Pressure at both ears for a call that is one sample of height 1.

        Parameters
        ----------
        position : (3,) float64, m
            Of the head, world frame.
        rotation : (3, 3) float64
            Head to world.
        seed : int
            Turns and shifts the pattern of rays as a whole.

        Returns
        -------
        echo : (E, S) float64
            From the emission to the end of the last analysis frame.
        """
        emitter = position + rotation @ self._node_ears.emitter
        axis, half_angle = aim(emitter, self._centre, self._radius)
        first, second = np.random.default_rng(seed).random(2)
        extra = round(self.rays * DIVIDED_SHARE) if self.bounces > 1 else 0
        # Laid out in the head's frame, the pattern turns with head and scene together.
        cap = CapSpiral(self.rays - extra, axis @ rotation, half_angle, (first, second), rotation)
        ears = position + self._node_ears.positions @ rotation.T
        synthesis, material = self._synthesis, self._reflection
        bins = np.zeros((len(ears), len(synthesis.nodes), OVERSAMPLING * synthesis.length))
        paths = echo_paths(self.caster, emitter, cap, bounces=self.bounces, extra=extra)
        for bounce in paths:
            level = bounce.solid_angle / self.speed_of_sound * material.strength
            level = level * material.kept ** (bounce.number - 1)
            for ear, place in enumerate(ears):
                heard, delay, gain = self._hear(bounce, place)
                towards = _into_head(bounce.points[heard] - place, rotation)
                towards /= np.linalg.norm(towards, axis=1, keepdims=True)
                gain *= level
                gain *= beam_gain(self._node_ears, _into_head(bounce.emitted[heard], rotation))
                gain *= ear_gain(self._node_ears, ear, towards)
                bins[ear] += deposit(synthesis, delay, gain)
        return synthesise(synthesis, bins)

    def _hear(
        self, bounce: Bounce, ear: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Which hits an ear hears, their delay (s), and (r1 / r2) times lobe times air (H, F)."""
        away = ear - bounce.points
        distance = np.linalg.norm(away, axis=1)
        cosine = np.einsum("nd,nd->n", bounce.mirrored, away) / distance
        reach = min(REACH * float(self._reflection.lobe_width.max()), math.pi)
        facing = np.einsum("nd,nd->n", bounce.flat, away) > 0.0
        heard = np.flatnonzero((cosine > math.cos(reach)) & facing)
        seen = self.caster.visible(bounce.points[heard], ear, normals=bounce.flat[heard])
        heard = heard[seen]
        r1, r2 = bounce.length[heard], distance[heard]
        exponent = lobe_exponent(cosine[heard], self._reflection.lobe_width)
        exponent -= (r1 + r2)[:, None] * self._decay
        gain = np.exp(exponent) * (r1 / r2)[:, None]
        return heard, (r1 + r2) / self.speed_of_sound, gain

    def spectrogram(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64], *, seed: int
    ) -> NDArray[np.float32]:
        """Magnitude of what both ears hear, over range and frequency.

        Parameters
        ----------
        position : (3,) float64, m
            Of the head, world frame.
        rotation : (3, 3) float64
            Head to world.
        seed : int
            Turns and shifts the pattern of rays as a whole.

        Returns
        -------
        magnitude : (E, R, F) float32
            Linear.
        """
        echo = self.echo(position, rotation, seed=seed)
        return spectrogram(echo, self.analysis, self.speed_of_sound).astype(np.float32)


def _into_head(vectors: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    # Not a matrix product: BLAS would wake all its threads for three columns.
    turned: NDArray[np.float64] = np.einsum("nd,de->ne", vectors, rotation)
    return turned
