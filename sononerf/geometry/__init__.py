# SPDX-License-Identifier: MIT
"""Poses, directions, ray casting, normals and grids."""
