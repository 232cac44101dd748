# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.head.air import air_absorption, speed_of_sound


@pytest.mark.parametrize(
    ("temperature_c", "relative_humidity", "band", "per_kilometre"),
    [
        # ISO 9613-1:1993, table 1, dB/km, at exact mid-band frequencies 1000 * 10**(band / 10).
        (10.0, 0.70, 0, 3.66e0),
        (20.0, 0.70, 0, 4.98e0),
        (20.0, 0.10, 7, 1.33e2),
        (15.0, 0.20, 3, 2.82e1),  # also ISO 9613-2:1996, table 2
        (10.0, 0.70, 9, 1.17e2),
    ],
)
def test_rows_of_the_standard(temperature_c, relative_humidity, band, per_kilometre):
    found = air_absorption(
        1000.0 * 10.0 ** (band / 10.0),
        temperature_c=temperature_c,
        relative_humidity=relative_humidity,
    )
    assert 1000.0 * found == pytest.approx(per_kilometre, rel=5e-3)


def test_ultrasound_as_computed_by_pyfar():
    found = air_absorption([20e3, 50e3, 100e3], temperature_c=20.0, relative_humidity=0.5)
    np.testing.assert_allclose(found, [0.524, 1.661, 3.280], atol=6e-4)


def test_pressure_divides_the_relaxation_frequencies():
    # Everything in the standard depends on f / p and on the molar share of water.
    low = air_absorption(20e3, temperature_c=20.0, relative_humidity=0.25, pressure=101_325.0 / 2)
    high = air_absorption(40e3, temperature_c=20.0, relative_humidity=0.5)
    assert low == pytest.approx(high / 2, rel=1e-9)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"temperature_c": 50.1}, "temperature_c"),
        ({"temperature_c": -20.1}, "temperature_c"),
        ({"relative_humidity": 1.01}, "relative_humidity"),
        ({"relative_humidity": -0.01}, "relative_humidity"),
        ({"frequency": 1.1e6}, "frequency / pressure"),
        ({"frequency": 10.0}, "frequency / pressure"),
        ({"frequency": float("nan")}, "frequency / pressure"),
    ],
)
def test_outside_the_standard_is_refused(arguments, match):
    good = {"frequency": 50e3, "temperature_c": 20.0, "relative_humidity": 0.5}
    with pytest.raises(ValueError, match=match):
        air_absorption(**{**good, **arguments})


@pytest.mark.parametrize(
    ("temperature_c", "expected"), [(0.0, 331.3), (20.0, 343.2), (35.0, 351.9)]
)
def test_speed_of_sound(temperature_c, expected):
    assert speed_of_sound(temperature_c) == pytest.approx(expected, abs=0.06)
