# SPDX-License-Identifier: MIT
import dataclasses

import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.head.directivity.record import unit_vectors
from tests.head.directivity.patterns import FREQUENCY, pair


def test_unit_vectors_are_of_the_head_frame():
    wanted = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    angles = np.radians([[0.0, 90.0, 0.0], [0.0, 0.0, 90.0]])
    np.testing.assert_allclose(unit_vectors(*angles), wanted, atol=1e-12)


def test_frequencies_outside_the_file_are_those_at_its_ends():
    known = pair()
    wanted = np.array([1e3, 30e3, 40e3, 80e3, 200e3])
    low, first, middle, last, high = np.moveaxis(known.at(wanted, known.gains), -1, 0)
    np.testing.assert_array_equal(low, first)
    np.testing.assert_array_equal(high, last)
    np.testing.assert_allclose(middle, known.gains[..., :2].mean(axis=-1))


def test_one_frequency_serves_all():
    known = pair()
    alone = dataclasses.replace(
        known, frequency=FREQUENCY[:1], gains=known.gains[..., :1], beam=None
    )
    found = alone.at(np.array([1.0, 1e5]), alone.gains)
    np.testing.assert_array_equal(found[..., 0], found[..., 1])


def spoilt(values, value):
    changed = values.copy()
    changed.flat[0] = value
    return changed


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (lambda d: {"gains": spoilt(d.gains, np.nan)}, "the gains hold NaN"),
        (lambda d: {"gains": spoilt(d.gains, -0.5)}, "the gains hold the negative value -0.5"),
        (lambda d: {"beam": spoilt(d.beam, -1.0)}, "emitter's gains hold the negative value"),
        (lambda d: {"gains": 0 * d.gains}, "the gains are all zero"),
        (lambda d: {"gains": d.gains[:, 1:]}, r"shape \(322, 3\), expected \(323, 3\)"),
        (lambda d: {"gains": d.gains[:0]}, "holds 0 receivers"),
        (lambda d: {"frequency": d.frequency[::-1]}, "do not ascend"),
        (lambda d: {"frequency": spoilt(d.frequency, np.inf)}, "frequencies hold NaN or infinite"),
        (lambda d: {"directions": 2 * d.directions}, "no unit vector"),
        (lambda d: {"places": d.places[:1]}, "states 1 places of 2 receivers"),
    ],
)
def test_what_is_not_allowed_is_refused(changes, said):
    known = pair()
    with pytest.raises(InputError, match=f"^made up: .*{said}"):
        dataclasses.replace(known, **changes(known))
