# SPDX-License-Identifier: MIT
"""Any surface from a file, whole or in named parts."""

from __future__ import annotations

import difflib
import logging
from typing import Annotated, Literal

import numpy as np
import trimesh
from pydantic import Field

from sononerf.errors import InputError, SettingsError
from sononerf.scene import MATERIALS, MaterialName, Scene, SurfaceSizeError, check_surface
from sononerf.scene.mesh_file import IN_METRES, kind_of, read_mesh

logger = logging.getLogger("sononerf")

WORTH_A_WORD = 1e-3
"""Shift over size, no unit, from which it is reported: less is rounding of the file."""
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


def mesh(
    path: str,
    unit: Literal["m", "cm", "mm"] | None = None,
    scale: Annotated[float, Field(gt=0)] = 1.0,
    centre: bool = True,
    material: MaterialName = "rigid",
    materials: dict[str, MaterialName] | None = None,
) -> Scene:
    """Load a surface from a file.

    Args:
        path: STL, PLY, OBJ, OFF, GLB, or glTF that needs no other file; relative to the working
            directory.
        unit: Unit of the file's numbers. GLB and glTF are in metres by their standard, and turned
            from y up to z up; the others say nothing, so it must be given.
        scale: Size relative to that in the file.
        centre: Move the middle of the bounding box to the origin, at which poses look.
        material: Material of the parts that ``materials`` does not name.
        materials: Materials by part: the geometries of GLB and glTF, the objects and groups of OBJ
            (``object_group`` where it has both), the solids of a text STL.

    Returns:
        scene: Metres.

    Raises:
        InputError: If the file cannot be read, is damaged, or holds no surface; naming it.
        SettingsError: If ``materials`` names a part that the file has not.
    """
    file = read_mesh(path)
    kind = kind_of(path)
    if unit is None:
        if kind not in IN_METRES:
            raise InputError(
                f"{path}: {kind.upper()} states no unit; set scene.options.unit to m, cm or mm"
            )
        unit = "m"
    for name in materials or ():
        if name not in file.names:
            near = difflib.get_close_matches(name, file.names, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise SettingsError(
                f"scene.options.materials: {path} has no part {name!r}; {hint}there are: "
                f"{', '.join(file.names)}"
            )
    if file.fault:
        logger.warning("%s: %s", path, file.fault)
    vertices, faces = METRES[unit] * scale * file.vertices, file.faces
    try:
        # Before vertices are merged: that would drop those that are no numbers without a word.
        check_surface(trimesh.Trimesh(vertices, faces, process=False, validate=False))
    except SurfaceSizeError as error:
        hint = (
            "millimetres taken for metres? set the unit to mm"
            if error.is_too_large
            else "metres taken for millimetres? set the unit to m"
        )
        raise InputError(f"{path}: {error}; {hint}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0 if centre else np.zeros(3)
    if np.abs(middle).max() > WORTH_A_WORD * float(np.ptp(vertices, axis=0).max()):
        logger.warning(
            "%s: moved by (%.3g, %.3g, %.3g) mm, so that its middle lies at the origin, at which "
            "poses look; centre=false leaves it where it is",
            *(path, *(-1e3 * middle)),
        )
    vertices = vertices - middle
    to_original = np.eye(4)
    to_original[:3, 3] = middle
    to_original[:3] /= METRES[unit] * scale
    # Merged over parts as well: a group of an OBJ is often but a patch of one body.
    surface = trimesh.Trimesh(vertices, faces)
    if not materials:
        return Scene(surface, MATERIALS[material], to_original=to_original)
    chosen = tuple(MATERIALS[materials.get(name, material)] for name in file.names)
    return Scene(surface, chosen, file.part, to_original=to_original)
