# SPDX-License-Identifier: MIT
"""The ensemble store, its range slices, and how they are streamed."""
