# SPDX-License-Identifier: MIT
"""Whether a reconstructed surface is the skin of a body, or a sheet, or one side of something.

Poisson's equation closes every surface. Where no pose could have heard the other side, what closes
it is made up; where both sides are heard and hardly anything lies between them, it is a leaf.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.geometry.raycast import RayCaster

Array = NDArray[np.float64]
LOOKS = 12
"""So many poses at a time are asked whether they see a triangle, those that it faces best first."""
FACING = 0.1
"""Cosine from which on a triangle faces a pose."""
UNSEEN_SHARE = 0.25
"""A surface of which more than this cannot have been heard is open; less is closed by guess."""
THIN = 0.004
"""Thinner than this is a sheet, m: neither of its sides is known better than to a millimetre."""
THIN_SHARE = 0.75
"""Of a sheet's surface so much is thin."""
LIFT = 1e-4
"""How far inside of a triangle the look for the other side begins, m."""
CHUNK = 4096


@dataclass(frozen=True)
class Openness:
    """What kind of surface it is.

    Attributes
    ----------
    unseen : (T,) bool
        The triangles that no pose can have heard.
    unseen_share, thin_share : float
        Shares of the area: that no pose can have heard; that has the other side close behind it.
    """

    unseen: NDArray[np.bool_]
    unseen_share: float
    thin_share: float

    @property
    def kind(self) -> Literal["closed", "sheet", "one-sided"]:
        """A body's skin, a sheet that was heard from both sides, or one side of something."""
        if self.unseen_share > UNSEEN_SHARE:
            return "one-sided"
        return "sheet" if self.thin_share > THIN_SHARE else "closed"


def judge_openness(mesh: trimesh.Trimesh, sources: Array) -> Openness:
    """Tell a body's skin from an open surface.

    Parameters
    ----------
    mesh : Trimesh
        A closed reconstruction, normals outward, m.
    sources : (P, 3) float, m
        Where it was heard from.

    Returns
    -------
    openness : Openness
    """
    middles = np.asarray(mesh.triangles_center, dtype=np.float64)
    normals = np.asarray(mesh.face_normals, dtype=np.float64)
    areas = np.asarray(mesh.area_faces, dtype=np.float64)
    caster = RayCaster(mesh)
    unseen = ~_seen(caster, middles, normals, sources)
    inward = caster.first_hit(middles - LIFT * normals, -normals)
    thin = inward.ray[inward.distance < THIN]
    total = areas.sum()
    return Openness(unseen, float(areas[unseen].sum() / total), float(areas[thin].sum() / total))


def _seen(caster: RayCaster, middles: Array, normals: Array, sources: Array) -> NDArray[np.bool_]:
    seen = np.zeros(len(middles), dtype=bool)
    for start in range(0, len(middles), CHUNK):
        some = slice(start, start + CHUNK)
        ways = sources[None] - middles[some, None]
        ways /= np.linalg.norm(ways, axis=2, keepdims=True)
        facing = np.einsum("tpi,ti->tp", ways, normals[some])
        order = np.argsort(-facing, axis=1)
        left = np.arange(len(facing))
        for first in range(0, len(sources), LOOKS):
            best = order[left, first : first + LOOKS]
            row, column = np.nonzero(np.take_along_axis(facing[left], best, axis=1) > FACING)
            if not len(row):
                break
            which = start + left[row]
            asked = sources[best[row, column]]
            seen[which[caster.visible(middles[which], asked, normals=normals[which])]] = True
            left = left[~seen[start + left]]
    return seen


def without_unseen(mesh: trimesh.Trimesh, openness: Openness) -> trimesh.Trimesh:
    """Return the mesh without the triangles that no pose can have heard."""
    kept = trimesh.Trimesh(mesh.vertices.copy(), mesh.faces[~openness.unseen].copy(), process=False)
    kept.remove_unreferenced_vertices()
    return kept
