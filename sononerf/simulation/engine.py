# SPDX-License-Identifier: MIT
"""Base of all engines: a scene, a head in air, and the paths between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from sononerf.array_types import Floats
from sononerf.geometry.raycast import RayCaster
from sononerf.scene.scene import Scene
from sononerf.simulation.audibility import Arrival
from sononerf.simulation.hearing import Hearing
from sononerf.simulation.reflection import Reflection, reflection


class Engine:
    """Base of engines: the sound of a scene at the ears of a pose.

    Attributes:
        reflections: The scene's materials at the nodes of the synthesis.
        note: Note to the user about the simulation of this scene; may be empty.
        prepares: True if :meth:`prepare` does all the work, so that nothing is left for other
            processes.
    """

    prepares: ClassVar[bool] = False

    @property
    def parts(self) -> int:
        """Number of parts of :meth:`prepare`; 0 if it does nothing."""
        return 0

    def __init__(self, scene: Scene, hearing: Hearing) -> None:
        self.scene = scene
        self.hearing = hearing
        nodes = hearing.synthesis.nodes
        self.reflections: tuple[Reflection, ...] = tuple(
            reflection(material, nodes, speed_of_sound=hearing.speed_of_sound)
            for material in scene.materials
        )
        self.note = ""
        self._caster: RayCaster | None = None
        self._arrival: Arrival | None = None

    def __getstate__(self) -> dict[str, Any]:
        # The search tree cannot be pickled; who receives the mesh builds it anew.
        return {**self.__dict__, "_caster": None}

    @property
    def caster(self) -> RayCaster:
        """The scene's ray caster, built when it is first needed."""
        if self._caster is None:
            self._caster = RayCaster(self.scene.mesh)
        return self._caster

    @property
    def arrival(self) -> Arrival:
        """The shortest ways over the scene's surface, known when they are first needed."""
        if self._arrival is None:
            self._arrival = Arrival(self.scene)
        return self._arrival

    def prepare(
        self,
        positions: Floats,
        rotations: Floats,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Compute whatever can be computed for all poses at once.

        Args:
            positions ((P, 3), m): Places of the head, world frame.
            rotations (P, 3, 3): Head to world.
        """

    def echo(self, position: Floats, rotation: Floats, *, seed: int) -> Floats:
        """Pressure at both ears for a call that is one sample of height 1.

        Args:
            position ((3,), m): Place of the head, world frame.
            rotation (3, 3): Head to world.

        Returns:
            echo (E, S): From the emission to the end of the last analysis frame.
        """
        raise NotImplementedError

    def hits(self, position: Floats, rotation: Floats, *, seed: int) -> tuple[Floats, Floats]:
        """Return places that send sound straight back, and their strength.

        Position, rotation and seed are those of :meth:`echo`.

        Returns:
            points ((N, 3), m): World frame.
            strength (N,): Relative echo of a patch of one size at both ears, zero or more.
        """
        raise NotImplementedError
