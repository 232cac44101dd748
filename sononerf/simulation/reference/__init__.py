# SPDX-License-Identifier: MIT
"""Slow engines that serve as references: exact spheres, boundary elements, physical optics."""
