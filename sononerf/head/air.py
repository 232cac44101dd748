# SPDX-License-Identifier: MIT
"""Still air: how fast sound is, and what the air takes of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sononerf.numerics import Floats
from sononerf.settings.schema import AirSettings

DEFAULT_SPEED = 343.0  # m/s
DEFAULT_TEMPERATURE = 20.0  # °C, for absorption where only the speed is fixed
LOWEST_OVER_PRESSURE = 4e-4  # Hz/Pa, of ISO 9613-1
REFERENCE_PRESSURE = 101_325.0  # Pa
REFERENCE_TEMPERATURE = 293.15  # K
TRIPLE_POINT = 273.16  # K


def speed_of_sound(temperature_c: float) -> float:
    """Speed of sound in air.

    In: temperature_c (°C). Out: speed (m/s).

    Examples:
        >>> round(speed_of_sound(20.0), 1)
        343.2
    """
    return float(343.2 * np.sqrt((temperature_c + 273.15) / REFERENCE_TEMPERATURE))


def speed_in(air: AirSettings) -> float:
    """Return the speed of sound (m/s) that settings give: set, of the temperature, or 343."""
    if air.speed_of_sound is not None:
        return air.speed_of_sound
    return DEFAULT_SPEED if air.temperature_c is None else speed_of_sound(air.temperature_c)


def absorption_in(air: AirSettings, frequency: ArrayLike) -> Floats:
    """Return the absorption (F,), dB/m, of the air that settings describe, at (F,) Hz.

    Below the lowest frequency of the standard it is that of the lowest frequency.
    """
    return air_absorption(
        np.maximum(frequency, LOWEST_OVER_PRESSURE * air.pressure_pa),
        temperature_c=DEFAULT_TEMPERATURE if air.temperature_c is None else air.temperature_c,
        relative_humidity=air.relative_humidity,
        pressure=air.pressure_pa,
    )


def air_absorption(
    frequency: ArrayLike,
    *,
    temperature_c: float = 20.0,
    relative_humidity: float,
    pressure: float = REFERENCE_PRESSURE,
) -> Floats:
    r"""Attenuation of a pure tone by still air, in decibels per metre.

    .. math:: \alpha(f) = 8.686 f^2 \left[ A_\mathrm{cl} + A_\mathrm{O} + A_\mathrm{N} \right]

    A bat hears the echo after a *two-way* path: multiply by ``2 * range``.

    In: frequency ((...,), Hz), temperature_c (°C), relative_humidity (1), pressure (Pa). Out:
    absorption ((...,), dB/m).

    References:
        .. [1] ISO 9613-1:1993, equations (3) to (5), (B.1) to (B.3).

    Examples:
        >>> frequency = [20e3, 50e3, 100e3]
        >>> absorption = air_absorption(frequency, temperature_c=20.0, relative_humidity=0.5)
        >>> [round(float(value), 3) for value in absorption]
        [0.524, 1.661, 3.28]
    """
    f = np.asarray(frequency, dtype=np.float64)
    if not -20.0 <= temperature_c <= 50.0:
        raise ValueError(f"temperature_c is {temperature_c}, expected -20 to 50")
    if not 0.0 <= relative_humidity <= 1.0:
        raise ValueError(f"relative_humidity is {relative_humidity}, expected 0 to 1")
    if not ((f / pressure >= 4e-4) & (f / pressure <= 10.0)).all():
        raise ValueError(f"frequency / pressure lies outside 4e-4 to 10 Hz/Pa at {pressure} Pa")
    kelvin = temperature_c + 273.15
    t = kelvin / REFERENCE_TEMPERATURE
    p = pressure / REFERENCE_PRESSURE
    saturation = 10.0 ** (-6.8346 * (TRIPLE_POINT / kelvin) ** 1.261 + 4.6151)  # (B.2), (B.3)
    h = 100.0 * relative_humidity * saturation / p  # molar concentration of water in %, (B.1)
    oxygen = p * (24.0 + 4.04e4 * h * (0.02 + h) / (0.391 + h))  # Hz, (3)
    nitrogen = p * t**-0.5 * (9.0 + 280.0 * h * np.exp(-4.170 * (t ** (-1.0 / 3.0) - 1.0)))  # (4)
    classical = 1.84e-11 / p * np.sqrt(t)
    of_oxygen = 0.01275 * np.exp(-2239.1 / kelvin) / (oxygen + f**2 / oxygen)
    of_nitrogen = 0.1068 * np.exp(-3352.0 / kelvin) / (nitrogen + f**2 / nitrogen)
    return (
        8.686 * f**2 * (classical + t**-2.5 * (of_oxygen + of_nitrogen))  # (5)
    )
