# SPDX-License-Identifier: MIT
"""Commands as a user gives them, in a process and a folder of their own."""

from __future__ import annotations

import subprocess
import sys


def succeed(folder, *words):
    """Run ``sononerf WORDS`` in a folder; return what it says on stderr.

    It must end with 0.
    """
    done = subprocess.run(
        [sys.executable, "-m", "sononerf.cli", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, f"{words}\n{done.stderr}"
    return done.stderr
