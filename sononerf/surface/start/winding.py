# SPDX-License-Identifier: MIT
"""How often a surface that is known in pieces winds around a place.

The winding number of a closed surface is one inside and zero outside. Of oriented pieces of a
surface it is the part of the sphere of directions that they fill, seen from the place: still large
inside, and negative where mostly the backs of what is outside are seen [1]_. As a field it solves
Poisson's equation, so it is found by a Fourier transform [2]_.

References
----------
.. [1] A. Jacobson, L. Kavan, O. Sorkine, "Robust inside-outside segmentation using generalized
   winding numbers", ACM TOG 32(4), 2013.
.. [2] M. Kazhdan, M. Bolitho, H. Hoppe, "Poisson surface reconstruction", 2006.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from sononerf.geometry.lattice import Grid

_AIR = 0.25  # fraction of the longest side, empty on each side: periodic images must stay apart


def winding_number(flux: Sequence[Grid]) -> Grid:
    """Return the winding number of a density of surface.

    Parameters
    ----------
    flux : three (X, Y, Z) float, 1/voxel
        Area per volume along outward normals: across a surface it adds up to one.

    Returns
    -------
    winding : (X, Y, Z) float
        Zero far away.
    """
    shape = flux[0].shape
    air = 2 * round(_AIR * max(shape))
    size = [int(fft.next_fast_len(n + air, real=True)) for n in shape]
    square = np.zeros(1, np.float32)
    total = np.zeros(1, np.complex64)
    for axis, n in enumerate(size):
        frequency = np.fft.rfftfreq(n) if axis == 2 else np.fft.fftfreq(n)
        wave = (2 * np.pi * frequency).astype(np.float32)
        wave = wave.reshape([-1 if a == axis else 1 for a in range(3)])
        square = square + wave**2
        total = total + wave * fft.rfftn(flux[axis], s=size)
    square[0, 0, 0] = 1.0  # the mean is set below
    found = fft.irfftn(1j * total / square, s=size)
    far = [
        found.take((inner + whole) // 2, axis).mean()
        for axis, (inner, whole) in enumerate(zip(shape, size, strict=True))
    ]
    x, y, z = shape
    return np.asarray(found[:x, :y, :z] - np.mean(far), dtype=np.float32)
