# SPDX-License-Identifier: MIT
"""``python -m sononerf.cli`` is the command ``sononerf``."""

from sononerf.cli.start import main

main()
