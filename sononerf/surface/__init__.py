# SPDX-License-Identifier: MIT
"""Surfaces that explain the echoes: where they start and how they are refined."""
