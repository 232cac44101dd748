# SPDX-License-Identifier: MIT
"""Settings of an import are checked like all others: one line per fault."""

from __future__ import annotations

import pytest

from sononerf.errors import SettingsError
from sononerf.settings.import_schema import read_import_settings

MIRROR = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]


def test_units_have_no_default():
    settings = read_import_settings({}, "a.yaml")
    assert (settings.length, settings.angle, settings.quaternion) == (None, None, None)


def test_what_belongs_together_is_taken():
    settings = read_import_settings(
        {"frame": "own", "axes": MIRROR, "length": "mm", "channels": [0, [1, 2]]}, "a.yaml"
    )
    assert settings.axes == ((1, 0, 0), (0, -1, 0), (0, 0, 1))
    assert settings.channels == (0, (1, 2))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"lenght": "mm"}, "import.lenght: unknown key; did you mean length?"),
        ({"length": "inch"}, "import.length"),
        ({"frame": "own"}, "axes and frame=own go together"),
        ({"axes": MIRROR}, "axes and frame=own go together"),
        ({"head_axes": MIRROR}, "head_axes is of frame=own"),
        ({"turntable": {}}, "import.turntable.radius: missing"),
        ({"channels": [-1]}, "import.channels"),
        ("poses.csv", "expected `key: value` lines"),
    ],
)
def test_a_fault_is_one_line(given, words):
    with pytest.raises(SettingsError) as caught:
        read_import_settings(given, "a.yaml")
    assert words in str(caught.value)
    assert str(caught.value).startswith("a.yaml: ")
