# SPDX-License-Identifier: MIT
"""The emitter's beam and the receivers as tables over direction and frequency; models of both.

Head frame: x forward, y left, z up. Azimuth counts from straight ahead, positive to the left;
elevation is positive up. Of two ears, ear 0 is the left one.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.special import j1

from sononerf.errors import InputError, SettingsError
from sononerf.head.directivity import Directivity, unit_vectors
from sononerf.head.directivity_files import content_hash, read_directivity
from sononerf.head.front_end import frequency_axis, smearing
from sononerf.numerics import Floats, Singles, compiled
from sononerf.settings.schema import CallSettings, EarSettings, SpectrogramSettings

SPEED = 343.0  # m/s; the beam's width hardly depends on it, so temperature is ignored
WIDTH_FREQUENCY = 50e3  # Hz, at which an ear has the width of its setting
NOTCH_MIDDLE = 60e3  # Hz, at elevation 0
NOTCH_RISE = 30e3  # Hz, from elevation 0 to straight up
NOTCH_WIDTH = 8e3  # Hz, standard deviation


def piston(directions: Floats, radius: float, frequency: Floats) -> Floats:
    r"""Gain of a piston in a small head that looks ahead.

    .. math:: |2 J_1(ka \sin\theta) / (ka \sin\theta)| (1 + \cos\theta) / 2

    with the radius a. The first factor is a circular piston in an infinite baffle [1]_; the second
    makes it fade towards its back, as a source without a baffle does.

    In: directions (L, A, 3), radius (m), frequency ((F,), Hz). Out: gain (F, L, A).

    References:
        .. [1] L. L. Beranek, T. J. Mellow, Acoustics: Sound Fields and Transducers, 2012, 13.7.
    """
    if radius == 0.0:
        return np.ones((len(frequency), *directions.shape[:2]))
    forward = directions[..., 0]
    sine = np.sqrt(np.clip(1.0 - forward**2, 0.0, None))
    x = (2.0 * np.pi * radius / SPEED) * frequency[:, None, None] * sine
    baffled = np.abs(np.where(x > 1e-6, 2.0 * j1(x) / np.where(x > 1e-6, x, 1.0), 1.0))
    return np.asarray(baffled * (1.0 + forward) / 2.0)


def ear(directions: Floats, side: float, settings: EarSettings, frequency: Floats) -> Floats:
    """Gain of a synthetic, bat-like ear.

    Its gain is a Gaussian of the angle from its axis. The width falls with the square root of
    frequency (``width_deg`` at 50 kHz). A spectral notch rises from 30 kHz (straight
    down) over 60 kHz to 90 kHz (straight up), so that the spectrum depends on elevation.

    In: directions (L, A, 3), frequency ((F,), Hz). Out: gain (F, L, A).
    """
    azimuth, elevation = np.radians(side * settings.azimuth_deg), np.radians(settings.elevation_deg)
    axis = (
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    )
    angle = np.arccos(np.clip(directions @ np.asarray(axis), -1.0, 1.0))
    width = np.radians(settings.width_deg) * np.sqrt(WIDTH_FREQUENCY / frequency)
    gain = np.exp(-0.5 * (angle / width[:, None, None]) ** 2)
    heights = np.arcsin(np.clip(directions[:, 0, 2], -1.0, 1.0))
    notch_at = NOTCH_MIDDLE + NOTCH_RISE * heights / (np.pi / 2.0)
    off = (frequency[:, None] - notch_at) / NOTCH_WIDTH  # (F, L)
    notch = 1.0 - settings.notch_depth * np.exp(-0.5 * off**2)
    return np.asarray(gain * notch[:, :, None])


GRID_DEG = 2.0


@dataclass(frozen=True, eq=False)
class Ears:
    """Real, non-negative gains of the beam and of each receiver, and their places."""

    azimuth: Floats  # (A,), rad: Uniform from -pi to pi, both included
    elevation: Floats  # (L,), rad: Uniform from -pi/2 to pi/2, both included
    frequency: Floats  # (F,), Hz: Ascending
    beam: Singles  # (F, L, A) float32: Gain of the emission
    # (E, F, L, A) float32: Gain of each receiver; all of them may share one table in memory
    ears: Singles
    emitter: Floats  # (3,), m: Head frame
    positions: Floats  # (E, 3), m: Places of the receivers, head frame

    def __post_init__(self) -> None:
        grid = (len(self.frequency), len(self.elevation), len(self.azimuth))
        if self.beam.shape != grid or self.ears.shape != (len(self.positions), *grid):
            raise ValueError(
                f"beam {self.beam.shape} and ears {self.ears.shape} do not fit the grid {grid} "
                f"of {len(self.positions)} receivers"
            )

    @property
    def directions(self) -> Floats:
        """Unit vectors of the grid, (L, A, 3)."""
        return unit_vectors(self.azimuth, self.elevation[:, None])

    @property
    def alike(self) -> bool:
        """Whether all receivers share one table in memory."""
        return len(self.ears) == 1 or self.ears.strides[0] == 0

    def cone(self, least: float) -> float:
        """Return the cosine to the head's axis down to which every direction has a gain."""
        gain = (self.beam * self.ears.max(axis=0)).max(axis=0).astype(np.float64)
        deaf = self.directions[..., 0][gain < least * gain.max()]
        return float(deaf.max()) if len(deaf) else -1.0

    def directivity(self, source: str = "settings") -> Directivity:
        """Return these tables as a directivity, both ends of the azimuth axis once."""

        def rows(table: Singles) -> Floats:
            part = table[..., :-1].astype(np.float64)
            return np.moveaxis(part.reshape(*part.shape[:-2], -1), -1, -2)

        directions = self.directions[:, :-1].reshape(-1, 3)
        gains, beam = rows(self.ears), rows(self.beam)
        return Directivity(source, directions, self.frequency, gains, beam, self.positions)

    @cached_property
    def _by_direction(self) -> Singles:
        """Beam, then ears, with frequency last: (1 + E, L A, F); one look-up is one row."""
        tables = np.concatenate([self.beam[None], self.ears])
        flat = tables.reshape(*tables.shape[:2], -1).transpose(0, 2, 1)
        return np.ascontiguousarray(flat, dtype=np.float32)


def ear_tables(settings: EarSettings, frequency: ArrayLike) -> Ears:
    """Tables of the emitter and of the receivers that settings describe.

    In: frequency ((F,), Hz).
    """
    f = np.asarray(frequency, dtype=np.float64)
    measured = _measured(settings)
    places, sides = _places(settings, measured)
    azimuth, elevation, directions = _grid()
    beam = None
    if measured is not None:
        tables, beam = _measured_tables(measured, f)
    elif settings.directivity == "ear":
        lobes = {side: ear(directions, side, settings, f) for side in set(sides)}
        tables = np.stack([lobes[side].astype(np.float32) for side in sides])
    else:
        radius = settings.piston_radius if settings.directivity == "piston" else 0.0
        tables = piston(directions, radius, f).astype(np.float32)[None]
    if beam is None:
        beam = piston(directions, settings.beam_radius, f).astype(np.float32)
    if len(tables) == 1:  # one table for all, however many they are
        tables = np.broadcast_to(tables, (len(places), *tables.shape[1:]))
    emitter = np.asarray(settings.emitter, dtype=np.float64)
    return Ears(azimuth, elevation, f, beam, tables, emitter, places)


def receiver_places(settings: EarSettings) -> Floats:
    """Return the places (E, 3) of the receivers, m, head frame; raises as :func:`ear_tables`."""
    return _places(settings, _measured(settings))[0]


def directivity_content(settings: EarSettings) -> str | None:
    """Return a hash of the directivity's file, None if there is none."""
    return None if settings.file is None else content_hash(settings.file)


@lru_cache(maxsize=1)
def _grid() -> tuple[Floats, Floats, Floats]:
    """Return azimuths (A,), elevations (L,) and directions (L, A, 3) of the tables."""
    azimuth = np.radians(np.linspace(-180.0, 180.0, round(360.0 / GRID_DEG) + 1))
    elevation = np.radians(np.linspace(-90.0, 90.0, round(180.0 / GRID_DEG) + 1))
    return azimuth, elevation, unit_vectors(azimuth, elevation[:, None])


@lru_cache(maxsize=4)
def _grid_weights(measured: Directivity) -> csr_array:
    return measured.weights(_grid()[2].reshape(-1, 3))


def _measured(settings: EarSettings) -> Directivity | None:
    return None if settings.file is None else read_directivity(settings.file)


def _places(settings: EarSettings, measured: Directivity | None) -> tuple[Floats, list[float]]:
    """Return places (E, 3) of the receivers, and the axes of synthetic ears there."""
    left = np.asarray(settings.left, dtype=np.float64)
    if settings.receivers is not None:
        places = np.asarray(settings.receivers, dtype=np.float64)
        if measured is not None and len(measured.gains) not in (1, len(places)):
            raise SettingsError(
                f"ears.receivers: gives {len(places)} places, but {settings.file} holds "
                f"{len(measured.gains)} receivers; give as many places, or leave them out"
            )
        return places, np.sign(places[:, 1]).tolist()
    if measured is not None and measured.places is not None:
        return measured.places, []
    if measured is not None and len(measured.gains) != 2:
        raise SettingsError(
            f"ears.receivers: missing; {settings.file} does not state the places of its "
            f"{len(measured.gains)} receiver{'s' * (len(measured.gains) > 1)}"
        )
    sides = [1.0, -1.0]
    return np.stack([left * (1.0, side, 1.0) for side in sides]), sides


def _measured_tables(measured: Directivity, frequency: Floats) -> tuple[Singles, Singles | None]:
    """Return tables (E, F, L, A) and the beam (F, L, A) of a measured directivity."""
    weights, shape = _grid_weights(measured), (len(frequency), *_grid()[2].shape[:2])

    def table(values: Floats) -> Singles:
        at_grid = weights @ measured.at(frequency, values)  # (L A, F)
        return np.ascontiguousarray(at_grid.T, dtype=np.float32).reshape(shape)

    ears = np.stack([table(gain) for gain in measured.gains])
    return ears, None if measured.beam is None else table(measured.beam)


def analysed_ears(
    settings: EarSettings, call: CallSettings, spectrogram: SpectrogramSettings
) -> tuple[Ears, Singles | None]:
    r"""Gains that the rows of a spectrogram measure: smeared over frequency by its window.

    A window of 64 µs does not resolve frequencies closer than about 28 kHz. It fills a
    narrow notch, and the spectrum of an echo in its middle is that of beam and ear convolved with
    the window's transform. Beam and ear are smeared one by one: the beam varies slowly.

    A sweep's frequencies enter the window one after the other. With :math:`G` the gain,
    :math:`X` the call's spectrum, :math:`\tau` its delays and :math:`W` the window's transform,
    a row at :math:`f` measures, by Parseval's theorem, this mean power, delayed on average by this
    time

    .. math::
        \overline{G}(f)^2 = \frac{\sum_\nu w_\nu G(\nu)^2}{\sum_\nu w_\nu}, \qquad
        \overline{t}(f) = \frac{\sum_\nu w_\nu G(\nu)^2 (\tau(\nu) - \tau(f))}
        {\sum_\nu w_\nu G(\nu)^2}, \qquad w_\nu = W(\nu - f)^2 |X(\nu)|^2

    so that beside a notch an echo seems to come from millimetres nearer or farther.

    Out: lag ((E, F, L, A) float32 or None, s).
    """
    measured = _measured(settings)
    if measured is not None and len(measured.frequency) > 1:
        lowest, highest = measured.frequency[[0, -1]]
        if highest < spectrogram.frequency_min or lowest > spectrogram.frequency_max:
            raise InputError(
                f"{measured.source}: is measured from {lowest:.4g} to {highest:.4g} Hz, and the "
                f"spectrograms have {spectrogram.frequency_min:.4g} to "
                f"{spectrogram.frequency_max:.4g} Hz; check the unit of its frequencies"
            )
    return _analysed(settings, call, spectrogram, directivity_content(settings))


@lru_cache(maxsize=4)  # a fit and its read-out call this nine times; the arrays must not be changed
def _analysed(
    settings: EarSettings, call: CallSettings, spectrogram: SpectrogramSettings, content: str | None
) -> tuple[Ears, Singles | None]:
    del content  # a changed file is read again
    fine_frequency, rows, weight, later = smearing(call, spectrogram)
    fine = ear_tables(settings, fine_frequency)

    def smeared(table: Floats, weight: NDArray[Any]) -> NDArray[Any]:
        padded = np.moveaxis(table, -3, 0)
        parts = zip(weight.T[:, :, None, None], rows.T, strict=True)
        total = sum(np.moveaxis(padded[row], 0, -3) * part for part, row in parts)
        return np.asarray(total)

    beam = fine.beam.astype(np.float64)
    lags: list[Singles] = []
    ears: list[Singles] = []
    for single in fine.ears[:1] if fine.alike else fine.ears:  # one by one, to save memory
        ear = single.astype(np.float64)
        if later is None:
            ears.append(np.abs(smeared(ear, weight)).astype(np.float32))
            continue
        heard = (beam * ear) ** 2
        late = smeared(heard, later) / np.maximum(smeared(heard, weight), 1e-30)
        lags.append(late.astype(np.float32))
        ears.append(np.sqrt(smeared(ear**2, weight)).astype(np.float32))
    if later is None:
        beam = np.abs(smeared(beam, weight))
    else:
        beam = np.sqrt(smeared(beam**2, weight))

    def of_all(tables: list[Singles]) -> Singles:
        stacked = tables[0][None] if fine.alike else np.stack(tables)
        return np.broadcast_to(stacked, (len(fine.positions), *stacked.shape[1:]))

    analysed = dataclasses.replace(
        fine, frequency=frequency_axis(spectrogram), beam=beam.astype(np.float32), ears=of_all(ears)
    )
    return analysed, of_all(lags) if lags else None


def beam_gain(ears: Ears, directions_head: Floats) -> Singles:
    """Gain of the emission towards directions, bilinear between the table's nodes.

    In: directions_head (N, 3). Out: gain ((N, F) float32).
    """
    return _look_up(ears, 0, directions_head)


def ear_gain(ears: Ears, ear: int, directions_head: Floats) -> Singles:
    """Gain of one ear for sound from directions, bilinear between the table's nodes.

    In: directions_head (N, 3). Out: gain ((N, F) float32).
    """
    return _look_up(ears, 1 + ear, directions_head)


def _look_up(ears: Ears, table: int, directions: Floats) -> Singles:
    upward, across = ears.elevation, ears.azimuth
    return _bilinear(
        np.ascontiguousarray(ears._by_direction[table]),
        np.ascontiguousarray(directions, dtype=np.float64),
        (float(upward[0]), (len(upward) - 1) / float(upward[-1] - upward[0]), len(upward)),
        (float(across[0]), (len(across) - 1) / float(across[-1] - across[0]), len(across)),
    )


@compiled
def _bilinear(
    values: Singles,
    directions: Floats,
    elevation: tuple[float, float, int],
    azimuth: tuple[float, float, int],
) -> Singles:
    """Read a table (D, F) of directions on a grid towards others (N, 3).

    In: values (D, F), directions (N, 3).
    """
    width, frequencies = azimuth[2], values.shape[1]
    gain = np.zeros((len(directions), frequencies), np.float32)
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        up = (math.atan2(z, math.sqrt(x * x + y * y)) - elevation[0]) * elevation[1]
        along = (math.atan2(y, x) - azimuth[0]) * azimuth[1]
        up, along = min(max(up, 0.0), elevation[2] - 1.0), min(max(along, 0.0), width - 1.0)
        row, column = min(int(up), elevation[2] - 2), min(int(along), width - 2)
        up, along = up - row, along - column
        a, b = np.float32((1.0 - up) * (1.0 - along)), np.float32((1.0 - up) * along)
        c, d = np.float32(up * (1.0 - along)), np.float32(up * along)
        one = values[row * width + column]
        two = values[row * width + column + 1]
        three = values[(row + 1) * width + column]
        four = values[(row + 1) * width + column + 1]
        for k in range(frequencies):
            gain[i, k] = a * one[k] + b * two[k] + c * three[k] + d * four[k]
    return gain
