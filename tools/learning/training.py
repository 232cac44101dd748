# SPDX-License-Identifier: MIT
"""Training of the start network on examples."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save as safetensors_bytes
from torch import Tensor
from torch.nn import functional

from sononerf import storage
from sononerf.errors import InputError
from sononerf.surface.start.learned import (
    BLOCK,
    FEATURES,
    LOGIT,
    OPEN,
    OUTSIDE,
    VECTORS,
    StartNetwork,
)

CROP = 64
"""Side of a crop, voxels."""
BATCH = 2
"""Number of crops per step."""
RATE = 6e-4
"""Largest learning rate of AdamW, no unit; cosine decay to a hundredth of it."""
WARM = 0.03
"""Fraction of the steps in which the rate rises linearly to its largest value, no unit."""
CLASS = 0.7
"""Weight of the error of the sign beside that of the distance, no unit."""
NEAR, NEAR_WEIGHT = 2.0, 4.0
"""Distance from the true surface, voxels, within which a voxel counts this many times."""
BEYOND = 0.02
"""Weight of the error of a distance beyond OUTSIDE whose sign is right, no unit."""
AVERAGE = 0.998
"""Decay per step of the running mean of the weights, no unit."""
TOLD = 500
"""Number of steps between two lines of progress."""
WITHHELD = 9
"""Every ninth seed is withheld from the training."""
_VECTORS = tuple(FEATURES - 3 * (VECTORS - n) for n in range(VECTORS))  # first component of each
_DISTANCES, _POSES = (0, OPEN, OPEN + 1), OPEN - 1  # features with a value outside of the lattice


@dataclass(frozen=True, eq=False)
class Example:
    """Evidence and truth of one body.

    Attributes:
        seen (FEATURES, X, Y, Z): float16.
        true ((X, Y, Z), voxels): Signed distance, float16.
        kind: Kind of the body.
        seed: Its seed.
    """

    seen: Any
    true: Any
    kind: str
    seed: int


def load_examples(folder: Path) -> list[Example]:
    """Return the examples of a folder by their seeds."""
    found = []
    for file in sorted(folder.glob("*.npz"), key=lambda file: int(file.stem)):
        with np.load(file) as stored:
            kind, seed = str(stored["kind"]), int(file.stem)
            found.append(Example(stored["seen"], stored["true"], kind, seed))
    return found


def crop(example: Example, random: np.random.Generator) -> tuple[Any, Any]:
    """Return a crop, turned and mirrored at random; air surrounds a small lattice."""
    seen = np.zeros((FEATURES, CROP, CROP, CROP), np.float16)
    for one in _DISTANCES:
        seen[one] = 2.0
    seen[_POSES] = example.seen[_POSES].flat[0]
    true = np.full((CROP,) * 3, 1.5 * OUTSIDE, np.float16)
    order, mirrored = random.permutation(3), random.random(3) < 0.5
    features = np.arange(FEATURES)
    for first in _VECTORS:
        features[first : first + 3] = first + order
    source, target = [], []
    for size in np.asarray(example.true.shape)[order]:
        shift = int(random.integers(0, abs(size - CROP) + 1))
        start, length = max(0, size - CROP) and shift, min(size, CROP)
        source.append(slice(start, start + length))
        start = 0 if size >= CROP else shift
        target.append(slice(start, start + length))
    way = tuple(slice(None, None, -1 if back else 1) for back in mirrored)
    true[way][tuple(target)] = example.true.transpose(order)[tuple(source)]
    for made, given in zip(seen, features, strict=True):
        made[way][tuple(target)] = example.seen[given].transpose(order)[tuple(source)]
    for first in _VECTORS:
        seen[first + np.flatnonzero(mirrored)] *= -1
    return seen, true


def loss(found: Tensor, true: Tensor) -> Tensor:
    """Return the mean loss of signed distances (B, X, Y, Z), voxels."""
    aim = true.clamp(-OUTSIDE, OUTSIDE)
    right = (aim.abs() >= OUTSIDE) & (found * aim.sign() > OUTSIDE)
    off = torch.where(right, BEYOND * (found - aim), found - aim)
    distance = functional.smooth_l1_loss(off, torch.zeros_like(off), reduction="none")
    sign = functional.binary_cross_entropy_with_logits(
        -found / LOGIT, (true < 0).float(), reduction="none"
    )
    weight = torch.where(true.abs() < NEAR, NEAR_WEIGHT, 1.0)
    return (weight * (distance + CLASS * sign)).mean()


@torch.no_grad()
def overlaps(network: StartNetwork, examples: list[Example]) -> dict[str, tuple[float, float]]:
    """Return the mean intersection over union of network and of the belief ``open``, by kind."""
    found: dict[str, list[tuple[float, float]]] = {}
    for one in examples:
        wider = [(0, -size % BLOCK) for size in one.true.shape]
        seen = np.pad(one.seen.astype(np.float32), [(0, 0), *wider], mode="edge")
        made = network(torch.from_numpy(seen)[None])[0].numpy()
        inside = one.true < 0
        made = made[tuple(slice(size) for size in inside.shape)] < 0
        start = one.seen[OPEN] < 0
        both = [(part & inside).sum() / max(1, (part | inside).sum()) for part in (made, start)]
        found.setdefault(one.kind, []).append((float(both[0]), float(both[1])))
    return {kind: tuple(np.mean(all_, axis=0)) for kind, all_ in found.items()}


def train(
    examples: list[Example],
    *,
    steps: int,
    seed: int,
    without: tuple[str, ...] = (),
    tell: Callable[[str], None],
) -> StartNetwork:
    """Train, and return the network with the running mean of its weights.

    Args:
        examples: Every ``WITHHELD``-th seed is withheld.
        steps: Number of steps; about 0.4 s of one core each.
        seed: Seed of weights and crops.
        without: Kinds that are withheld too.
        tell: Called with a line of progress every ``TOLD`` steps.

    Raises:
        InputError: If no example is left to train on.
    """
    torch.manual_seed(seed)
    random = np.random.default_rng(seed)
    held = [one for one in examples if one.seed % WITHHELD == 4 or one.kind in without]
    used = [one for one in examples if one.seed % WITHHELD != 4 and one.kind not in without]
    if not used:
        raise InputError("no examples to train on; make some, or withhold fewer kinds")
    network = StartNetwork().to(memory_format=torch.channels_last_3d)
    mean = StartNetwork()
    mean.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(network.parameters(), RATE, betas=(0.9, 0.95), weight_decay=1e-2)
    running = math.nan
    for step in range(steps):
        rate = RATE * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / (WARM * steps))
        crops = [crop(used[random.integers(len(used))], random) for _ in range(BATCH)]
        seen, true = (torch.from_numpy(np.stack(both)) for both in zip(*crops, strict=True))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = network(seen.bfloat16())
        value = loss(found, true.float())
        optimizer.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        optimizer.step()
        share = 1 - min(AVERAGE, (step + 1) / (step + 11))
        with torch.no_grad():
            for kept, new in zip(mean.parameters(), network.parameters(), strict=True):
                kept.lerp_(new, share)
        now = float(value.detach())
        running = now if step == 0 else 0.98 * running + 0.02 * now
        if (step + 1) % TOLD == 0:
            shown = {k: f"{a:.2f}/{b:.2f}" for k, (a, b) in overlaps(mean, held[:24]).items()}
            tell(f"step {step + 1} of {steps}, loss {running:.3f}, withheld {shown}")
    return mean.eval()


def weights_file(network: StartNetwork, target: Path) -> None:
    """Write the weights in half precision."""
    state = {name: part.detach().half().contiguous() for name, part in network.state_dict().items()}
    storage.commit_bytes(target, safetensors_bytes(state))
