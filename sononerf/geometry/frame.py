# SPDX-License-Identifier: MIT
"""The frame and unit that places are given in: the world's, or those of the recordings or file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sononerf.errors import InputError
from sononerf.numerics import Floats

FrameName = Literal["auto", "world", "original"]
KEYS = ("to_original", "head_to_original")
"""Attributes of a store that state its original frame."""
UNITS = {1.0: "m", 0.01: "cm", 0.001: "mm"}


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame beside the world's (m, right-handed, z up; the head's x forward, y left, z up)."""

    # (4, 4): From the world's frame and metres to this frame and its unit
    matrix: Floats = field(default_factory=lambda: np.eye(4))
    # (3, 3): From our axes of the head to this frame's
    head: Floats = field(default_factory=lambda: np.eye(3))

    @classmethod
    def of(cls, attributes: Mapping[str, Any], name: FrameName = "auto") -> Frame:
        """Return a frame that the attributes of a store, or a run's provenance, state."""
        recorded = attributes.get("origin") == "recorded"
        if name == "world" or (name == "auto" and not recorded):
            return cls()
        matrix, head = (attributes.get(key) for key in KEYS)
        frame = cls(
            np.eye(4) if matrix is None else np.asarray(matrix, dtype=np.float64),
            np.eye(3) if head is None else np.asarray(head, dtype=np.float64),
        )
        if frame.matrix.shape != (4, 4) or frame.head.shape != (3, 3):
            raise InputError("to_original is no 4 by 4 matrix; import or simulate again")
        turn = frame.matrix[:3, :3] * (frame.unit if np.isfinite(frame.unit) else 0.0)
        if not all(np.allclose(each @ each.T, np.eye(3), atol=1e-3) for each in (turn, frame.head)):
            raise InputError("to_original is no similarity; import or simulate again")
        return frame

    @property
    def unit(self) -> float:
        """Length of the unit, m."""
        size = abs(float(np.linalg.det(self.matrix[:3, :3])))
        return size ** (-1.0 / 3.0) if size > 0.0 else np.inf

    @property
    def unit_name(self) -> str:
        """Name of the unit."""
        near = [name for unit, name in UNITS.items() if abs(self.unit / unit - 1.0) < 1e-3]
        return near[0] if near else f"{self.unit:.6g} m"

    @property
    def is_world(self) -> bool:
        """Whether it is the world's frame, in metres."""
        return np.allclose(self.matrix, np.eye(4)) and np.allclose(self.head, np.eye(3))

    @property
    def name(self) -> str:
        """Text for files."""
        if self.is_world:
            return "world frame, right-handed, z up, m"
        return f"frame of the recordings or of the scene's file, {self.unit_name}"

    def places(self, places: ArrayLike) -> Floats:
        """Return places (..., 3) of the world (m) in this frame and unit."""
        return np.asarray(places, np.float64) @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def directions(self, directions: ArrayLike) -> Floats:
        """Return directions (..., 3) of the world in this frame."""
        return np.asarray(directions, np.float64) @ (self.matrix[:3, :3] * self.unit).T

    def rotations(self, rotations: ArrayLike) -> Floats:
        """Return rotations (..., 3, 3), head to world, from this frame's head to its world."""
        turn = self.matrix[:3, :3] * self.unit
        return np.asarray(turn @ np.asarray(rotations, np.float64) @ self.head.T)

    def mesh(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """Return a mesh of the world in this frame and unit."""
        return _moved(mesh, self.matrix)

    def to_world(self, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        """Return a mesh whose axes are this frame's, but whose unit is the metre, in the world."""
        metres = np.diag([1.0 / self.unit] * 3 + [1.0])
        return _moved(mesh, np.asarray(np.linalg.inv(self.matrix) @ metres, np.float64))


def _moved(mesh: trimesh.Trimesh, matrix: Floats) -> trimesh.Trimesh:
    """Return a moved copy whose triangles still wind around their outward normals."""
    places = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    faces = mesh.faces if np.linalg.det(matrix[:3, :3]) > 0.0 else mesh.faces[:, ::-1]
    return trimesh.Trimesh(places, faces, process=False)
