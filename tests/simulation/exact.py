# SPDX-License-Identifier: MIT
"""Echoes that are known in closed form, of a point source of pressure e^{-jkr} / r.

Time runs as e^{jwt}; frequencies are in Hz, lengths in metres.
"""

import numpy as np
from scipy.special import eval_legendre, exp1, spherical_jn, spherical_yn

SPEED = 343.0  # m/s


def rigid_sphere(frequency, radius, source_distance, receiver_distance, angle=0.0):
    """Scattered pressure (F,) of a rigid sphere; distances and angle as seen from its middle.

    The source's partial waves about the middle (DLMF 10.60.1 and 10.60.2 [1]_), each with an
    outgoing one that makes the normal velocity on the sphere vanish [2]_ [3]_.

    References
    ----------
    .. [1] NIST Digital Library of Mathematical Functions, section 10.60.
    .. [2] V. C. Anderson, "Sound scattering from a fluid sphere", Journal of the Acoustical
       Society of America 22, 1950, in the limit of a rigid sphere.
    .. [3] L. L. Beranek and T. J. Mellow, "Acoustics: Sound Fields, Transducers and Vibration",
       2nd edition, Academic Press 2019, section 12.4.
    """
    wavenumber = 2.0 * np.pi * np.atleast_1d(frequency) / SPEED
    found = np.zeros(len(wavenumber), dtype=complex)
    for index, k in enumerate(wavenumber):
        # From n = ka on terms fall faster than exponentially; more would overflow in the end.
        n = np.arange(int(k * radius + 8.0 * np.cbrt(k * radius)) + 10)
        reflected = spherical_jn(n, k * radius, True) / _outgoing(n, k * radius, True)
        waves = _outgoing(n, k * source_distance) * _outgoing(n, k * receiver_distance)
        terms = (2 * n + 1) * reflected * waves * eval_legendre(n, np.cos(angle))
        found[index] = 1j * k * terms.sum()
    return found


def _outgoing(order, argument, derivative=False):
    regular = spherical_jn(order, argument, derivative)
    return regular - 1j * spherical_yn(order, argument, derivative)


def disc_on_axis(frequency, radius, distance):
    """Kirchhoff's integral (F,) over a rigid disc, source and receiver on its axis.

    With R the way to a ring it is j k h times the integral of e^{-2jkR} / R^2 from the distance h
    to that of the rim: by parts, exponential integrals (DLMF 6.2.1).
    """
    k = 2.0 * np.pi * np.atleast_1d(frequency) / SPEED
    rim = np.hypot(distance, radius)

    def rest(far):
        """Integral from ``far`` to infinity."""
        return np.exp(-2j * k * far) / far - 2j * k * exp1(2j * k * far)

    return 1j * k * distance * (rest(distance) - rest(rim))


def image_source(frequency, distance):
    """Pressure (F,) from an endless rigid plane: that of a source as far behind it."""
    k = 2.0 * np.pi * np.atleast_1d(frequency) / SPEED
    return np.exp(-2j * k * distance) / (2.0 * distance)
