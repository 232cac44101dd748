# SPDX-License-Identifier: MIT
"""A surface that does not move, as poses hear it."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from torch import Tensor

from sononerf.array_types import Floats, Singles
from sononerf.surface.refine.mesh_operators import MeshOperators, smoothing_passes, unit
from sononerf.surface.refine.optics import Heads, Optics, Pieces
from sononerf.surface.refine.visibility import listen, sight_of


class StillSurface:
    """A surface, prepared once for all poses.

    Attributes:
        operators: Operators on the surface.
        vertices, normals, area ((V, 3) float64): Places (m), outward unit normals and vector areas
            (m²).
        bending ((V, 6), 1/m): Curvature, see :meth:`MeshOperators.bending`.
    """

    def __init__(self, mesh: trimesh.Trimesh, optics: Optics) -> None:
        self.optics = optics
        like = optics.get_buffer("wavenumber")
        faces = np.array(mesh.faces, dtype=np.int64)
        self.vertices = torch.as_tensor(np.array(mesh.vertices, dtype=np.float64)).to(like.device)
        self.operators = MeshOperators(torch.as_tensor(faces).to(like.device), len(self.vertices))
        self.area = self.operators.areas(self.vertices)
        self.normals = unit(self.area)
        passes = smoothing_passes(optics.wavelength, self.operators.edge_length(self.vertices))
        self.bending = self.operators.bending(self.vertices, self.normals, passes)
        sight = sight_of(optics, self.vertices.cpu().numpy(), faces)
        self._parts = self.operators, self.vertices, self.area, self.bending, sight

    def listen(self, positions: Floats, rotations: Floats) -> tuple[Pieces, Heads, Tensor]:
        """Return the pieces that poses hear, see :func:`~.visibility.listen`.

        In: positions, rotations ((P, 3), (P, 3, 3)).
        """
        places, turns = (torch.as_tensor(part).to(self.vertices) for part in (positions, rotations))
        return listen(self.optics, *self._parts, places, turns)

    @torch.no_grad()
    def render(
        self,
        positions: Floats,
        rotations: Floats,
        stretch: Floats | float = 1.0,
        late: Floats | float = 0.0,
    ) -> Singles:
        """Return magnitudes on the whole axis, (P, E, R, F).

        In: positions, rotations ((P, 3), (P, 3, 3)).
        """
        optics = self.optics
        shape = (len(positions), optics.ears, optics.rows, len(optics.frequencies))
        found = np.zeros(shape, dtype=np.float32)
        pieces, heads, middle = self.listen(positions, rotations)
        if not len(pieces.pose):
            return found
        points, area = (self.vertices - middle).float(), self.area.float()
        factor, more = (points.new_tensor(part).expand(len(found)) for part in (stretch, late))
        heard = optics.render(points, area, pieces, heads, stretch=factor, late=more)
        magnitude = heard.power.sqrt().cpu().numpy()
        for one, rendered, row in zip(found, magnitude, heard.row.tolist(), strict=True):
            first, last = max(row, 0), min(row + rendered.shape[1], optics.rows)
            if last > first:
                one[:, first:last] = rendered[:, first - row : last - row]
        return found
