# SPDX-License-Identifier: MIT
"""Any scenes put together, by settings alone."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sononerf.errors import InputError, SettingsError
from sononerf.geometry.poses import rotation_from_euler
from sononerf.scene import MATERIALS, MaterialName, Part, Scene, compose, load_scene
from sononerf.scene.scene import LARGEST_SCALE

from .bodies import Degrees

OWN = "scene.options"
"""Key of a scene's own options in messages; within another scene the key is another."""
MOST_PARTS = 100

Metres = Annotated[float, Field(ge=-100, le=100)]
Row = tuple[float, float, float]


class PartOptions(BaseModel):
    """A scene by its name and options, and its place: scaled, then turned, then moved."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    scene: Annotated[str, Field(min_length=1)]
    options: dict[str, Any] = {}
    position: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    yaw: Degrees = 0.0
    pitch: Degrees = 0.0
    roll: Degrees = 0.0
    rotation: tuple[Row, Row, Row] | None = None
    scale: Annotated[float, Field(gt=0, le=LARGEST_SCALE)] = 1.0
    material: MaterialName | None = None
    background: bool = False

    @model_validator(mode="after")
    def _turned_once(self) -> PartOptions:
        if self.rotation is not None and {"yaw", "pitch", "roll"} & self.model_fields_set:
            raise ValueError("rotation and yaw, pitch, roll are both set; set one of them")
        return self

    def matrix(self) -> NDArray[np.float64]:
        """Return the rotation, (3, 3)."""
        if self.rotation is not None:
            return np.array(self.rotation)
        return rotation_from_euler(*np.radians((self.yaw, self.pitch, self.roll)))


def composed(
    parts: Annotated[list[PartOptions], Field(min_length=1, max_length=MOST_PARTS)],
) -> Scene:
    """Put scenes together, each at its position (m), turned (degrees or a matrix) and scaled.

    Each of ``parts`` has ``scene``, a name, and may have ``options`` of that scene, ``position``
    (m), ``yaw``, ``pitch``, ``roll`` (degrees) or ``rotation`` (3 x 3), ``scale``, ``material``,
    and ``background: true`` where it is heard but is not the target.
    """
    placed = [_part(options, f"{OWN}.parts.{number}") for number, options in enumerate(parts)]
    try:
        return compose(placed)
    except SettingsError as error:
        raise SettingsError(f"scene.options.{error}") from None


def _part(options: PartOptions, where: str) -> Part:
    return Part(
        load_within(options.scene, options.options, f"{where}.scene", f"{where}.options"),
        options.position,
        options.matrix(),
        options.scale,
        MATERIALS[options.material] if options.material else None,
        options.background,
        options.scene,
    )


def load_within(name: str, options: dict[str, Any], of_name: str, of_options: str) -> Scene:
    """Build a scene that another one holds.

    Args:
        name: Name of the scene.
        options: Options of the scene.
        of_name, of_options: Dotted keys under which they are set, for messages.

    Returns:
        scene: Checked.

    Raises:
        SettingsError, InputError: As :func:`sononerf.scene.load_scene` does, with the keys that the
            user wrote.
    """
    try:
        return load_scene(name, options)
    except (SettingsError, InputError) as error:
        said = str(error).replace(OWN, of_options)
        if not said.startswith(of_options):
            said = f"{of_name}: {said}"
        raise type(error)(said) from error
