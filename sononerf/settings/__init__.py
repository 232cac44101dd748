# SPDX-License-Identifier: MIT
"""Settings: their schema, how they are read and checked, presets of calls, and plugins."""
