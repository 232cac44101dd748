# SPDX-License-Identifier: MIT
"""The surface that explains the echoes: evidence, occupancy where it starts, and refinement."""
