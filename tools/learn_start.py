#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Train the network of the start surface ``levels``.

    python tools/learn_start.py examples FOLDER [--numbers FIRST LAST] [--every N] [--meshes FOLDER]
    python tools/learn_start.py train FOLDER [--steps N] [--workers N] [--side N] [--further]

``examples`` makes one example per number: a procedural body or one of a folder of meshes, the
levels of its echoes, and the true signed distance; some 15 s of one core each. Examples that exist
are kept, so that the same command resumes. Two processes share the numbers with ``--every 2`` and
``--numbers 0 400`` and ``--numbers 1 400``. ``train`` writes the weights, by default into the
package; a training that was stopped goes on; with ``--further`` it begins with the present weights.
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
from sononerf.start.network import WEIGHTS, trained_network  # noqa: E402
from tools.learning.examples import make_example  # noqa: E402
from tools.learning.training import SIDE, train, weights_file  # noqa: E402


def _tell(line: str) -> None:
    print(line, flush=True)


def main() -> None:
    """Make examples, or train."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("work", choices=("examples", "train"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--numbers", type=int, nargs=2, default=(0, 400), metavar=("FIRST", "LAST"))
    parser.add_argument("--meshes", type=Path, metavar="FOLDER")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--side", type=int, default=SIDE)
    parser.add_argument("--further", action="store_true")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--output", type=Path, default=WEIGHTS)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    logging.getLogger("sononerf").setLevel(logging.ERROR)
    if given.work == "examples":
        first, last = given.numbers
        for number in range(first, last, given.every):
            _tell(make_example(number, given.folder, given.meshes))
        return
    try:
        network = train(
            given.folder,
            steps=given.steps,
            seed=given.seed,
            side=given.side,
            workers=given.workers,
            start=trained_network() if given.further else None,
            tell=_tell,
        )
    except InputError as error:
        parser.error(f"{given.folder}: {error}")
    weights_file(network, given.output)
    _tell(f"wrote {given.output}")


if __name__ == "__main__":
    main()
