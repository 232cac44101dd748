# SPDX-License-Identifier: MIT
"""Air, call, ears and spectrograms."""
