# SPDX-License-Identifier: MIT
"""Maximum-intensity projections of a volume."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sononerf.surface.start.volume import Volume, require_finite


def maximum_intensity_projections(volume: Volume) -> dict[str, NDArray[np.floating]]:
    """Return the greatest value along each axis.

    Parameters
    ----------
    volume : Volume
        Values (X, Y, Z).

    Returns
    -------
    projections : dict
        ``"x"`` (Y, Z), ``"y"`` (X, Z) and ``"z"`` (X, Y), named by the axis looked along.

    Raises
    ------
    NumericalError
        If a value is not finite.
    """
    require_finite(volume)
    return {name: volume.values.max(axis=axis) for axis, name in enumerate("xyz")}
