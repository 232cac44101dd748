# SPDX-License-Identifier: MIT
"""Recordings: read, brought into our units and frame, cut into pings, checked."""
