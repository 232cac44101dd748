# SPDX-License-Identifier: MIT
"""Renderers: a field, a pose and ranges in, the two ears' spectra out."""
