# SPDX-License-Identifier: MIT
"""Measured directivities: readers of several formats, one record, one writer."""
