# SPDX-License-Identifier: MIT
"""Callbacks of the fit: previews, pictures, progress, checkpoints."""
