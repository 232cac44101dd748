# SPDX-License-Identifier: MIT
"""From a scene and a pose to the echoes at each receiver."""
