# SPDX-License-Identifier: MIT
"""What makes a fit useless is told before it; a sound fit gets no warning."""

from __future__ import annotations

import numpy as np
import pytest

from sononerf.echoes.echoes import Echoes
from sononerf.geometry.poses import Poses
from sononerf.head.head import Head
from sononerf.run.fit_warnings import LINE, fit_warnings

BODY = np.array([[-0.035] * 3, [0.035] * 3])
"""Around the tiny experiment's sphere, m."""


@pytest.fixture(scope="module")
def heard(echoes):
    return Echoes.open(echoes)


def copied(heard, poses, rows):
    """Return echoes of some poses of an ensemble, said to be heard at other poses."""
    arrays = np.stack([heard.spectrogram(int(row)) for row in rows])
    return Echoes.from_arrays(arrays, poses, heard.head, split=["train"] * len(rows))


@pytest.mark.parametrize("is_set", [False, True])
def test_a_sound_fit_gets_no_warning(heard, is_set):
    assert fit_warnings(heard.within(BODY) if is_set else heard, BODY, is_set=is_set) == []


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (BODY + np.array([0.0, 0.0, 0.07]), "training poses hear echoes, and none from the region"),
        (BODY * 14.0, "poses lie inside the region"),
        (BODY * 4.0, "places of training poses are few for a region of 280 mm"),
        (BODY * 3.0 + np.array([0.0, 0.0, 1.5]), "no training pose hears 100 % of the region"),
    ],
)
def test_a_region_that_does_not_suit_the_echoes_is_told(heard, region, message):
    told = fit_warnings(heard.within(region), region, is_set=True)
    assert any(message in line for line in told), told


def test_repeated_poses_on_a_line_are_told(heard):
    rows = [0, 0, 0, 0, 1]
    told = fit_warnings(copied(heard, heard.poses()[rows], rows), BODY, is_set=False)
    assert told[0].startswith("only 2 of 5 training poses differ")
    assert LINE in told


def test_poses_that_look_away_are_told(heard):
    rows = np.arange(8)
    turned = heard.rotations[rows] @ np.diag([-1.0, -1.0, 1.0])
    poses = Poses(heard.positions[rows], turned)
    (told,) = fit_warnings(copied(heard, poses, rows), BODY, is_set=False)
    assert told.startswith("training poses look away from the body")
    assert "the poses look the other way" in told


def test_where_heads_look_makes_no_difference_to_omnidirectional_ones(heard):
    ears = {"directivity": "omnidirectional", "beam_radius": 0.0}
    head = Head.from_plain({**heard.head.plain(), "ears": ears})
    turned = heard.rotations @ np.diag([-1.0, -1.0, 1.0])
    arrays = np.stack([heard.spectrogram(row) for row in range(len(heard))])
    echoes = Echoes.from_arrays(arrays, Poses(heard.positions, turned), head)
    assert fit_warnings(echoes, BODY, is_set=False) == []


def test_a_body_below_its_support_is_told(heard):
    head = Head.from_plain({**heard.head.plain(), "support": {"point": [0.0, 0.0, 0.07]}})
    told = fit_warnings(Echoes(heard.store, head), BODY, is_set=False)
    assert any("from below the support" in line for line in told)
