# SPDX-License-Identifier: MIT
"""The one surface that explains the echoes: evidence, occupancy, and what follows from it."""
