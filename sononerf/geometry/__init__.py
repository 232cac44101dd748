# SPDX-License-Identifier: MIT
"""Poses, directions, surfaces and ray casting."""
