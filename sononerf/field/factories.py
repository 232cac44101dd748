# SPDX-License-Identifier: MIT
"""Fields and renderers by name: plugins, factories and objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from sononerf.errors import InputError, SettingsError
from sononerf.field.field import Field
from sononerf.field.renderer import Renderer, tensor
from sononerf.head.head import Head
from sononerf.settings import plugins

Made = TypeVar("Made")
FieldFactory = Callable[..., Field]
"""Called with the region (2, 3), m, the frequencies (F,), Hz, and keyword options."""
RendererFactory = Callable[..., Renderer]
"""Called with the region (2, 3), m, the head, and keyword options."""


def box_of(region: ArrayLike | Tensor) -> Tensor:
    """Return a region (2, 3), m, in single precision."""
    given = region if isinstance(region, Tensor) else torch.as_tensor(np.array(region, np.float64))
    box = given.detach().to(torch.float32)
    if box.shape != (2, 3) or not bool((box[0] < box[1]).all()):
        raise SettingsError(
            f"region: found {box.tolist()}; give lower and upper corner, (2, 3) in metres, the "
            "lower below the upper on every axis"
        )
    return box


def make(
    given: Made | Callable[..., Made] | str,
    kind: type[Made],
    region: Tensor,
    head: Head | None,
    options: Mapping[str, Any],
) -> Made:
    """Return the object itself, or the one that a plugin's factory, or a factory, makes.

    In: region ((2, 3), m).
    """
    if isinstance(given, kind):
        return given
    what = kind.__name__.lower()
    group = plugins.FIELDS if issubclass(kind, Field) else plugins.RENDERERS
    factory = plugins.load(group, given) if isinstance(given, str) else given
    if not callable(factory):
        raise InputError(
            f"{what} is a {type(factory).__name__}, expected the name of a plugin, a factory or a "
            f"sononerf {kind.__name__}"
        )
    if head is None:
        raise SettingsError("head: missing; give the head that heard the echoes")
    chosen = plugins.check_options(factory, options, where=f"{what}.options", given=2)
    heard = tensor(head.frequency) if group == plugins.FIELDS else head
    if isinstance(given, str):
        result = plugins.call(f"{what} {given!r}", factory, region, heard, **chosen)
    else:
        result = factory(region, heard, **chosen)
    if not isinstance(result, kind):
        raise InputError(
            f"{given!r} makes a {type(result).__name__}, expected a sononerf {kind.__name__}"
        )
    return result
