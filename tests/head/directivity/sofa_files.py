# SPDX-License-Identifier: MIT
"""SOFA files as the package `sofar` writes them."""

import numpy as np

from tests.head.directivity.patterns import FREQUENCY, PLACES, pair


def spherical(directions, radius=1.0):
    x, y, z = directions.T
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
    return np.stack([azimuth % 360, elevation, np.full(len(x), radius)], axis=1)


def written(path, convention, **changed):
    """Write the made-up pair with sofar; values of its object may be changed."""
    import sofar

    known = pair()
    sofa = sofar.Sofa(convention)
    if convention == "FreeFieldDirectivityTF":
        # sofar refuses to write its own empty defaults of these.
        sofa.delete("EmitterDescriptions")
        sofa.delete("Description")
        sofa.ReceiverPosition = spherical(known.directions)
        pressure = known.beam[None]
    else:
        sofa.SourcePosition = spherical(known.directions, 1.5)
        sofa.ReceiverPosition = PLACES if convention == "GeneralTF" else PLACES[:, :, None]
        pressure = known.gains.transpose(1, 0, 2)
    if convention == "SimpleFreeFieldHRIR":
        sofa.Data_SamplingRate = 200e3
        # An impulse of each ear's gain at 50 kHz, somewhat delayed.
        response = np.zeros((*pressure.shape[:2], 16))
        response[..., 5] = pressure[..., 1]
        sofa.Data_IR = response
    else:
        sofa.N, sofa.Data_Real, sofa.Data_Imag = FREQUENCY, pressure, np.zeros(pressure.shape)
    for name, value in changed.items():
        setattr(sofa, name, value)
    sofar.write_sofa(str(path), sofa)
    return path
