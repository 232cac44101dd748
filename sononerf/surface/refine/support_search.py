# SPDX-License-Identifier: MIT
"""Search for the support under a body, from a surface that was fitted without it.

A support is a mirror. Without it a fit takes the image for a part of the body that hangs below the
support. The upper part of the surface is surely body. It is heard together with its image in
supports at trial heights, and the height that explains the echoes best is the support's. What lies
below the part is the same for all heights, so that it does not matter which of it is body.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sononerf.array_types import Floats
from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError
from sononerf.head.head import Head
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.self_calibration import Calibrator

UP = (0.0, 0.0, 1.0)
"""Normal of a support that is searched for: a table is level."""
MIDDLE = 0.5
"""Height at which the upper part begins in the first search, as a fraction of the surface's height:
a body and its image are equally high."""
CUTS = (1.0, 2.0, 3.0)
"""Heights above the first answer at which the upper part begins afterwards, range resolutions.
Lower is better as long as no part of the image is included; the spread of the answers is the
uncertainty of the height."""
NEAR = 3.0
"""Half width of the second search around the first answer, range resolutions."""


def with_support(head: Head, height: float) -> Head:
    """Return a head above a level support at a height, m, world frame."""
    given = {"point": (0.0, 0.0, height), "normal": UP}
    return dataclasses.replace(head, support=head.support.model_copy(update=given))


def above(mesh: trimesh.Trimesh, height: float) -> trimesh.Trimesh:
    """Return the part of a mesh that lies above a height, m."""
    kept = (np.asarray(mesh.triangles)[:, :, 2] > height).all(axis=1)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[kept])


def find_support(
    mesh: trimesh.Trimesh, echoes: Echoes, shown: Callable[[float], None]
) -> tuple[float, float]:
    """Return the height of a level support and its standard deviation, m, world frame."""
    low, high = mesh.bounds[:, 2]
    step = echoes.head.resolution / 2.0
    if high - low < 8.0 * step:
        raise InputError("the surface is too flat to tell what it stands on; measure the support")

    def search(begin: float, heights: Floats, first: float, last: float) -> float:
        part, errors = above(mesh, begin), []
        for row, height in enumerate(heights.tolist()):
            heard = Echoes(echoes.store, with_support(echoes.head, height), echoes.hull)
            work = Calibrator(part, heard, Optics(heard.head), (), dependent=1.0)
            errors.append(work.error())
            shown(first + (last - first) * (row + 1) / len(heights))
        return float(heights[0] + step * least(errors))

    middle = low + MIDDLE * (high - low)
    about = search(middle, np.arange(low - 2.0 * step, middle, step), 0.0, 0.4)
    reach = 2.0 * step * NEAR
    found = []
    for number, cut in enumerate(CUTS):
        begin = about + 2.0 * step * cut
        heights = np.arange(about - reach, min(begin, about + reach), step)
        share = 0.4 + 0.6 * np.array([number, number + 1]) / len(CUTS)
        found.append(search(begin, heights, *share))
    spread = float(np.std(found, ddof=1))
    return float(np.median(found)), math.hypot(spread, step / math.sqrt(12.0))


def least(values: ArrayLike) -> float:
    """Return where a row of values (N,) is least, between two of them too."""
    row = np.asarray(values, dtype=np.float64)
    at = int(row.argmin())
    if at in (0, len(row) - 1):
        return float(at)
    before, here, after = row[at - 1 : at + 2].tolist()
    bend = before - 2.0 * here + after
    return at + (0.5 * (before - after) / bend if math.isfinite(bend) and bend > 0.0 else 0.0)
