# SPDX-License-Identifier: MIT
"""Reflectivity fields: positions and directions in, complex pressure reflectivity out."""
