# SPDX-License-Identifier: MIT
"""Start surfaces, from the field, the onsets and the free space."""
