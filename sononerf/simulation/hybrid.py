# SPDX-License-Identifier: MIT
"""Engine `hybrid`: low frequencies by the wave equation, high ones by rays, added in phase."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sononerf.array_types import Floats
from sononerf.scene.scene import Scene
from sononerf.simulation.engine import Engine
from sononerf.simulation.equivalent_sources import THIN, Sources, resolved_frequency, sources_worth
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.rays import Rays

FALL = 1.3
"""Highest frequency of the low band over the one from which it gives way to the rays. A wider
crossing keeps more of the error of the rays, a narrower one rings longer."""
WORTH = 1.5
"""Least highest frequency of the low band over the lowest analysed one; below, little is gained."""
LARGEST_ERROR = 0.1
"""Error of the velocity on the surface above which the rays do all; 10 % is about 1 dB."""


class Hybrid(Engine):
    """Echoes by equivalent sources at low frequencies and by rays at high ones.

    Rays do not simulate sound that creeps around a body. Where ka is below about 8 they are
    wrong by several decibels. At these frequencies the wave equation of small bodies is cheap.
    Both engines give pressure with level and delay, so they are added. Between the bands the low
    one falls as a raised cosine, and the high one rises.
    """

    def __init__(self, low: Sources, high: Rays) -> None:
        super().__init__(high.scene, high.hearing)
        self.low, self.high = low, high

    @property
    def parts(self) -> int:
        """Frequencies of the low band; see :meth:`prepare`."""
        return self.low.parts

    def prepare(
        self,
        positions: Floats,
        rotations: Floats,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Solve for the low band of all poses at once; see :meth:`Solved.prepare`."""
        self.low.prepare(positions, rotations, progress)

    def echo(self, position: Floats, rotation: Floats, *, seed: int) -> Floats:
        """Pressure at both ears; see :meth:`Engine.echo`."""
        echo = self.low.echo(position, rotation, seed=seed)
        echo += self.high.echo(position, rotation, seed=seed)
        return echo

    def hits(self, position: Floats, rotation: Floats, *, seed: int) -> tuple[Floats, Floats]:
        """Places that send sound straight back, by the rays; see :meth:`Engine.hits`."""
        return self.high.hits(position, rotation, seed=seed)


def tracer_of(engine: Engine) -> Rays | None:
    """Return the part of an engine that traces rays; None if it has none."""
    if isinstance(engine, Hybrid):
        return engine.high
    return engine if isinstance(engine, Rays) else None


def hybrid(
    scene: Scene,
    hearing: Hearing,
    *,
    sources: int,
    frequency_min: float,
    **rays: Any,
) -> Engine:
    """Return the hybrid engine, or the rays alone if the low band cannot be solved for.

    Args:
        frequency_min (Hz): The lowest that is analysed.

    Returns:
        engine: Rays where a surface is open, not rigid, too large or too thin; its ``note`` says
            why.
    """
    most = min(sources, sources_worth(scene))
    found = _low_band(scene, hearing, most, frequency_min)
    if isinstance(found, str):
        alone = Rays(scene, hearing, **rays)
        alone.note = f"rays at all frequencies, because {found}"
        return alone
    band = 1.0 - found.taper(hearing.synthesis.frequency)
    both = Hybrid(found, Rays(scene, hearing, band=band, **rays))
    both.note = (
        f"wave equation up to {found.frequency_full / 1e3:.0f} kHz with {most} sources, "
        f"rays from {found.frequency_max / 1e3:.0f} kHz on"
    )
    return both


def _low_band(
    scene: Scene,
    hearing: Hearing,
    most: int,
    frequency_min: float,
) -> Sources | str:
    """Return the engine of the low band, or the reason for its absence."""
    if not all(material.rigid for material in scene.materials):
        return "a material is not rigid"
    if not scene.mesh.is_watertight:
        return "the surface is open"
    highest = resolved_frequency(scene, most, speed_of_sound=hearing.speed_of_sound)
    if highest < WORTH * frequency_min:
        return (
            f"the scene is so large that {most} sources reach {highest / 1e3:.2g} kHz; "
            "simulation.sources raises that"
        )
    low = Sources(scene, hearing, most=most, fall=FALL)
    if low.thin > THIN:
        return "the body is too thin for equivalent sources"
    error = low.trial()
    if error > LARGEST_ERROR:
        return f"equivalent sources err by {100 * error:.0f} % on the surface"
    return low
