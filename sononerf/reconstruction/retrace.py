# SPDX-License-Identifier: MIT
"""How far to believe echoes that are traced off a reconstructed surface.

A field that sums power knows no interference and no second bounce. A surface does: where it was
found to a fraction of a wavelength, calls traced off it give both. Where it was not, they give
noise. How much of each makes the best prediction is found on poses that were kept from the fit.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from sononerf.acoustics.spectrogram import compress

Array = NDArray[np.float64]
SHARES = tuple(np.linspace(0, 1, 11).tolist())
LOUD_DB = 20.0
"""Cells above this tell the gain: fainter ones are skirts and interference."""
SMOOTHING = 20
"""Steps of Taubin's smoothing [1]_, which keeps the volume: ripples of the read-out, a fraction of
a millimetre high, would bend the echoes.

References
----------
.. [1] G. Taubin, "Curve and surface smoothing without shrinkage", 1995.
"""
PASS = (0.5, 0.53)
"""Taubin's two factors: inward, outward."""


def calmed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a smoother copy of a mesh."""
    copy = trimesh.Trimesh(mesh.vertices.copy(), mesh.faces.copy(), process=False)
    return trimesh.smoothing.filter_taubin(copy, lamb=PASS[0], nu=PASS[1], iterations=SMOOTHING)


def gain_db(measured_db: ArrayLike, traced_db: ArrayLike) -> Array:
    """Return by how much each frequency was measured louder than traced, (F,) dB.

    Parameters
    ----------
    measured_db, traced_db : (..., F) float, dB
        Compressed, 0 dB is silence.

    Returns
    -------
    gain : (F,) float, dB
        Median over the cells that are loud in both; zero where none is.
    """
    measured, traced = (np.asarray(a, dtype=np.float64) for a in (measured_db, traced_db))
    count = measured.shape[-1]
    measured, traced = measured.reshape(-1, count), traced.reshape(-1, count)
    loud = (measured > LOUD_DB) & (traced > LOUD_DB)
    return np.array(
        [
            np.median((measured - traced)[loud[:, row], row]) if loud[:, row].any() else 0.0
            for row in range(count)
        ]
    )


def blend(rendered: ArrayLike, traced: ArrayLike, share: float, reference: float) -> Array:
    """Return the mean of two predictions, taken in decibels.

    Parameters
    ----------
    rendered, traced : (..., F) float
        Linear magnitudes.
    share : float
        What part the traced one has, 0 to 1.
    reference : float
        Magnitude of 0 dB.

    Returns
    -------
    magnitude : (..., F) float64
        Linear.
    """
    mean = (1 - share) * compress(rendered, reference) + share * compress(traced, reference)
    magnitude: Array = reference * (10 ** (mean / 20) - 1)
    return magnitude


def best_share(
    measured: ArrayLike, rendered: ArrayLike, traced: ArrayLike, reference: float
) -> float:
    """Return the share of the traced prediction that comes closest to what was measured.

    Parameters
    ----------
    measured, rendered, traced : (P, E, R, F) float
        Linear magnitudes, of poses that no field was fitted to.
    reference : float
        Magnitude of 0 dB.
    """
    wanted = compress(measured, reference)
    errors = [
        np.abs(compress(blend(rendered, traced, share, reference), reference) - wanted).mean()
        for share in SHARES
    ]
    return SHARES[int(np.argmin(errors))]
