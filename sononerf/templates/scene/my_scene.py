from typing import Annotated

import trimesh
from pydantic import Field
from sononerf.scene import Scene

Metres = Annotated[float, Field(gt=0, le=1)]


def make(length: Metres = 0.05, radius: Metres = 0.01) -> Scene:
    """Build an upright rod with round ends: length of the straight part and radius (m)."""
    return Scene(trimesh.creation.capsule(height=length, radius=radius))
