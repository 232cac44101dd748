# SPDX-License-Identifier: MIT
"""Echoes, simulated or recorded: the store, onsets, free space and region."""
