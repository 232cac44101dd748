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
from sononerf.surface.start.learned import BLOCK, FEATURES, OUTSIDE, StartNetwork

CROP = 64
"""Side of a crop, voxels."""
BATCH = 2
"""Number of crops per step."""
RATE = 2e-3
"""Largest learning rate of AdamW, no unit; cosine decay to a hundredth of it."""
CLASS = 0.7
"""Weight of the error of the sign beside that of the distance, no unit; also the distance at which
the logit of the sign is 1, voxels."""
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
_NORMAL = slice(FEATURES - 3, FEATURES)  # features that turn with the axes
_BOUND, _POSES = 0, FEATURES - 4  # features with a value outside of the lattice


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


def _crop(example: Example, random: np.random.Generator) -> tuple[Any, Any]:
    """Return a crop, turned and mirrored at random; air surrounds a small lattice."""
    seen = np.zeros((FEATURES, CROP, CROP, CROP), np.float32)
    seen[_BOUND], seen[_POSES] = 2.0, example.seen[_POSES].flat[0]
    true = np.full((CROP,) * 3, 1.5 * OUTSIDE, np.float32)
    source, target = [], []
    for size in example.true.shape:
        shift = int(random.integers(0, abs(size - CROP) + 1))
        start, length = max(0, size - CROP) and shift, min(size, CROP)
        source.append(slice(start, start + length))
        start = 0 if size >= CROP else shift
        target.append(slice(start, start + length))
    seen[(slice(None), *target)] = example.seen[(slice(None), *source)]
    true[tuple(target)] = example.true[tuple(source)]
    order = random.permutation(3)
    seen[_NORMAL] = seen[_NORMAL][order]
    seen, true = seen.transpose(0, *(1 + order)).copy(), true.transpose(order)
    for axis in np.flatnonzero(random.random(3) < 0.5):
        seen, true = np.flip(seen, 1 + axis).copy(), np.flip(true, axis)
        seen[_NORMAL][axis] *= -1
    return seen, true.copy()


def loss(found: Tensor, true: Tensor) -> Tensor:
    """Return the mean loss of signed distances (B, X, Y, Z), voxels."""
    aim = true.clamp(-OUTSIDE, OUTSIDE)
    right = (aim.abs() >= OUTSIDE) & (found * aim.sign() > OUTSIDE)
    off = torch.where(right, BEYOND * (found - aim), found - aim)
    distance = functional.smooth_l1_loss(off, torch.zeros_like(off), reduction="none")
    sign = functional.binary_cross_entropy_with_logits(
        -found / CLASS, (true < 0).float(), reduction="none"
    )
    weight = torch.where(true.abs() < NEAR, NEAR_WEIGHT, 1.0)
    return (weight * (distance + CLASS * sign)).mean()


@torch.no_grad()
def overlaps(network: StartNetwork, examples: list[Example]) -> dict[str, tuple[float, float]]:
    """Return the mean intersection over union of network and of onsets' bound, by kind."""
    found: dict[str, list[tuple[float, float]]] = {}
    for one in examples:
        wider = [(0, -size % BLOCK) for size in one.true.shape]
        seen = np.pad(one.seen.astype(np.float32), [(0, 0), *wider], mode="edge")
        made = network(torch.from_numpy(seen)[None])[0].numpy()
        inside = one.true < 0
        made = made[tuple(slice(size) for size in inside.shape)] < 0
        bound = one.seen[_BOUND] < 0
        both = [(part & inside).sum() / max(1, (part | inside).sum()) for part in (made, bound)]
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
    network, mean = StartNetwork(), StartNetwork()
    mean.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-2)
    running = math.nan
    for step in range(steps):
        rate = RATE * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / 50)
        crops = [_crop(used[random.integers(len(used))], random) for _ in range(BATCH)]
        seen, true = (torch.from_numpy(np.stack(both)) for both in zip(*crops, strict=True))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = network(seen)
        value = loss(found, true)
        optimizer.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
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
