# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np

from tools.benchmarks.next_poses import farthest, table


def test_the_farthest_is_far_from_all_before():
    places = np.array([[0.0, 0, 0]])
    candidates = np.array([[1.0, 0, 0], [9, 0, 0], [8, 0, 0], [4, 0, 0]])
    assert farthest(places, candidates, 3) == [1, 3, 0]


def test_the_table_has_the_mean_of_the_seeds_and_says_where_one_fell_short():
    def row(seed, way, calls, score):
        return {"name": "cone", "seed": seed, "way": way, "calls": calls, "fscore_2mm": score}

    rows = [row(0, "proposed", 12, 0.5), row(0, "proposed", 17, 0.92), row(0, "random", 17, 0.6)]
    rows += [row(1, "proposed", 24, 0.95), row(1, "proposed", 17, 0.7), row(1, "random", 24, 0.95)]
    assert table(rows, 0.9).split() == "scene proposed farthest random cone 20 - > 20".split()
