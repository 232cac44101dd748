"""A bar, from another house."""

import trimesh

from sononerf.scene import Scene


def bar(length: float = 0.1, radius: float = 0.01) -> Scene:
    return Scene(trimesh.creation.capsule(height=length, radius=radius))
