# SPDX-License-Identifier: MIT
"""How many calls proposed poses need for a surface, beside farthest and random ones."""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

import sononerf as sn
from sononerf import storage
from sononerf.errors import NumericalError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.numerics import Floats, Singles
from sononerf.scene.scene import load_scene
from sononerf.surface.next_poses import CANDIDATES
from tools.benchmarks.experiment import Row, aligned, append_line, ending, origin

WAYS = ("proposed", "farthest", "random")
FIRST = 12
"""Calls that all ways begin with, drawn at random."""
VALIDATION = 2
"""Further calls, drawn at random, that validate all surfaces."""
GROWTH = 1.15
"""Each fit has this many times the calls of the one before; with 1.4, ways that differ by a third
could look the same."""
RADIUS = 0.4
"""Distance of all poses from the origin, m: that of the default settings."""


def next_poses(arguments: argparse.Namespace) -> str:
    """Count the calls that proposed, farthest and random poses need; a line for each fit."""
    file = arguments.output / "next_poses.jsonl"
    storage.make_folder(file.parent)
    known: list[Row] = []
    if file.is_file():
        known = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    with ending(arguments.output):
        for name, seed in itertools.product(arguments.only, arguments.seeds):
            series = _Series(name, seed, arguments.score, arguments.most)
            for way in arguments.ways:
                if any(series.is_end(row) for row in known if _key(row) == (name, seed, way)):
                    continue
                for row in series.rows(way):  # a series that was interrupted begins again
                    append_line(file, storage.to_json(row))
                    known.append(row)
    return f"{table(known, arguments.score)}\nwrote {file}"


def _key(row: Row) -> tuple[str, int, str]:
    return row["name"], row["seed"], row["way"]


class _Series:
    """Fits of a scene from more and more calls; the first one is common to all ways."""

    def __init__(self, name: str, seed: int, score: float, most: int) -> None:
        kind, _, number = name.partition("-")
        self.scene = load_scene(kind, {"seed": int(number)} if number else {})
        self.head = sn.Head()
        self.named: Row = {"name": name, "seed": seed}
        self.score, self.most, self.seed = score, most, seed
        drawn = np.random.default_rng(seed).normal(size=(VALIDATION + most, 3))
        self.drawn: Floats = RADIUS * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
        self.first = sn.Poses.looking_at(self.drawn[: VALIDATION + FIRST])
        self.candidates = sn.Poses.looking_at(RADIUS * fibonacci_sphere(CANDIDATES))

    @cached_property
    def beginning(self) -> tuple[Singles, sn.Echoes, sn.Surface | None, Row]:
        """Return what the first poses hear, and the surface of it."""
        heard = self._heard(self.first)
        return (heard, *self._fitted(self.first, heard))

    def rows(self, way: str) -> Iterator[Row]:
        """Yield the line of each fit, until one has the F-score that is asked for."""
        poses = self.first
        heard, echoes, surface, scores = self.beginning
        while True:
            count = len(poses) - VALIDATION
            yield {**self.named, "way": way, "calls": count, **scores, **origin()}
            if self.is_end({"calls": count, **scores}):
                return
            more = self._more(way, surface, echoes, round(count * GROWTH) - count)
            heard = np.concatenate([heard, self._heard(more)])
            poses = sn.Poses(
                np.concatenate([poses.positions, more.positions]),
                np.concatenate([poses.rotations, more.rotations]),
            )
            echoes, surface, scores = self._fitted(poses, heard)

    def is_end(self, row: Row) -> bool:
        """Whether a series ends with this line."""
        return row["fscore_2mm"] >= self.score or round(row["calls"] * GROWTH) > self.most

    @cached_property
    def _everything(self) -> tuple[sn.Poses, sn.Echoes]:
        """Simulate all poses that can be asked for at once: the sources are found once."""
        poses = sn.Poses.looking_at(np.concatenate([self.candidates.positions, self.drawn]))
        split = ["train"] * len(poses)
        return poses, sn.simulate(self.scene, poses, self.head, split=split, workers=1)

    def _heard(self, poses: sn.Poses) -> Singles:
        known, echoes = self._everything
        far = np.linalg.norm(known.positions - poses.positions[:, None], axis=2)
        return np.stack([echoes.spectrogram(int(pose)) for pose in far.argmin(axis=1)])

    def _fitted(self, poses: sn.Poses, heard: Singles) -> tuple[sn.Echoes, sn.Surface | None, Row]:
        split = ["val"] * VALIDATION + ["train"] * (len(poses) - VALIDATION)
        echoes = sn.Echoes.from_arrays(heard, poses, self.head, split=split, calibrated=True)
        model = sn.EchoModule.for_echoes(echoes, options={"seed": self.seed})
        try:
            surface = sn.refine(sn.reconstruct(sn.fit(echoes, model), echoes), echoes)
        except NumericalError as error:  # few calls can give no surface
            return echoes, None, {"fscore_2mm": 0.0, "failed": str(error)}
        found = sn.evaluate(surface, self.scene)
        return echoes, surface, {f"fscore_{n}mm": found["fscore"][f"0.00{n}"] for n in (2, 5)}

    def _more(
        self, way: str, surface: sn.Surface | None, echoes: sn.Echoes, count: int
    ) -> sn.Poses:
        if way == "random":
            heard = len(echoes.positions)
            return sn.Poses.looking_at(self.drawn[heard : heard + count])
        if way == "proposed" and surface is not None:
            return sn.next_poses(surface, echoes, count, candidates=self.candidates)
        return self.candidates[farthest(echoes.positions, self.candidates.positions, count)]


def farthest(places: Floats, candidates: Floats, count: int) -> list[int]:
    """Return which candidates (N, 3) are, one after the other, the farthest from places (P, 3)."""
    gap = np.linalg.norm(candidates[:, None] - places, axis=2).min(axis=1)
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(candidates - candidates[chosen[-1]], axis=1))
    return chosen


def table(rows: Sequence[dict[str, Any]], score: float) -> str:
    """Return the mean number of calls of each way over the seeds; ``>`` where one fell short."""
    lines = [["scene", *WAYS]]
    for name in dict.fromkeys(row["name"] for row in rows):
        words = []
        for way in WAYS:
            last = [
                max((row for row in rows if _key(row) == key), key=lambda row: row["calls"])
                for key in sorted({_key(row) for row in rows})
                if key[::2] == (name, way)
            ]
            calls = [row["calls"] for row in last]
            reached = all(row["fscore_2mm"] >= score for row in last)
            words.append(f"{'' if reached else '> '}{np.mean(calls):.0f}" if calls else "-")
        lines.append([name, *words])
    return "\n".join(aligned(lines))
