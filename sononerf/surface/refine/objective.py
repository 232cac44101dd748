# SPDX-License-Identifier: MIT
"""Error between rendered and measured spectrograms, and the learned level."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.free_space import EchoHull
from sononerf.geometry.directions import usual_gap
from sononerf.head.decibels import ACTIVE_DB
from sononerf.surface.refine.optics import Heard

FLOOR_DB = 20.0
"""Level below a pose's loudest cell down to which cells count, dB; fainter cells are later
bounces."""
CORRECTED_FLOOR_DB = 30.0
"""FLOOR_DB where the simulator adds what physical optics lacks, such as later bounces, dB."""
ALIKE_DB = 3.0
"""Difference between simulator and physical optics at which a cell has half the weight, dB."""
LOUD_DB = 16.0
"""Level below a pose's loudest cell down to which cells determine the gain, dB."""
LEARNING = 0.05
"""Weight of one step in the running means of gain and error, no unit."""
TRUST = 4.0
"""Exponent of a frequency's usual error, by whose inverse power the frequency is weighted. Where
physical optics is wrong (ka below 10) the error stays large, and even a little of it biases the
surface."""
_DB = 20.0 / math.log(10.0)


class Level:
    """Running estimates on the training poses: gain, and error per ear and frequency.

    Attributes:
        gain ((E, F) float32): Logarithm of measured over rendered magnitude.
        error ((E, F) float32, dB): Mean error over active cells.
        steps: Number of updates.
        learns: Whether there is no gain, or one for each ear and frequency.
    """

    def __init__(self, ears: int, rows: int, like: Tensor) -> None:
        self.gain = torch.zeros(ears, rows, device=like.device)
        self.error = torch.full((ears, rows), 4.0, device=like.device)
        self.steps = 0
        self.learns: Literal["none", "each"] = "each"

    def reset(self) -> None:
        """Reset all estimates."""
        self.gain, self.error = torch.zeros_like(self.gain), torch.full_like(self.error, 4.0)
        self.steps = 0

    def state(self) -> dict[str, Tensor]:
        """Return the state as plain tensors."""
        return {"gain": self.gain, "error": self.error, "steps": torch.tensor(self.steps)}

    def load(self, state: dict[str, Tensor]) -> None:
        """Load a state."""
        self.gain, self.error = state["gain"].to(self.gain), state["error"].to(self.error)
        self.steps = int(state["steps"])

    @property
    def weight(self) -> Tensor:
        """Weight of ears and frequencies (E, F), falling with their usual error."""
        weight = self.error.clamp_min(0.25 * float(self.error.median())) ** -TRUST
        return weight / weight.mean()


def measured(echoes: Echoes, numbers: list[int], heard: Heard) -> tuple[Tensor, Tensor, Tensor]:
    """Return the measurement of poses on the rendered rows.

    Out: magnitude ((P, E, W, F) float32), inside (P, 1, W, 1), loudest ((P,) float32).
    """
    wholes = [echoes.magnitude(number) for number in numbers]
    width, count = heard.power.shape[2], wholes[0].shape[1]
    place = heard.row[:, None] + torch.arange(width, device=heard.row.device)
    inside = (place >= 0) & (place < count)
    loudest = torch.stack([whole.max() for whole in wholes])
    like = heard.power
    return (
        on_rows(wholes, heard.row, like),
        inside[:, None, :, None].to(like.device),
        loudest.to(like.device),
    )


def differences(
    heard: Heard,
    later: Tensor | None,
    found: tuple[Tensor, Tensor, Tensor],
    level: Level,
    *,
    corrected: tuple[Tensor, Tensor] | None = None,
    learn: bool,
    band: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Return the measured levels less the rendered ones, by cells.

    In: later ((P, E, W, F) float32), corrected (simulated, rendered, both (P, E, W, F) float32).
    Out: difference ((P, E, W, F) float32, reported dB), weight (P, E, W, F).
    """
    magnitude, inside, loudest = found
    power = heard.power if later is None else heard.power + later
    if band:
        gained = level.gain.mul(2.0).exp()[:, None]
        power = over_band(power * gained, band) / gained
        magnitude = over_band(magnitude.square(), band).sqrt()
    tiny = (1e-6 * loudest.clamp_min(1e-30)).square()[:, None, None, None]
    gain = level.gain.exp()[:, None]
    rendered = torch.sqrt(power + tiny) * gain
    floor = FLOOR_DB if corrected is None else CORRECTED_FLOOR_DB
    reference = (loudest * 10.0 ** (-floor / 20.0)).clamp_min(1e-30)[:, None, None, None]
    a = _DB * torch.log1p(magnitude / reference)
    b = _DB * torch.log1p(rendered / reference)
    weight = level.weight[:, None]
    if corrected is not None:
        simulated, before = (_DB * torch.log1p(gain * part / reference) for part in corrected)
        b = b + (simulated - before)
        weight = 1.0 / (1.0 + (simulated - before).abs() / ALIKE_DB)
        rendered = reference * torch.expm1(b.detach().clamp_min(0.0) / _DB)
    with torch.no_grad():
        active = inside & ((a >= ACTIVE_DB) | (b >= ACTIVE_DB))
        if learn:
            _learn(level, magnitude, rendered, a, b, active, loudest)
        weight = active * weight
        weight = weight / weight.sum((1, 2, 3), keepdim=True).clamp_min(1e-12)
    return a - b, weight


def mismatch(difference: Tensor, weight: Tensor) -> Tensor:
    """Return the mean absolute difference over each pose's active cells, (P,) reported dB."""
    return (difference.abs() * weight).sum((1, 2, 3))


def over_band(power: Tensor, part: float) -> Tensor:
    """Return power (P, E, W, F), averaged over a fraction of the frequencies around each."""
    half = round(part * power.shape[3]) // 2
    if not half:
        return power
    rows = nn.functional.pad(power.flatten(0, 1), (half, half), mode="replicate")
    return nn.functional.avg_pool1d(rows, 2 * half + 1, 1).unflatten(0, power.shape[:2])


def _learn(
    level: Level,
    magnitude: Tensor,
    rendered: Tensor,
    a: Tensor,
    b: Tensor,
    active: Tensor,
    loudest: Tensor,
) -> None:
    rate = max(LEARNING, 1.0 / (level.steps + 2))
    level.steps += 1
    count = active.sum((0, 2))
    error = ((a - b).abs() * active).sum((0, 2)) / count.clamp_min(1)
    some = count > 0
    level.error = torch.where(some, level.error.lerp(error, rate), level.error)
    if level.learns == "none":
        return
    least = (loudest * 10.0 ** (-LOUD_DB / 20.0))[:, None, None, None]
    loud = (magnitude > least) & (rendered > 0.5 * least)
    ratio = torch.log(magnitude.clamp_min(1e-30) / rendered.clamp_min(1e-30))
    ratio = torch.where(loud, ratio, torch.nan)
    step = ratio.movedim(1, 0).movedim(3, 1).flatten(2).nanmedian(dim=2).values
    level.gain = level.gain + rate * torch.nan_to_num(step)


def on_rows(wholes: list[Tensor], row: Tensor, like: Tensor) -> Tensor:
    """Return range slices of whole spectrograms, from given first rows on.

    In: wholes (list of (E, R, F) float32), row (P,), like ((P, E, W, F) Tensor). Out: parts ((P, E,
    W, F) float32).
    """
    width = like.shape[2]
    parts = []
    for whole, start in zip(wholes, row.tolist(), strict=True):
        first, last = max(start, 0), min(start + width, whole.shape[1])
        part = torch.zeros(whole.shape[0], width, whole.shape[2])
        if last > first:
            part[:, first - start : last - start] = whole[:, first:last]
        parts.append(part)
    return torch.stack(parts).to(like.device)


SCALE = 0.19
"""Misfit at which Huber's loss turns linear, range resolutions. At 0.1, the accuracy of the
detector, the onsets outweigh the spectrograms: the Chamfer distance of ua rises from 0.94 mm to
1.25 mm (means of two seeds of the refinement)."""
_POSES = 64  # number that is drawn per step; it bounds the time


class OnsetRanges:
    """Onsets of the training poses, for comparison with a surface.

    The nearest point of a body always sends an echo, even if it is an edge or a corner. So the
    least range over the surface must be the onset. Physical optics alone does not ensure this: if a
    pose hears only a quiet edge, the descent can make the edge quieter by cutting it off.

    Up to ``SCALE`` the misfit is quadratic, beyond it is linear (Huber's loss).

    In: resolution (m).
    """

    def __init__(self, hull: EchoHull, resolution: float, seed: int) -> None:
        self.scale, self.seed = SCALE * resolution, seed
        known = np.isfinite(hull.trusted)
        pose, ear = np.nonzero(known)
        self._first = hull.trusted[known]
        self._emitters, self._receivers = hull.emitters[pose], hull.receivers[pose, ear]

    def __len__(self) -> int:
        return len(self._first)

    def ridges(self, hull: trimesh.Trimesh) -> float:
        """Return the height of the ridges of a hull (m) between poses, m.

        The hull is taken for a sphere's tangent planes, one for each pose that heard an onset. The
        height is the median over the vertices: their distance from the centroid times 1/cos - 1 of
        the angle to the nearest pose. Vertices with a larger angle than the usual gap between as
        many random poses take no part, because no pose bounds them.
        """
        outward, source = hull.vertices - hull.centroid, self._emitters - hull.centroid
        radius, poses = np.linalg.norm(outward, axis=1), np.unique(trimesh.unitize(source), axis=0)
        near, _ = cKDTree(poses).query(trimesh.unitize(outward))
        cosine = 1.0 - near**2 / 2.0
        bounded = cosine > max(math.cos(usual_gap(len(poses))), 1e-9)
        heights = radius[bounded] * (1.0 / cosine[bounded] - 1.0)
        return float(np.median(heights)) if bounded.any() else math.inf

    def misfit(self, vertices: Tensor, late: float = 0.0) -> float:
        """Return the mean Huber loss of the least range; no unit; 0 without onsets.

        In: vertices ((V, 3), m), late (m).
        """
        if not len(self):
            return 0.0
        lots = np.array_split(np.arange(len(self)), -(-len(self) // _POSES))
        off = torch.cat([self._off(vertices, some)[0] for some in lots])
        off = (off + (-off.median()).clamp(0.0, late / self.scale)).abs()
        return float(torch.where(off < 1.0, 0.5 * off.square(), off - 0.5).mean())

    def gradient(self, vertices: Tensor, number: int) -> Tensor:
        """Gradient (V, 3), 1/m, of the misfit of a step's onsets; ``number`` is the step's."""
        found = torch.zeros_like(vertices)
        if not len(self):
            return found
        rng = np.random.default_rng([self.seed, number])
        some = rng.choice(len(self), min(_POSES, len(self)), replace=False)
        off, nearest, way = self._off(vertices, some)
        slope = off.clamp(-1.0, 1.0)[:, None] * way / (self.scale * len(some))
        return found.index_add_(0, nearest, slope)

    def _off(self, vertices: Tensor, some: NDArray[np.intp]) -> tuple[Tensor, Tensor, Tensor]:
        """Return misfit (N,), nearest vertex (N,) and the range's gradient there (N, 3)."""
        emitters, receivers, first = (
            torch.as_tensor(part[some]).to(vertices)
            for part in (self._emitters, self._receivers, self._first)
        )
        ranges = (torch.cdist(vertices, emitters) + torch.cdist(vertices, receivers)) / 2
        least, nearest = ranges.min(0)
        out, back = vertices[nearest] - emitters, vertices[nearest] - receivers
        way = out / out.norm(dim=1, keepdim=True) + back / back.norm(dim=1, keepdim=True)
        return (least - first) / self.scale, nearest, way / 2
