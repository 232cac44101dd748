# SPDX-License-Identifier: MIT
"""Reflection lobes, and the field that has one at every place.

In: places (N, 3), m, and unit directions to the emitter (N, 3). Out: magnitude of the reflection
(N, F). A lobe is strong around its axis, as a face is around its normal. Section 3 of
``docs/method.md``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from sononerf.field.field import Field

LOG_STRENGTH_FLOOR = -18.0
QUIETEST = -5.0
"""Natural logarithm of the gain, relative to the lobe's peak, below which a lobe is left out: -43
dB."""
CURVED_AFTER = 0.4
"""Fraction of the fit after which places may be curved, no unit. Earlier, places are not yet where
they belong."""
RADIUS_UNIT = 0.015
"""Radius of curvature per unit of the learned number, m. It sets how fast radii are learned."""
CODE = 5
"""Numbers of a place before the coefficients: log strength, lobe vector (x, y, z), radius."""


def along(vectors: Tensor, axes: Tensor) -> Tensor:
    """Return the scalar product of (..., N, 3) vectors with (3, N) axes, (..., N)."""
    # Unbound rather than indexed: each index would have a pass of its own in the gradient.
    (x, y, z), (a, b, c) = vectors.unbind(-1), axes.unbind(0)
    return x * a + y * b + z * c


class Lobes(NamedTuple):
    """Parameters of N lobes, one column for each."""

    strength: Tensor  # (1, N), natural logarithm
    vector: Tensor  # (3, N)
    radius: Tensor  # (1, N), in RADIUS_UNIT
    own: Tensor  # (rank, N), coefficients of the spectra that are added

    @classmethod
    def of(cls, code: Tensor) -> Lobes:
        """Read (5 + rank, N) codes."""
        return cls(*code.split((1, 3, 1, len(code) - CODE)))

    def tilt(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return m . u - |m| towards (..., N, 3), (..., N), zero on the axis; and |m|, (N,)."""
        # The small number keeps the gradient finite where there is no lobe yet.
        length = (along(self.vector.T, self.vector) + 1e-6).sqrt()
        return along(directions, self.vector) - length, length


class LobeField(Field):
    r"""A reflection lobe at every place.

    .. math::
        \rho(x, u, f) = \exp\big(a(x) + \kappa_f (m(x) \cdot u - |m(x)|) + s_f
        + c(x) \cdot b_f\big)

    :math:`a` is the log strength; the lobe vector :math:`m` points along the surface normal and
    its length is the lobe's concentration; :math:`\kappa_f` sharpens the lobe with frequency;
    :math:`s_f` is one spectrum for the whole field, to which each place adds ``rank`` spectra
    :math:`b` by coefficients :math:`c` of its own.

    A lobe stands for a piece of surface between two vertices, which is curved: at an angle
    :math:`\theta` off the axis the echo comes from :math:`R(x) (1 - \cos\theta)` nearer. Without
    the radius of curvature :math:`R`, learned late, all echoes off the axis would be too far, and
    the places would move outward to make up for it. Without a lobe there is no axis, so the lead
    fades with the lobe, by :math:`1 - e^{-|m|^2}`; this matters below :math:`|m| = 2`.

    In: region ((2, 3), m), frequency ((F,), Hz).
    """

    learning_rate = 0.05
    curved: Tensor

    def __init__(self, region: Tensor, frequency: Tensor, rank: int) -> None:
        super().__init__(region, frequency)
        count = len(frequency)
        self.rank = min(rank, count - 1)
        self.register_buffer("curved", torch.zeros(()))
        self.spectrum = nn.Parameter(torch.zeros(count))
        self.sharpness = nn.Parameter(torch.zeros(count))
        # The initial spectra are cosines over frequency, the slowest first.
        phase = (torch.arange(count) + 0.5) * (math.pi / count)
        basis = torch.cos(torch.arange(1, self.rank + 1)[:, None] * phase)
        self.basis = nn.Parameter(basis) if self.rank else None

    def code(self, positions: Tensor) -> Tensor:
        """Return the parameters of places (N, 3), (N, 5 + rank).

        Log strength, lobe vector, radius of curvature in ``RADIUS_UNIT``, coefficients.
        """
        raise NotImplementedError

    def advance(self, step: int, total: int) -> None:
        """Learn the radii of curvature once the places are nearly right."""
        self.curved.fill_(float(step >= CURVED_AFTER * total))

    # Below, numbers of a place and frequencies come first in memory: what is done to them then
    # runs along the places, several times as fast as along three or six neighbours.

    def _spectrum(self, own: Tensor, bins: Tensor | slice) -> Tensor:
        """Return the log spectrum along the axis: (B, 1), or (B, N) where places have their own."""
        spectrum = self.spectrum[bins, None]
        if self.basis is None:
            return spectrum
        return spectrum + self.basis[:, bins].T @ own

    def _log_response(self, lobes: Lobes, tilt: Tensor, bins: Tensor | None) -> Tensor:
        """Return the log reflectivity of N lobes seen at a (..., N) tilt, (..., N, B)."""
        which = slice(None) if bins is None else bins
        strength = lobes.strength.clamp_min(LOG_STRENGTH_FLOOR) + self._spectrum(lobes.own, which)
        sharpness = self.sharpness[which].exp()[:, None]
        for _ in range(tilt.ndim - 1):
            strength, sharpness = strength[:, None], sharpness[:, None]
        return (sharpness * tilt + strength).movedim(0, -1)

    def select(self, positions: Tensor, directions: Tensor, bins: Tensor | None) -> Tensor:
        """Return the reflectivity of (N, 3) places towards (..., N, 3) directions."""
        lobes = Lobes.of(self.code(positions).T)
        tilt, _ = lobes.tilt(directions)
        response = self._log_response(lobes, tilt, bins).exp()
        return response * self.inside(positions)[:, None]

    @torch.no_grad()
    def audible(self, positions: Tensor, sources: Tensor, code: Tensor | None = None) -> Tensor:
        """Return the mask (P, N) of places that reflect towards emitters; by the lobe alone."""
        lobe = (self.code(positions) if code is None else code).T[1:4]
        distance = torch.cdist(sources, positions, compute_mode="donot_use_mm_for_euclid_dist")
        towards = sources @ lobe - along(positions, lobe)
        tilt = towards / distance.clamp_min(1e-6) - along(lobe.T, lobe).sqrt()
        return tilt * self.sharpness.min().exp() > QUIETEST

    def echo(
        self,
        positions: Tensor,
        directions: Tensor,
        bins: Tensor | None,
        place: Tensor | None = None,
        code: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return the reflectivity, (M, B), and how much nearer than its place it arises, (M,) m."""
        code = (self.code(positions) if code is None else code).T
        outside = self.outside(positions)
        if place is not None:
            code = code.index_select(1, place)
            outside = None if outside is None else outside.index_select(0, place)
        lobes = Lobes.of(code)
        tilt, length = lobes.tilt(directions)
        response = self._log_response(lobes, tilt, bins).exp()
        if outside is not None:
            response = response.masked_fill(outside[:, None], 0.0)
        with torch.no_grad():  # the error in range must not rotate the lobes
            off = tilt / length * torch.expm1(-length.square())  # (1 - cos)(1 - exp(-|m|^2))
            off *= RADIUS_UNIT * self.curved
        return response, lobes.radius.squeeze(0) * off

    def forward(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Return the reflectivity, (..., F) float."""
        shape = torch.broadcast_shapes(positions.shape, directions.shape)
        flat = positions.expand(shape).reshape(-1, 3)
        response = self.select(flat, directions.expand(shape).reshape(-1, 3), None)
        return response.reshape(*shape[:-1], response.shape[-1])

    @torch.no_grad()
    def energy(self, positions: Tensor, directions: int) -> Tensor:
        r"""Return the energy of the lobe, exact where a lattice would be too coarse.

        The mean over the sphere of :math:`e^{2k(\cos - 1)}` is :math:`(1 - e^{-4k})/(4k)`.
        """
        del directions
        lobes = Lobes.of(self.code(positions).T)
        length = along(lobes.vector.T, lobes.vector).sqrt()
        concentration = length * self.sharpness.exp()[:, None]
        mean = -torch.expm1(-4 * concentration) / (4 * concentration).clamp_min(1e-12)
        mean = torch.where(concentration > 1e-6, mean, torch.ones_like(mean))
        strength = lobes.strength.clamp_min(LOG_STRENGTH_FLOOR)
        power = (2 * (strength + self._spectrum(lobes.own, slice(None)))).exp() * mean
        return power.sum(0) * self.inside(positions)
