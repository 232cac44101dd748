# SPDX-License-Identifier: MIT
r"""Minimise total variation plus a linear term over the unit interval.

.. math::
    \min_{0 \le u \le 1} \int g\, |\nabla u| + c\, u

The problem is convex, and the set where a minimiser exceeds one half is a global minimiser among
all sets [1]_. It is solved with a primal-dual method [2]_, from coarse to fine.

References
----------
.. [1] T. F. Chan, S. Esedoglu, M. Nikolova, "Algorithms for finding global minimizers of image
   segmentation and denoising models", SIAM J. Appl. Math. 66(5), 2006.
.. [2] A. Chambolle, T. Pock, "A first-order primal-dual algorithm for convex problems with
   applications to imaging", J. Math. Imaging Vis. 40, 2011.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

Grid = NDArray[np.float32]
PRIMAL, DUAL = 1 / 6, 1 / 2
"""Step sizes of the diagonally preconditioned method for forward differences in 3D."""
SMALLEST = 12
"""No grid of the pyramid has fewer voxels along an axis."""


def minimise(cost: Grid, tension: float, *, iterations: int = 150, tolerance: float = 1e-3) -> Grid:
    """Return u in [0, 1].

    Parameters
    ----------
    cost : (X, Y, Z) float, 1/voxel
        Cost c of a voxel that is inside.
    tension : float
        Cost g of a unit of area, in the units in which ``cost`` is one of a unit of volume.
    iterations : int
        At most so many on each grid of the pyramid; on coarser grids four times as many.
    tolerance : float
        The iteration ends when the mean change of u in a step falls below this times its mean.
    """
    with torch.inference_mode():
        found = _solve(torch.from_numpy(np.ascontiguousarray(cost, np.float32)), tension,
                       iterations, tolerance)
    return np.asarray(found.numpy())


def _solve(cost: Tensor, tension: float, iterations: int, tolerance: float) -> Tensor:
    if min(cost.shape) >= 2 * SMALLEST:
        # A coarse voxel has the mean cost of its eight; lengths double, so cost doubles.
        pad = [n % 2 for n in reversed(cost.shape)]
        padded = F.pad(cost, (0, pad[0], 0, pad[1], 0, pad[2]))
        coarse = 2 * F.avg_pool3d(padded[None, None], 2)[0, 0]
        u = _solve(coarse, tension, 2 * iterations, tolerance)
        u = F.interpolate(u[None, None], scale_factor=2, mode="nearest")[0, 0]
        u = u[: cost.shape[0], : cost.shape[1], : cost.shape[2]].contiguous()
    else:
        u = (cost < 0).float()
    dual = [torch.zeros_like(u) for _ in range(3)]
    ahead = u.clone()
    for step in range(iterations):
        length = torch.zeros_like(u)
        for axis, p in enumerate(dual):
            n = u.shape[axis]
            p.narrow(axis, 0, n - 1).add_(ahead.narrow(axis, 1, n - 1), alpha=DUAL).sub_(
                ahead.narrow(axis, 0, n - 1), alpha=DUAL
            )
            length.addcmul_(p, p)
        length.sqrt_().div_(tension).clamp_min_(1.0)
        before = u.clone()
        u.sub_(cost, alpha=PRIMAL)
        for axis, p in enumerate(dual):
            p.div_(length)
            n = u.shape[axis]
            u.add_(p, alpha=PRIMAL)
            u.narrow(axis, 1, n - 1).sub_(p.narrow(axis, 0, n - 1), alpha=PRIMAL)
        u.clamp_(0.0, 1.0)
        ahead = torch.lerp(before, u, 2.0)
        if step % 10 == 9:
            change = float((u - before).abs().sum())
            if change <= tolerance * float(u.sum()) and change < 1e-6 * u.numel():
                break
    return u
