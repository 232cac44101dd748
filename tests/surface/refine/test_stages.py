# SPDX-License-Identifier: MIT
from __future__ import annotations

from itertools import pairwise

from sononerf.surface.refine.descent import SHARP, STAGES


def test_stages_go_from_coarse_to_fine():
    for before, after in pairwise(STAGES):
        assert after.smoothing <= before.smoothing
        assert after.edge <= before.edge
        assert after.blur <= before.blur
        assert after.rate <= before.rate
    assert STAGES[-1].blur == 0.0
    assert min(stage.edge for stage in STAGES) >= SHARP


def test_only_the_last_stage_is_corrected_by_the_simulator():
    assert [stage.beyond == "simulate" for stage in STAGES].index(True) == len(STAGES) - 1


def test_what_is_kept_was_traced_before():
    seen = False
    for stage in STAGES:
        seen = seen or stage.beyond == "trace"
        assert seen or stage.beyond != "keep"
