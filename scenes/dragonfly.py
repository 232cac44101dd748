# SPDX-License-Identifier: MIT
"""A dragonfly that sits on a leaf: head and eyes, thorax, abdomen, four wings, six legs.

Places on the body are (ahead, left) of its middle, as shares of its length: the head ends at 0.5,
the abdomen at -0.5. The body follows the leaf at a height; the wings are stiff.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from sononerf.errors import SettingsError

from .blade import Blade
from .bodies import SIDE, ball, rounded
from .loft import evenly, loft
from .sheet import Outline, filled, two_sided

Values = NDArray[np.float64]

STAND = 4.3e-3
"""Distance between the leaf and the body's underside, m."""
THORAX = (0.425, 0.15, 0.062)
"""Front, end and greatest radius."""
ABDOMEN = (0.18, -0.5, 0.032)
SEGMENTS = 10
WAIST, WAISTED = 0.22, 0.28
"""Place of the abdomen's waist, from its front, and depth of the waist."""
FURROW = 0.14
"""Depth of the furrows between segments, radii."""
HEAD, HEAD_SIZE = 0.44, (0.036, 0.056, 0.04)
"""Place of the head's middle, and its half axes ahead, to the left and up."""
EYE, EYE_SIZE = (0.46, 0.034, 0.01), (0.036, 0.036, 0.042)
"""Place of the left eye's middle: ahead, left and above the head's; and its half axes."""
LEG_ROOTS = (0.36, 0.30, 0.24)
FEET = ((0.50, 0.13), (0.32, 0.20), (0.10, 0.17))
"""Places of the left feet: ahead and left."""
LEG = 0.0065
GRIP = 1e-4
"""Depth of the feet in the leaf, m, so that they touch it."""
WING_SPAN, WING_ROOT = 0.72, 0.035
WINGS = ((0.335, 0.012, 8.0, 0.155), (0.225, 0.0, -12.0, 0.185))
"""Fore and hind: root ahead and above the thorax's back, sweep forward (degrees), chord."""
WING_THICKNESS = 3e-4
WING_CLEARANCE = 2.5e-3
"""Least distance between wings and leaf, m."""
LOWEST, HIGHEST = -6, 70
"""Smallest and largest elevation of the wings, degrees."""
WING_SPACING = 0.7 * SIDE
MARGIN = 2e-3
"""Least distance of body and feet from the leaf's edge, m."""


@dataclass(frozen=True, eq=False)
class Seat:
    """Where a dragonfly sits.

    Attributes:
        blade: The leaf.
        along, across (m): Place of the body's middle.
        heading (rad): About the leaf's normal; 0 looks to the tip.
        length (m): Length of the body.
    """

    blade: Blade
    along: float
    across: float
    heading: float
    length: float

    def places(self, ahead: Values, left: Values) -> tuple[Values, Values]:
        """Return the places along and across the leaf, in m, of places on the body."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        # Who stands on +x and looks along +z has +y to his right.
        along = self.along + self.length * (ahead * cos - left * sin)
        across = self.across - self.length * (ahead * sin + left * cos)
        return along, across

    def holds(self) -> bool:
        """Whether body and feet stay over the leaf."""
        ahead, left = np.array([*[(x, 0.0) for x in np.linspace(-0.5, 0.5, 21)], *FEET]).T
        both = np.concatenate([ahead, ahead]), np.concatenate([left, -left])
        outline = self.blade.outline
        return bool(outline.contains(np.stack(self.places(*both), axis=1), MARGIN).all())

    def axis(self, ahead: Values, above: Values) -> tuple[Values, Values, Values, Values]:
        """Return points over the leaf and the directions ahead, left and up there, each (N, 3).

        `above` (N,) is in m, from the height at which the body's underside stands.
        """
        points, up, tip = self.blade.frames(*self.places(ahead, np.zeros_like(ahead)))
        right = np.cross(tip, up)
        forward = np.cos(self.heading) * tip - np.sin(self.heading) * right
        return points + (STAND + above)[:, None] * up, forward, np.cross(up, forward), up


def dragonfly_on(seat: Seat) -> trimesh.Trimesh:
    """Build a dragonfly.

    Args:
        seat: Place on the leaf; body and feet must be over the leaf.

    Returns:
        mesh: Closed bodies that overlap, in the leaf's frame before that is turned.

    Raises:
        SettingsError: If the leaf is curled so tightly that there is no room for the wings.
    """
    parts = [*_head(seat), _thorax(seat), _abdomen(seat)]
    for side in (1.0, -1.0):
        parts += [_leg(seat, pair, side) for pair in range(3)]
    parts += _wings(seat)
    mesh = trimesh.util.concatenate(parts)
    return rounded(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _ellipsoid(centre: Values, axes: Values, size: Values) -> trimesh.Trimesh:
    """Build an ellipsoid of half axes (3,) m along the rows of axes (3, 3)."""
    body = ball(np.zeros(3), float(size.max()))
    unit = np.asarray(body.vertices) / size.max()
    return trimesh.Trimesh(centre + (unit * size) @ axes, body.faces, process=False)


def _head(seat: Seat) -> list[trimesh.Trimesh]:
    size = seat.length * np.array(HEAD_SIZE)
    centre, *axes = (a[0] for a in seat.axis(np.array([HEAD]), size[2:]))
    frame = np.stack(axes)
    parts = [_ellipsoid(centre, frame, size)]
    ahead, left, above = EYE
    for side in (1.0, -1.0):
        off = seat.length * np.array([ahead - HEAD, side * left, above])
        parts.append(_ellipsoid(centre + off @ frame, frame, seat.length * np.array(EYE_SIZE)))
    return parts


def _thorax_height(seat: Seat) -> float:
    """Return how high its middle line is above the underside, in m."""
    return THORAX[2] * seat.length


def _thorax(seat: Seat) -> trimesh.Trimesh:
    front, end, radius = THORAX
    count = int(np.ceil(np.pi * (front - end) * seat.length / SIDE))
    turn = np.linspace(0.0, np.pi, count + 1)
    ahead = 0.5 * (front + end) + 0.5 * (front - end) * np.cos(turn)
    # It hangs from its back: fuller than an ellipsoid, and highest in front.
    lift = np.full(len(ahead), _thorax_height(seat))
    path = seat.axis(ahead, lift)[0]
    return loft(path, radius * seat.length * np.sin(turn) ** 0.8)


def _abdomen(seat: Seat) -> trimesh.Trimesh:
    front, end, radius = ABDOMEN
    length = (front - end) * seat.length
    count = max(10 * SEGMENTS, int(np.ceil(length / SIDE)))
    share = np.linspace(0.0, 1.0, count + 1)
    furrows = FURROW * np.cos(np.pi * SEGMENTS * share) ** 16
    waist = WAISTED * np.exp(-(((share - WAIST) / 0.13) ** 2))
    ends = np.minimum(1.0, np.minimum(share / 0.03, (1.0 - share) / 0.03))
    slender = 1.0 - 0.3 * share
    profile = radius * seat.length * slender * (1.0 - waist) * (1.0 - furrows) * ends**0.5
    # From within the thorax down to where its own underside stands as high.
    above = np.interp(
        share, [0.0, 0.2, 1.0], [0.75 * _thorax_height(seat), radius * seat.length, 1.2e-3]
    )
    path = seat.axis(front + (end - front) * share, above)[0]
    return loft(path, profile)


def _leg(seat: Seat, pair: int, side: float) -> trimesh.Trimesh:
    height = np.array([_thorax_height(seat)])
    root, _, left, up = (a[0] for a in seat.axis(np.array([LEG_ROOTS[pair]]), height))
    radius = THORAX[2] * seat.length
    start = root + 0.4 * radius * side * left - 0.4 * radius * up
    ahead, out = FEET[pair]
    places = seat.places(np.array([ahead]), np.array([side * out]))
    foot, normal, _ = (a[0] for a in seat.blade.frames(*places))
    foot = seat.blade.upper(*places)[0] - GRIP * normal
    knee = start + 0.5 * (foot - start) + (0.5 * STAND + 0.03 * seat.length) * up
    ankle = foot + 0.12 * (start - foot) + 0.25e-3 * normal
    path = evenly([start, knee, ankle, foot])
    thin = LEG * seat.length * np.linspace(1.0, 0.6, len(path))
    return loft(path, thin)


def _wings(seat: Seat) -> list[trimesh.Trimesh]:
    height = np.array([_thorax_height(seat)])
    wings = []
    for ahead, above, sweep, chord in WINGS:
        root, forward, left, up = (a[0] for a in seat.axis(np.array([ahead]), height))
        root = root + (0.6 * THORAX[2] + above) * seat.length * up
        places, triangles = filled(_wing_outline(seat.length, chord), WING_SPACING)
        for side in (1.0, -1.0):
            start = root + 0.5 * WING_ROOT * seat.length * side * left
            for raised in range(LOWEST, HIGHEST + 1):
                out = side * np.cos(np.radians(raised)) * left + np.sin(np.radians(raised)) * up
                span = np.cos(np.radians(sweep)) * out + np.sin(np.radians(sweep)) * forward
                aft = np.sin(np.radians(sweep)) * out - np.cos(np.radians(sweep)) * forward
                middle = start + places @ np.stack([span, -aft])
                normal = np.cross(span, -aft)
                half = 0.5 * WING_THICKNESS * normal
                if _is_clear(seat.blade, middle):
                    break
            else:
                raise SettingsError(
                    "scene.options: the leaf is curled too tightly for the wings; lower curl or "
                    "body_length, or raise width"
                )
            # The outline runs counter-clockwise seen from where the normal points.
            wings.append(two_sided(middle + half, middle - half, triangles))
    return wings


def _wing_outline(length: float, chord: float) -> Outline:
    """Return a wing's outline over its span: a straight leading edge, narrow at its root."""
    turn = np.linspace(0.0, np.pi, 120)
    share = 0.5 - 0.5 * np.cos(turn)
    # Half an ellipse at the tip, and a taper to the stalk at the root.
    tip = np.sqrt(np.clip(1.0 - (share.clip(min=0.55) - 0.55) ** 2 / 0.45**2, 0.0, 1.0))
    root = 0.3 + 0.7 * np.sin(0.5 * np.pi * np.clip(share / 0.5, 0.0, 1.0))
    width = chord * length * root * tip
    span = WING_SPAN * length * share
    # The middle of the tip lies a quarter behind the leading edge.
    front = 0.25 * chord * length * tip
    return Outline(span, front - width, front)


def _is_clear(blade: Blade, points: Values) -> bool:
    """Whether points are high enough above the leaf, or beside it."""
    along, across, _ = blade.unplaced(points)
    over = blade.outline.contains(np.stack([along, across], axis=1), -WING_CLEARANCE)
    return not over.any() or bool(blade.clearance(points[over]).min() >= WING_CLEARANCE)
