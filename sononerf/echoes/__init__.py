# SPDX-License-Identifier: MIT
"""What the echoes say before anything is fitted: onsets, free space and region."""
