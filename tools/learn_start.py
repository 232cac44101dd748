#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Train the network of the start surface ``learned``.

    python tools/learn_start.py examples FOLDER [--seeds FIRST LAST] [--every N]
    python tools/learn_start.py train FOLDER [--steps N] [--seed S] [--without KIND ...]

``examples`` makes one example per seed: a procedural body, its echoes, a fit, the evidence, and the
true signed distance; about 20 s of one core each. Examples that exist are kept, so that the same
command resumes. Two processes share the seeds with ``--every 2`` and ``--seeds 0 400`` and
``--seeds 1 400``. ``train`` writes the weights, by default into the package.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # the parts of this command, and the package of this checkout

from sononerf.errors import InputError  # noqa: E402
from sononerf.surface.start.learned import WEIGHTS  # noqa: E402
from tools.learning.examples import make_example  # noqa: E402
from tools.learning.training import load_examples, train, weights_file  # noqa: E402


def _tell(line: str) -> None:
    print(line, flush=True)


def main() -> None:
    """Make examples, or train."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("work", choices=("examples", "train"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 400), metavar=("FIRST", "LAST"))
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without", nargs="*", default=(), metavar="KIND")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--output", type=Path, default=WEIGHTS)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    logging.getLogger("sononerf").setLevel(logging.ERROR)
    if given.work == "examples":
        first, last = given.seeds
        for seed in range(first, last, given.every):
            _tell(make_example(seed, given.folder))
        return
    try:
        network = train(
            load_examples(given.folder),
            steps=given.steps,
            seed=given.seed,
            without=tuple(given.without),
            tell=_tell,
        )
    except InputError as error:
        parser.error(f"{given.folder}: {error}")
    weights_file(network, given.output)
    _tell(f"wrote {given.output}")


if __name__ == "__main__":
    main()
