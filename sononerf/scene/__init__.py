# SPDX-License-Identifier: MIT
"""Scenes: surfaces, materials and compositions; the public names for scene plugins."""

from sononerf.scene.material import MATERIALS, Material, MaterialName
from sononerf.scene.scene import (
    Part,
    Scene,
    SurfaceSizeError,
    check_surface,
    compose,
    list_scenes,
    load_scene,
)

__all__ = [
    "MATERIALS",
    "Material",
    "MaterialName",
    "Part",
    "Scene",
    "SurfaceSizeError",
    "check_surface",
    "compose",
    "list_scenes",
    "load_scene",
]
