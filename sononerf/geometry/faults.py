# SPDX-License-Identifier: MIT
"""Faults of a surface, one line each; such a surface can still be simulated."""

from __future__ import annotations

import trimesh
from trimesh.grouping import group_rows

FLAT = 1e-7
"""Height of a triangle over the size of the surface below which it has no area in single
precision."""


def surface_faults(mesh: trimesh.Trimesh) -> list[str]:
    """Return the faults of a surface."""
    lines = []
    good = mesh.nondegenerate_faces(height=FLAT * float(mesh.scale))
    if not good.all():
        lines.append(
            f"the mesh has {_count((~good).sum(), 'triangle')} without area; nothing is heard there"
        )
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces[good], process=False)
    if not whole.is_watertight:
        alone = len(group_rows(whole.edges_sorted, require_count=1))
        said = f"the mesh is open ({_count(alone, 'edge')} of one triangle alone"
        if not alone:
            said = "the mesh is open (edges are shared by more than two triangles"
        merged = whole.copy()
        merged.merge_vertices()
        if merged.is_watertight:
            said += "; vertices are there twice, merging them would close it"
        lines.append(f"{said}); volumes will not be measured")
    elif not whole.is_winding_consistent:
        lines.append("the mesh's triangles do not agree on which side is outside")
    elif whole.volume < 0.0:
        lines.append("the mesh is inside out; echoes do not mind, volumes do")
    return lines


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
