# SPDX-License-Identifier: MIT
"""Refinement of a surface against the measured spectrograms."""
