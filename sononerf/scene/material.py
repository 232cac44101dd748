# SPDX-License-Identifier: MIT
"""Materials: how surfaces reflect."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from sononerf.errors import InputError
from sononerf.numerics import Floats

Curve = tuple[float, ...]
BOUNDS = {
    "lobe_width": (1e-4, math.pi),
    "strength": (0.0, math.inf),
    "reflection": (0.0, 1.0),
    "curved_lobe_width": (1e-4, math.pi),
    "curved_strength": (0.0, math.inf),
    "diffraction": (0.0, math.inf),
}


@dataclass(frozen=True)
class Material:
    r"""Reflection of a surface, at nodes over frequency.

    Values are interpolated linearly over the logarithm of frequency, and are constant beyond the
    nodes. A curve with one value holds at all nodes. Where the surface is strongly curved, lobe and
    strength go over to the curved ones by the share :math:`s = 1 / (1 + e^{-8 b (\kappa -
    \kappa_0)})` of the total curvature
    :math:`\kappa = \sqrt{k_1^2 + k_2^2}` (SonoTraceLab's law, with curvature in 1/m).

    Attributes:
        frequency ((K,), Hz): Nodes, ascending.
        lobe_width ((K,), rad, or None): Standard deviation of the lobe about the mirror direction;
            None for a smooth surface, whose shape alone determines its echoes.
        strength ((K,), 1): Strength of the echo of a hit, relative to a rigid surface.
        reflection ((K,), 1): Pressure after a bounce, over that before it,
            0 to 1.
        curved_lobe_width ((K,), rad, or None): Lobe of strongly curved places; None where it is the
            same.
        curved_strength ((K,), 1, or None): Strength of strongly curved places; None where it is the
            same.
        transition_curvature (1/m): :math:`\kappa_0`, where half is curved; infinite where no place
            counts as strongly curved.
        transition_slope (m): :math:`b`.
        diffraction ((K,), 1, or None): Strength of edges and strongly curved places as sources of
            their own, relative to rigid wedges; None for none.
    """

    frequency: Curve = (20e3, 150e3)
    lobe_width: Curve | None = None
    strength: Curve = (1.0,)
    reflection: Curve = (1.0,)
    curved_lobe_width: Curve | None = None
    curved_strength: Curve | None = None
    transition_curvature: float = math.inf
    transition_slope: float = 0.002
    diffraction: Curve | None = (1.0,)

    def __post_init__(self) -> None:
        nodes = np.asarray(self.frequency, dtype=np.float64)
        positive = np.isfinite(nodes) & (nodes > 0.0)
        if len(nodes) < 1 or not positive.all() or not (np.diff(nodes) > 0.0).all():
            raise InputError(f"material frequency is {self.frequency}, expected ascending nodes")
        for name, (lowest, highest) in BOUNDS.items():
            curve = getattr(self, name)
            if curve is None:
                continue
            if len(curve) == 1:
                curve = tuple(curve) * len(nodes)
                object.__setattr__(self, name, curve)
            values = np.asarray(curve, dtype=np.float64)
            if values.shape != nodes.shape:
                raise InputError(
                    f"material {name} has {values.size} values, frequency {nodes.size}"
                )
            if not (np.isfinite(values) & (values >= lowest) & (values <= highest)).all():
                raise InputError(
                    f"material {name} is {values.tolist()}, expected {lowest:g} to {highest:g}"
                )
        if self.lobe_width is None and self.curved_lobe_width is not None:
            raise InputError("material curved_lobe_width is set, lobe_width is not; set both")
        for name in ("transition_curvature", "transition_slope"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"material {name} is {getattr(self, name)}, expected above 0")
        if math.isinf(self.transition_slope):
            raise InputError("material transition_slope is inf, expected a finite number")

    @property
    def rigid(self) -> bool:
        """True if the surface is smooth and reflects all sound at all frequencies."""
        return (
            self.lobe_width is None
            and not math.isfinite(self.transition_curvature)
            and all(value == 1.0 for value in (*self.strength, *self.reflection))
        )

    @property
    def mixed(self) -> bool:
        """Whether curvature changes anything."""
        return self.curved_lobe_width is not None or self.curved_strength is not None


def roughened(material: Material, height: float) -> Material:
    r"""Return a material with the strength of a rough surface at normal incidence.

    A surface whose height has the standard deviation :math:`\sigma` sends back the fraction
    :math:`e^{-2 (k \sigma)^2}` of the pressure in step.

    Args:
        height (m): Standard deviation of the height.

    References:
        .. [1] P. Beckmann and A. Spizzichino, "The Scattering of Electromagnetic Waves from Rough
           Surfaces", Pergamon 1963, chapter 5.
    """
    nodes = np.array([20e3, 40e3, 60e3, 80e3, 100e3, 150e3])
    in_step = np.exp(-2.0 * (2.0 * math.pi * nodes / 343.0 * height) ** 2)

    def at_nodes(curve: Curve | None, factor: Floats | float = 1.0) -> Any:
        if curve is None:
            return None
        values = np.interp(np.log(nodes), np.log(material.frequency), curve) * factor
        return tuple(values.tolist())

    return replace(
        material,
        frequency=tuple(nodes.tolist()),
        lobe_width=at_nodes(material.lobe_width),
        strength=at_nodes(material.strength, in_step),
        reflection=at_nodes(material.reflection, in_step),
        curved_lobe_width=at_nodes(material.curved_lobe_width),
        curved_strength=at_nodes(material.curved_strength, in_step),
        diffraction=at_nodes(material.diffraction),
    )


RIGID = Material()
"""Material of all bodies that are smooth and much denser than air; the level is absolute."""

SONOTRACELAB = Material(
    frequency=(20e3, 150e3),
    lobe_width=(math.radians(12.0), math.radians(4.0)),
    strength=(1.0, 0.7),
    reflection=(1.0, 0.7),
    curved_lobe_width=(math.radians(70.0), math.radians(70.0)),
    curved_strength=(0.0016, 0.002),
    transition_curvature=1000.0,
    transition_slope=0.002,
    diffraction=(0.8, 1.0),
)
"""Lobes, strengths and transition of SonoTraceLab's leaf scene, whose mesh unit is 2 mm.

Its strengths are relative: 10 for smooth places, taken as 1 here, and 0.02 for curved ones.
"""

LEAF = roughened(RIGID, 0.2e-3)
"""A leaf: far too heavy for air to move, with veins and waves of 0.2 mm."""

INSECT = roughened(RIGID, 0.1e-3)
"""Cuticle: rigid, with hairs and joints of 0.1 mm."""

MaterialName = Literal["rigid", "sonotracelab", "leaf", "insect"]
MATERIALS: dict[MaterialName, Material] = {
    "rigid": RIGID,
    "sonotracelab": SONOTRACELAB,
    "leaf": LEAF,
    "insect": INSECT,
}
