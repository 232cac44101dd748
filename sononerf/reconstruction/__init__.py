# SPDX-License-Identifier: MIT
"""From a field to volumes, meshes and numbers."""
