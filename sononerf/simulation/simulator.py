# SPDX-License-Identifier: MIT
"""The echo simulator: a scene, a head, a pose in; what both ears hear out."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sononerf.errors import SettingsError
from sononerf.head.air import absorption_in, speed_in
from sononerf.head.ears import Ears, ear_tables, receiver_count
from sononerf.head.reception import Reception
from sononerf.head.row_filters import row_widths
from sononerf.head.spectrogram import frequency_axis, range_axis
from sononerf.scene.scene import Scene
from sononerf.settings.schema import Settings, SimulationSettings, SpectrogramSettings
from sononerf.simulation.arrival import silence_before
from sononerf.simulation.engine import Engine
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.hybrid import hybrid
from sononerf.simulation.impulse_response import plan_synthesis
from sononerf.simulation.rays import Rays
from sononerf.simulation.reference.boundary import Boundary
from sononerf.simulation.reference.kirchhoff import Kirchhoff
from sononerf.simulation.reference.spheres import Spheres
from sononerf.simulation.solved import TAPER, Solved

logger = logging.getLogger("sononerf")

VERSION = 4  # to be raised when the same settings give other echoes: stores are told apart by it


class Simulator:
    """What the ears of a pose hear of a scene.

    Parameters
    ----------
    engine : Engine
        Brings the sound to the ears.
    ears : Ears
        At the frequencies of the spectrogram.
    reception : Reception
        Call, noise and analysis.

    Attributes
    ----------
    range : (R,) float64, m
        Axis of the spectrograms.
    frequency : (F,) float64, Hz
        Axis of the spectrograms.
    """

    def __init__(self, engine: Engine, *, ears: Ears, reception: Reception) -> None:
        self.engine = engine
        self.ears = ears
        self.reception = reception
        self.speed_of_sound = engine.hearing.speed_of_sound
        self.range = range_axis(reception.analysis, self.speed_of_sound)
        self.frequency = frequency_axis(reception.analysis)

    @classmethod
    def from_settings(cls, scene: Scene, settings: Settings) -> Simulator:
        """Build the simulator that settings describe.

        Raises
        ------
        ValueError
            If the settings' ranges hold no analysis frame.
        InputError
            If the file of the directivity cannot be read.
        SettingsError
            If receivers of settings and file do not fit, or noise is set for two of others.
        """
        _check_noise(settings)
        air = settings.air
        speed = speed_in(air)
        analysis = settings.spectrogram
        reception = Reception(settings.call, analysis, settings.noise, speed_of_sound=speed)
        synthesis = plan_synthesis(analysis, reception.samples)
        gains, absorption = partial(ear_tables, settings.ears), partial(absorption_in, air)
        hearing = Hearing(gains(synthesis.nodes), synthesis, absorption(synthesis.nodes), speed)
        wanted = settings.simulation
        engine: Engine
        if wanted.engine in ("spheres", "bem"):
            solver = Spheres if wanted.engine == "spheres" else Boundary
            engine = solver(
                scene,
                hearing,
                gains=gains,
                absorption=absorption,
                frequency_max=solved_frequency(wanted, analysis),
            )
        elif wanted.engine == "kirchhoff":
            if any(material.lobe_width is not None for material in scene.materials):
                logger.warning(
                    "simulation.engine=kirchhoff takes surfaces as smooth; the material's lobes "
                    "are left out, simulation.engine=rays has them"
                )
            engine = Kirchhoff(scene, hearing, frequency_max=1.1 * analysis.frequency_max)
        else:
            rays: dict[str, Any] = {
                "rays": wanted.rays,
                "bounces": wanted.bounces,
                "diffraction_points": wanted.diffraction_points,
            }
            if wanted.engine == "rays":
                engine = Rays(scene, hearing, **rays)
            else:
                engine = hybrid(
                    scene,
                    hearing,
                    gains=gains,
                    absorption=absorption,
                    sources=wanted.sources,
                    frequency_min=analysis.frequency_min,
                    **rays,
                )
        ears = ear_tables(settings.ears, frequency_axis(analysis))
        return cls(engine, ears=ears, reception=reception)

    def hits(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64], *, seed: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Places (N, 3) that send sound straight back, m, and how much (N,), dB below the most."""
        points, strength = self.engine.hits(position, rotation, seed=seed)
        loudest = max(float(strength.max(initial=0.0)), 1e-300)
        return points, 20.0 * np.log10(np.maximum(strength / loudest, 1e-10))

    def echo(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64], *, seed: int
    ) -> NDArray[np.float64]:
        """Pressure at both ears for an impulse; see :meth:`Engine.echo`.

        Engines that solve the wave equation hear with the head as it is; of the others nothing is
        kept that comes before sound can arrive, see :func:`silence_before`.
        """
        engine = self.engine
        echo = engine.echo(position, rotation, seed=seed)
        if isinstance(engine, Solved):
            return echo
        emitter, ears = engine.hearing.places(position, rotation)
        first = engine.arrival.shortest(emitter[None], ears[None])[0] / self.speed_of_sound
        rate = engine.hearing.synthesis.sampling_rate
        return silence_before(echo, first, sampling_rate=rate)

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
            Of whatever is random.

        Returns
        -------
        magnitude : (E, R, F) float32
            Linear.
        """
        return self.receive(position, rotation, seed=seed)[1].astype(np.float32)

    def receive(
        self, position: NDArray[np.float64], rotation: NDArray[np.float64], *, seed: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what both ears hear of the call, noise included, and its spectrogram.

        Parameters
        ----------
        position : (3,) float64, m
            Of the head, world frame.
        rotation : (3, 3) float64
            Head to world.
        seed : int
            Of whatever is random.

        Returns
        -------
        waveform : (E, S) float64
            Pressure from the start of the emission on.
        magnitude : (E, R, F) float64
            Linear; dechirped where the call is a sweep.
        """
        echo = self.echo(position, rotation, seed=seed)
        return self.reception.receive(echo, seed=seed)


def _check_noise(settings: Settings) -> None:
    """Refuse noise levels of two ears where a file has another number of receivers."""
    if isinstance(settings.noise.snr_db, tuple):
        count = receiver_count(settings.ears)
        if count != 2:
            raise SettingsError(
                f"noise.snr_db: gives 2 levels, but {settings.ears.file} holds {count} receivers; "
                "give one level for all"
            )


def solved_frequency(wanted: SimulationSettings, analysis: SpectrogramSettings) -> float:
    """Return the frequency (Hz) at which what is solved for has fallen to zero.

    Where it is not set, the response is whole up to the highest analysed frequency and the
    bandwidth (-6 dB) of a row there above it.
    """
    if wanted.frequency_max is None:
        bandwidth = float(row_widths(analysis, analysis.frequency_max)[1])
        return min(TAPER * (analysis.frequency_max + bandwidth), analysis.sampling_rate / 2.0)
    whole = wanted.frequency_max / TAPER
    if whole < analysis.frequency_max:
        logger.warning(
            "simulation.frequency_max=%g Hz: what is heard fades from %.0f Hz on, below "
            "spectrogram.frequency_max (%g Hz)",
            *(wanted.frequency_max, whole, analysis.frequency_max),
        )
    return wanted.frequency_max
