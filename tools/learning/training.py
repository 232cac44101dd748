# SPDX-License-Identifier: MIT
"""Training of the start network on examples.

References:
    .. [1] M. Wortsman et al., "Robust fine-tuning of zero-shot models", 2022.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save as safetensors_bytes
from torch import Tensor
from torch.nn import functional
from torch.utils.data import DataLoader, IterableDataset

from sononerf import storage
from sononerf.errors import InputError
from sononerf.start.network import LOGIT, OUTSIDE, StartNetwork
from tools.learning.examples import Crop, draw, load_example

SIDE = 40
"""Side of a crop, places."""
BATCH = 8
"""Number of crops per step."""
RATE, FURTHER_RATE = 1e-3, 3e-4
"""Largest learning rate of AdamW for a new network and for a trained one, no unit; cosine decay to
a hundredth of it."""
OLD = 0.5
"""Share of the weights before a further training in those after it [1]_, no unit. After 330 steps,
a third of them on new kinds, the mean F-score at 2 mm of 19 withheld bodies of old kinds fell from
0.806 to 0.795; the mean of both weights has 0.807, and on eleven of new kinds 0.744 for 0.728."""
KEPT, TIMES = 24, 2
"""Number of crops that are kept, and how many times each is used, about, in random frames: the
features of a crop take as long on a core as a step of the network with it."""
WARM = 200
"""Number of steps in which the rate rises linearly to its largest value."""
CLASS = 0.7
"""Weight of the error of the sign beside that of the distance, no unit."""
NEAR, NEAR_WEIGHT = 2.0, 4.0
"""Distance from the true surface, voxels, within which a voxel counts this many times."""
FREE, FREE_WEIGHT = 3.0, 0.05
"""Distance in front of the onsets, voxels, beyond which a voxel counts this many times."""
BEYOND = 0.02
"""Weight of the error of a distance beyond OUTSIDE whose sign is right, no unit."""
SMALLEST = 32
"""Side of a crop, places, from which a CPU computes in half precision: over 2 x 2 x 2 places, the
coarsest level of a crop of 16, torch 2.13 returns gradients of 1e30."""
AVERAGE = 0.998
"""Decay per step of the running mean of the weights, no unit."""
TOLD = 25
"""Number of steps between two lines of progress, after which the state is saved."""
WITHHELD = 12
"""Every twelfth number is withheld from the training."""
STATE = "training.pt"
"""File of the state of a training, beside the examples."""


class _Crops(IterableDataset[tuple[Tensor, Tensor, Tensor]]):
    """Crops of examples, from a step on; each is drawn from seed and number."""

    def __init__(self, files: list[Path], side: int, seed: int, first: int) -> None:
        self.files, self.side, self.seed, self.first = files, side, seed, first

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        worker = torch.utils.data.get_worker_info()
        number, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        # A loader takes whole batches from its workers in turn.
        batch, kept = self.first + number, deque[Crop](maxlen=KEPT)
        while True:
            for within in range(BATCH):
                random = np.random.default_rng([self.seed, batch, within])
                if within % TIMES == 0:
                    example = load_example(self.files[random.integers(len(self.files))])
                    kept.append(draw(example, random, self.side))
                order = tuple(random.permutation(3).tolist())
                signs = tuple(random.choice([-1, 1], 3).tolist())
                crop = kept[random.integers(len(kept))]
                yield tuple(torch.from_numpy(one) for one in crop.turned(order, signs))
            batch += step


def loss(found: Tensor, true: Tensor, bound: Tensor) -> Tensor:
    """Return the mean loss of signed distances (B, X, Y, Z), voxels.

    Args:
        found, true: By the network, and the truth.
        bound (B, X/2, Y/2, Z/2): Distance in front of the onsets.
    """
    aim = true.clamp(-OUTSIDE, OUTSIDE)
    right = (aim.abs() >= OUTSIDE) & (found * aim.sign() > OUTSIDE)
    off = torch.where(right, BEYOND * (found - aim), found - aim)
    distance = functional.smooth_l1_loss(off, torch.zeros_like(off), reduction="none")
    sign = functional.binary_cross_entropy_with_logits(
        -found / LOGIT, (true < 0).float(), reduction="none"
    )
    free = functional.interpolate(bound[:, None], scale_factor=2, mode="trilinear")[:, 0] > FREE
    weight = torch.where(true.abs() < NEAR, NEAR_WEIGHT, 1.0)
    weight = weight * torch.where(free, FREE_WEIGHT, 1.0)
    return (weight * (distance + CLASS * sign)).sum() / weight.sum()


def train(
    folder: Path,
    *,
    steps: int,
    seed: int,
    side: int = SIDE,
    workers: int = 0,
    start: StartNetwork | None = None,
    tell: Callable[[str], None],
) -> StartNetwork:
    """Train, and return the network with the running mean of its weights.

    The state is saved in the folder, and the same call goes on from it.

    Args:
        folder: Folder of the examples; every ``WITHHELD``-th number is withheld.
        steps: Number of steps.
        seed: Seed of weights and crops.
        side: Side of a crop, places; a multiple of 8.
        workers: Processes that draw crops; this one where 0.
        start: Network to begin with; a new one where None. ``OLD`` of its weights is kept.
        tell: Called with a line of progress every ``TOLD`` steps.

    Raises:
        InputError: If no example is left to train on.
    """
    files = sorted(folder.glob("*.npz"), key=lambda file: int(file.stem))
    files = [file for file in files if int(file.stem) % WITHHELD != 4]
    if not files:
        raise InputError("no examples to train on; make some first")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(seed)
    network = (start or StartNetwork()).to(device, memory_format=torch.channels_last_3d).train()
    mean = StartNetwork().to(device)
    mean.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(network.parameters(), RATE, betas=(0.9, 0.95), weight_decay=1e-2)
    largest = RATE if start is None else FURTHER_RATE
    before = [] if start is None else [part.detach().cpu().clone() for part in start.parameters()]
    parts = {"network": network, "mean": mean, "optimizer": optimizer}
    done, state = 0, folder / STATE
    if state.is_file():
        saved = torch.load(state, map_location=device, weights_only=True)
        done = saved.pop("steps")
        for name, part in parts.items():
            part.load_state_dict(saved[name])
    half = device.type == "cuda" or side >= SMALLEST
    crops = DataLoader(_Crops(files, side, seed, done), BATCH, num_workers=workers)
    running = math.nan
    for step, batch in zip(range(done, steps), crops, strict=False):
        seen, bound, true = (part.to(device) for part in batch)
        rate = largest * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / WARM)
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=half):
            found = network(seen, bound)
        value = loss(found, true, bound)
        optimizer.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        fraction = 1 - min(AVERAGE, (step + 1) / (step + 11))
        with torch.no_grad():
            for kept, new in zip(mean.parameters(), network.parameters(), strict=True):
                kept.lerp_(new, fraction)
        now = float(value.detach())
        running = now if math.isnan(running) else 0.98 * running + 0.02 * now
        if (step + 1) % TOLD == 0 or step + 1 == steps:
            tell(f"step {step + 1} of {steps}, loss {running:.3f}")
            kept_state = {name: part.state_dict() for name, part in parts.items()}
            data = {"steps": step + 1, **kept_state}
            storage.commit(state, lambda opened, data=data: torch.save(data, opened))
    if start is not None:
        with torch.no_grad():
            for kept, old in zip(mean.cpu().parameters(), before, strict=True):
                kept.lerp_(old, OLD)
    return mean.cpu().eval()


def weights_file(network: StartNetwork, target: Path) -> None:
    """Write the weights in half precision."""
    state = {name: part.detach().half().contiguous() for name, part in network.state_dict().items()}
    storage.commit_bytes(target, safetensors_bytes(state))
