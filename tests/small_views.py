# SPDX-License-Identifier: MIT
"""Views of meshes with few pixels, for tests of what else is made beside them."""

from __future__ import annotations

import pytest

from sononerf.report.mesh_picture import confidence_png, mesh_png, side_by_side_png


def draw_small(patch: pytest.MonkeyPatch) -> None:
    """Draw the views of meshes with a fortieth of their usual number of pixels."""
    for draw in (mesh_png, side_by_side_png, confidence_png):
        patch.setitem(draw.__kwdefaults__, "size", (144, 108))
