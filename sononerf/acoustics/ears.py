# SPDX-License-Identifier: MIT
"""The emitter's beam and the two ears as tables over direction and frequency.

Head frame: x forward, y left, z up. Azimuth counts from straight ahead, positive to the left;
elevation is positive up. Ear 0 is the left one.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.special import j1

from sononerf.acoustics.smearing import smearing
from sononerf.acoustics.spectrogram import frequency_axis
from sononerf.config import CallSettings, EarSettings, SpectrogramSettings

SPEED = 343.0  # m/s; the beam's width follows it so weakly that temperature is left out
GRID_DEG = 2.0
WIDTH_FREQUENCY = 50e3  # Hz, where an ear is as wide as its setting says
NOTCH_MIDDLE = 60e3  # Hz, at elevation 0
NOTCH_RISE = 30e3  # Hz, from elevation 0 to straight up
NOTCH_WIDTH = 8e3  # Hz, standard deviation


@dataclass(frozen=True, eq=False)
class Ears:
    """Real, non-negative gains of the beam and of each ear, and where they are.

    Attributes
    ----------
    azimuth : (A,) float64, rad
        Uniform from -pi to pi, both included.
    elevation : (L,) float64, rad
        Uniform from -pi/2 to pi/2, both included.
    frequency : (F,) float64, Hz
        Ascending.
    beam : (F, L, A) float32
        Gain of the emission.
    ears : (E, F, L, A) float32
        Gain of each ear.
    emitter : (3,) float64, m
        Head frame.
    positions : (E, 3) float64, m
        Of the ears, head frame.
    """

    azimuth: NDArray[np.float64]
    elevation: NDArray[np.float64]
    frequency: NDArray[np.float64]
    beam: NDArray[np.float32]
    ears: NDArray[np.float32]
    emitter: NDArray[np.float64]
    positions: NDArray[np.float64]

    def __post_init__(self) -> None:
        grid = (len(self.frequency), len(self.elevation), len(self.azimuth))
        if self.beam.shape != grid or self.ears.shape != (len(self.positions), *grid):
            raise ValueError(
                f"beam {self.beam.shape} and ears {self.ears.shape} do not fit the grid {grid} "
                f"of {len(self.positions)} ears"
            )

    @cached_property
    def _by_direction(self) -> NDArray[np.float32]:
        """Beam, then ears, with frequency last: (1 + E, L A, F); one look-up is one row."""
        tables = np.concatenate([self.beam[None], self.ears])
        flat = tables.reshape(*tables.shape[:2], -1).transpose(0, 2, 1)
        return np.ascontiguousarray(flat, dtype=np.float32)


def synthetic_ears(settings: EarSettings, frequency: ArrayLike) -> Ears:
    r"""Tables of a piston-like emitter and of two mirrored, bat-like ears.

    The beam is that of a piston of radius ``a`` in a small head,
    :math:`|2 J_1(ka \sin\theta) / (ka \sin\theta)| (1 + \cos\theta) / 2`; radius 0 emits alike in
    all directions. An ear hears best towards its axis, as a Gaussian of the angle from it whose
    width falls with the square root of frequency (``width_deg`` at 50 kHz); a spectral notch
    rises from 30 kHz (straight down) over 60 kHz to 90 kHz (straight up), so that elevation can
    be told from the spectrum.

    Parameters
    ----------
    settings : EarSettings
        Places, axes, widths.
    frequency : (F,) float, Hz
        Ascending.

    Returns
    -------
    ears : Ears
        On a grid of 2 degrees.
    """
    f = np.asarray(frequency, dtype=np.float64)
    azimuth = np.radians(np.linspace(-180.0, 180.0, round(360.0 / GRID_DEG) + 1))
    elevation = np.radians(np.linspace(-90.0, 90.0, round(180.0 / GRID_DEG) + 1))
    level = np.cos(elevation)[:, None]
    directions = np.stack(
        [
            level * np.cos(azimuth),
            level * np.sin(azimuth),
            np.broadcast_to(np.sin(elevation)[:, None], (len(elevation), len(azimuth))),
        ],
        axis=-1,
    )  # (L, A, 3)
    notch_at = NOTCH_MIDDLE + NOTCH_RISE * elevation / (np.pi / 2.0)
    off = (f[:, None] - notch_at) / NOTCH_WIDTH  # (F, L)
    notch = 1.0 - settings.notch_depth * np.exp(-0.5 * off**2)
    sides = (1.0, -1.0)
    ears = [
        _lobe(directions, side * settings.azimuth_deg, settings, f) * notch[:, :, None]
        for side in sides
    ]
    left = np.asarray(settings.left, dtype=np.float64)
    return Ears(
        azimuth,
        elevation,
        f,
        _beam(directions, settings.beam_radius, f).astype(np.float32),
        np.stack(ears).astype(np.float32),
        np.asarray(settings.emitter, dtype=np.float64),
        np.stack([left * (1.0, side, 1.0) for side in sides]),
    )


@lru_cache(maxsize=4)  # a fit and its read-out ask nine times; no one may write to the arrays
def analysed_ears(
    settings: EarSettings, call: CallSettings, analysis: SpectrogramSettings
) -> tuple[Ears, NDArray[np.float32] | None]:
    r"""Tables of the same head as an analysis hears it: smeared over frequency by its window.

    A window of 64 µs cannot tell frequencies apart that lie closer than about 28 kHz. It fills a
    narrow notch, and the spectrum of an echo in its middle is that of beam and ear convolved with
    the window's transform. Beam and ear are smeared one by one: the beam varies slowly.

    A sweep's frequencies enter the window one after the other. With :math:`G` the gain,
    :math:`X` the call's spectrum, :math:`\tau` its delays and :math:`W` the window's transform,
    a row at :math:`f` hears by Parseval's theorem the power and, on the mean, as much too late

    .. math::
        \overline{G}(f)^2 = \frac{\sum_\nu w_\nu G(\nu)^2}{\sum_\nu w_\nu}, \qquad
        \overline{t}(f) = \frac{\sum_\nu w_\nu G(\nu)^2 (\tau(\nu) - \tau(f))}
        {\sum_\nu w_\nu G(\nu)^2}, \qquad w_\nu = W(\nu - f)^2 |X(\nu)|^2

    so that beside a notch an echo seems to come from millimetres nearer or farther.

    Parameters
    ----------
    settings : EarSettings
        Places, axes, widths.
    call : CallSettings
        An impulse or a sweep.
    analysis : SpectrogramSettings
        Window, transform and frequencies.

    Returns
    -------
    ears : Ears
        At the analysis' frequencies.
    lag : (E, F, L, A) float32 or None, s
        How much too late each ear hears an echo, beam included; None for an impulse.
    """
    fine_frequency, rows, weight, later = smearing(call, analysis)
    fine = synthetic_ears(settings, fine_frequency)

    def smeared(table: NDArray[np.float64], weight: NDArray[Any]) -> NDArray[Any]:
        padded = np.moveaxis(table, -3, 0)
        parts = zip(weight.T[:, :, None, None], rows.T, strict=True)
        total = sum(np.moveaxis(padded[row], 0, -3) * part for part, row in parts)
        return np.asarray(total)

    beam, ears = fine.beam.astype(np.float64), fine.ears.astype(np.float64)
    lag: NDArray[np.float32] | None = None
    if later is None:
        beam, ears = np.abs(smeared(beam, weight)), np.abs(smeared(ears, weight))
    else:
        heard = (beam * ears) ** 2
        late = smeared(heard, later) / np.maximum(smeared(heard, weight), 1e-30)
        lag = late.astype(np.float32)
        beam, ears = np.sqrt(smeared(beam**2, weight)), np.sqrt(smeared(ears**2, weight))
    analysed = dataclasses.replace(
        fine,
        frequency=frequency_axis(analysis),
        beam=beam.astype(np.float32),
        ears=ears.astype(np.float32),
    )
    return analysed, lag


def _beam(
    directions: NDArray[np.float64], radius: float, frequency: NDArray[np.float64]
) -> NDArray[np.float64]:
    if radius == 0.0:
        return np.ones((len(frequency), *directions.shape[:2]))
    forward = directions[..., 0]
    sine = np.sqrt(np.clip(1.0 - forward**2, 0.0, None))
    x = (2.0 * np.pi * radius / SPEED) * frequency[:, None, None] * sine
    piston = np.abs(np.where(x > 1e-6, 2.0 * j1(x) / np.where(x > 1e-6, x, 1.0), 1.0))
    # An unbaffled source fades towards its back, smoothly.
    return piston * (1.0 + forward) / 2.0


def _lobe(
    directions: NDArray[np.float64],
    azimuth_deg: float,
    settings: EarSettings,
    frequency: NDArray[np.float64],
) -> NDArray[np.float64]:
    azimuth, elevation = np.radians(azimuth_deg), np.radians(settings.elevation_deg)
    axis = (
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    )
    angle = np.arccos(np.clip(directions @ np.asarray(axis), -1.0, 1.0))
    width = np.radians(settings.width_deg) * np.sqrt(WIDTH_FREQUENCY / frequency)
    gain: NDArray[np.float64] = np.exp(-0.5 * (angle / width[:, None, None]) ** 2)
    return gain


def beam_gain(ears: Ears, directions_head: NDArray[np.float64]) -> NDArray[np.float32]:
    """Gain of the emission towards directions, bilinear between the table's nodes.

    Parameters
    ----------
    ears : Ears
        Tables.
    directions_head : (N, 3) float64
        Unit vectors away from the emitter, head frame.

    Returns
    -------
    gain : (N, F) float32
        Linear, zero or more.
    """
    return _look_up(ears, 0, directions_head)


def ear_gain(ears: Ears, ear: int, directions_head: NDArray[np.float64]) -> NDArray[np.float32]:
    """Gain of one ear for sound from directions, bilinear between the table's nodes.

    Parameters
    ----------
    ears : Ears
        Tables.
    ear : int
        0 left, 1 right.
    directions_head : (N, 3) float64
        Unit vectors from the ear to where the sound comes from, head frame.

    Returns
    -------
    gain : (N, F) float32
        Linear, zero or more.
    """
    return _look_up(ears, 1 + ear, directions_head)


def _look_up(ears: Ears, table: int, directions: NDArray[np.float64]) -> NDArray[np.float32]:
    x, y, z = np.ascontiguousarray(directions.T, dtype=np.float32)
    column, across = _place(ears.azimuth, np.arctan2(y, x))
    row, upward = _place(ears.elevation, np.arctan2(z, np.hypot(x, y)))
    width = len(ears.azimuth)
    corner = row * width + column
    corners = corner[:, None] + np.array([0, 1, width, width + 1], dtype=np.int32)
    low = 1 - upward
    weights = np.zeros(corners.shape, dtype=np.float32)
    weights[:, 0], weights[:, 1] = low * (1 - across), low * across
    weights[:, 2], weights[:, 3] = upward * (1 - across), upward * across
    # One pass over the rows, where four gathers would write four tables first.
    ends = np.arange(0, 4 * len(directions) + 1, 4, dtype=np.int32)
    values = ears._by_direction[table]
    pick = csr_array((weights.ravel(), corners.ravel(), ends), shape=(len(directions), len(values)))
    gain: NDArray[np.float32] = pick @ values
    return gain


def _place(
    nodes: NDArray[np.float64], values: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Index of the node below, and the fraction of the way to the next."""
    per_step = np.float32((len(nodes) - 1) / (nodes[-1] - nodes[0]))
    steps = (values - np.float32(nodes[0])) * per_step
    steps = np.clip(steps, np.float32(0.0), np.float32(len(nodes) - 1))
    index = np.minimum(steps.astype(np.int32), np.int32(len(nodes) - 2))
    return index, steps - index.astype(np.float32)
