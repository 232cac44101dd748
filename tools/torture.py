#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Do to sononerf what disks, clocks, strangers and tired people do, and see that nothing is lost.

    python tools/torture.py SERIES [--count N] [--seed S] [--output DIR]

``kill-simulate``, ``kill-fit``: `simulate`, and `fit` with all that follows it, killed at random
moments and at random writes; what the same command then makes equals an uninterrupted run.
``disk``: each call that writes fails once; exit code 4, and old files are as they were.
``attacks``: files and folders of strangers; no code, no connection, nothing written outside.
``mistakes``: wrong units, conventions and sizes; refused, or warned with the cause.

The seed is drawn where it is not given, and printed: the same seed gives the same trials. The exit
code is 1 where there was a fault. Files that caused one are kept in ``--output``.
"""

from __future__ import annotations

import argparse
import secrets
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # the parts of this command, and the package of this checkout

from tools.tortures.attacks import attacks  # noqa: E402
from tools.tortures.harness import Report  # noqa: E402
from tools.tortures.interrupted import disk, kill_fit, kill_simulate  # noqa: E402
from tools.tortures.mistakes import mistakes  # noqa: E402

SERIES = {
    "kill-simulate": (kill_simulate, 500),
    "kill-fit": (kill_fit, 500),
    "disk": (disk, 0),
    "attacks": (attacks, 0),
    "mistakes": (mistakes, 0),
}
"""Each series, and how many trials it has where no number is given."""


def main() -> None:
    """Run one series, and print what it found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("series", choices=SERIES)
    parser.add_argument("--count", type=int, help="number of trials")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6))
    parser.add_argument("--output", type=Path, default=Path("torture"), metavar="DIR")
    given = parser.parse_args()
    run, count = SERIES[given.series]
    given.output = given.output.absolute()
    given.output.mkdir(parents=True, exist_ok=True)
    print(f"{given.series}, seed {given.seed}", flush=True)
    report: Report = run(given.count or count, given.seed, given.output)
    print("\n".join(report.lines()))
    sys.exit(1 if report.faults else 0)


if __name__ == "__main__":
    main()
