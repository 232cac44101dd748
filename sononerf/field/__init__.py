# SPDX-License-Identifier: MIT
"""Reflectivity fields, the renderers that turn them into spectra, and their training."""
