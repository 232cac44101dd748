# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from sononerf.errors import NumericalError
from sononerf.geometry.lattice import Volume
from sononerf.report.pictures.mip_picture import maximum_intensity_projections


def test_each_projection_looks_along_its_axis():
    values = np.zeros((2, 3, 4))
    values[1, 2, 3] = 7.0
    projections = maximum_intensity_projections(Volume(values, np.zeros(3), 1.0))
    assert {name: p.shape for name, p in projections.items()} == {
        "x": (3, 4),
        "y": (2, 4),
        "z": (2, 3),
    }
    assert projections["x"][2, 3] == projections["y"][1, 3] == projections["z"][1, 2] == 7.0
    assert sum(p.sum() for p in projections.values()) == 21.0


def test_a_value_that_is_not_finite_is_refused():
    values = np.zeros((2, 3, 4))
    values[0, 0, 0] = np.inf
    with pytest.raises(NumericalError, match="1 of 24 voxels"):
        maximum_intensity_projections(Volume(values, np.zeros(3), 1.0))
