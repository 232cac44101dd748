# SPDX-License-Identifier: MIT
"""The surface that explains the echoes: where it starts, and how it is refined."""
