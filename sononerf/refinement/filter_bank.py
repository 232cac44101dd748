# SPDX-License-Identifier: MIT
"""Filter bank: power in the rows of a spectrogram from echoes with a strength per frequency node.

Echoes are laid into time bins per node; the bins' spectra, each with the part of the spectrum that
its node stands for, are added up; each row of the spectrogram is a filter of that, with its own,
call and dechirp in it, and is transformed back at the rate of its frames. For any call this equals
:func:`sononerf.head.front_end.spectrogram` of the simulator's echo. Echoes of surfaces grow with
the frequency, and come a quarter of a period early; those of edges do neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.fft
import torch
from torch import Tensor, nn

from sononerf.head.head import Head
from sononerf.numerics import Floats, Ints
from sononerf.simulation.impulse_response import between

FINE = 5.0
"""Least number of time bins per period of the highest frequency; quadratic splines between them err
by 0.3 %."""


Source = Literal["surface", "edge"]


@dataclass(frozen=True, eq=False)
class Arrivals:
    """Echoes, one row each."""

    strength: Tensor  # (Q,) float32: Strengths
    at: Tensor  # (Q,) float32: Arrival times, in samples from the start of the first frame
    weight: Tensor  # (Q, N') float32: Factors at the kept nodes
    receiver: Tensor  # (Q,): Index of the receiver


class FilterBank:
    """Filters of one call and spectrogram, computed at the first use of a length.

    In: nodes ((N,), Hz), soft (Hz).

    Attributes:
        kept_nodes (N',): Indices of the nodes that the analysed band needs.
        finer: Time bins per sample.
        spacing (Hz): Spacing of the nodes.
    """

    def __init__(self, head: Head, nodes: Floats, soft: float) -> None:
        self.head, self.spectrogram, self.nodes, self.soft = head, head.spectrogram, nodes, soft
        self.filters = head.row_filters
        rate = self.spectrogram.sampling_rate
        self._band = self.filters.band
        self.spacing = 2.0 * float(nodes[0])
        self._top = self.spacing * len(nodes)
        # Interpolation uses nodes on both sides; the ones beyond the band hardly count.
        self.kept_nodes: Ints = np.flatnonzero(nodes <= self._band[1] + self.spacing)
        self.finer = max(1, math.ceil(FINE * self._band[1] / rate))
        self._filters: dict[tuple[int, str], tuple[Tensor, Tensor, Tensor]] = {}

    def power(self, arrivals: Mapping[Source, Arrivals], *, receivers: int, frames: int) -> Tensor:
        """Power of echoes in each frame and row.

        Out: power ((receivers, frames, F) float32).
        """
        length = frames * self.spectrogram.hop * self.finer
        spectra = []
        for source, some in arrivals.items():
            first, at = some.receiver * length, some.at * self.finer
            bins = _Deposit.apply(some.strength, at, some.weight, first, (receivers, length))
            basis, rows = self._filter(frames, source, bins)
            spectrum = torch.fft.rfft(bins.transpose(1, 2))[..., : basis.shape[1]]
            spectra.append((spectrum * basis).sum(1))
        return self._rows(torch.stack(spectra).sum(0), rows, frames)

    def _filter(self, frames: int, source: Source, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nodes' spectra (N, K) and the rows' filters (F, K'), complex64."""
        key = (frames, str(like.device))
        if key not in self._filters:
            self._filters[key] = self._make_filter(frames, like)
        surface, edge, rows = self._filters[key]
        return (surface if source == "surface" else edge), rows

    def _make_filter(self, frames: int, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        spectrogram, rate = self.spectrogram, self.spectrogram.sampling_rate
        length = frames * spectrogram.hop
        step = rate / length
        most = min(math.floor(self._band[1] / step), length // 2)
        least = max(math.ceil(self._band[0] / step), -most)
        low = max(0, -least)
        number = np.arange(-low, most + 1)
        frequency = number * step
        absolute = np.abs(frequency[low:])
        hats = between(np.minimum(absolute, self._top), self.nodes)[0][:, self.kept_nodes]
        fine = self.finer * rate
        edge = (hats / np.sinc(absolute / fine)[:, None] ** 3).T
        surface = edge * (absolute * 1j + np.hypot(absolute, self.soft))
        filters = self.filters
        time = np.arange(filters.envelope.shape[1]) + filters.origin
        rows = np.stack(
            [
                np.exp(2j * np.pi / rate * np.outer(frequency - row, time)) @ envelope
                for row, envelope in zip(filters.frequency, filters.envelope, strict=True)
            ]
        )
        call = self.head.waveform
        rows = rows * (
            np.exp(-2j * np.pi / rate * np.outer(frequency, np.arange(len(call)))) @ call
        )
        rows = rows * np.exp(2j * np.pi * np.outer(self.head.delay, frequency))
        rows = rows / spectrogram.hop
        made = (torch.as_tensor(part.astype(np.complex64)) for part in (surface, edge, rows))
        first, second, third = (part.to(like.device) for part in made)
        return first, second, third

    def _rows(self, spectrum: Tensor, rows: Tensor, frames: int) -> Tensor:
        """Power (Q, W, F) in each row, of spectra (Q, K) from frequency zero on."""
        low = rows.shape[1] - self._positive(frames)
        whole = torch.cat([spectrum[:, 1 : low + 1].flip(1).conj(), spectrum], dim=1)
        whole = whole[:, : rows.shape[1]]
        filtered = whole[:, None] * rows[:, : whole.shape[1]]
        short = -filtered.shape[2] % frames
        filtered = nn.functional.pad(torch.view_as_real(filtered), (0, 0, 0, short))
        folded = torch.view_as_complex(filtered.contiguous()).unflatten(2, (-1, frames)).sum(2)
        # A shift of the spectrum turns the phase alone.
        echo = torch.fft.ifft(folded)
        return (echo.real.square() + echo.imag.square()).transpose(1, 2)

    def _positive(self, frames: int) -> int:
        step = self.spectrogram.sampling_rate / (frames * self.spectrogram.hop)
        return min(math.floor(self._band[1] / step), frames * self.spectrogram.hop // 2) + 1


class _Deposit(torch.autograd.Function):
    """Lay echoes into time bins by quadratic splines; the bins' numbers have no gradient path."""

    @staticmethod
    def forward(
        ctx: Any, strength: Tensor, at: Tensor, weight: Tensor, first: Tensor, size: tuple[int, int]
    ) -> Tensor:
        near = torch.round(at).clamp(1, size[1] - 2)
        off = at - near
        rows = first + near.long()
        value = strength[:, None] * weight
        bins = torch.zeros(size[0] * size[1], weight.shape[1], dtype=at.dtype, device=at.device)
        parts = (0.5 * (0.5 - off) ** 2, 0.75 - off**2, 0.5 * (0.5 + off) ** 2)
        for shift, part in zip((-1, 0, 1), parts, strict=True):
            bins.index_add_(0, rows + shift, value * part[:, None])
        ctx.save_for_backward(strength, off, weight, rows)
        ctx.save_for_forward(strength, off, weight, rows)
        ctx.bins, ctx.size = bins.shape, size
        return bins.view(*size, -1)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        strength, off, weight, rows = ctx.saved_tensors
        to_strength, to_at, to_weight = tangents[:3]
        value = strength[:, None] * weight
        moved = torch.zeros_like(value)
        if to_strength is not None:
            moved = moved + to_strength[:, None] * weight
        if to_weight is not None:
            moved = moved + strength[:, None] * to_weight
        late = torch.zeros_like(off) if to_at is None else to_at
        bins = torch.zeros(ctx.bins, dtype=value.dtype, device=value.device)
        parts = (0.5 * (0.5 - off) ** 2, 0.75 - off**2, 0.5 * (0.5 + off) ** 2)
        slopes = (off - 0.5, -2.0 * off, off + 0.5)
        for shift, part, slope in zip((-1, 0, 1), parts, slopes, strict=True):
            row = moved * part[:, None] + value * (slope * late)[:, None]
            bins.index_add_(0, rows + shift, row)
        return bins.view(*ctx.size, -1)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor | None, None, None]:
        strength, off, weight, rows = ctx.saved_tensors
        flat = grads[0].reshape(-1, weight.shape[1])
        parts = (0.5 * (0.5 - off) ** 2, 0.75 - off**2, 0.5 * (0.5 + off) ** 2)
        if not ctx.needs_input_grad[2]:
            low, middle, high = (
                torch.einsum("qn,qn->q", flat[rows + shift], weight) for shift in (-1, 0, 1)
            )
            to_strength = low * parts[0] + middle * parts[1] + high * parts[2]
            to_place = strength * ((off - 0.5) * low - 2.0 * off * middle + (off + 0.5) * high)
            return to_strength, to_place, None, None, None
        # Each bin's gradient is read once for all three.
        slopes = (off - 0.5, -2.0 * off, off + 0.5)
        to_bins, to_place = torch.zeros_like(weight), torch.zeros_like(strength)
        for shift, part, slope in zip((-1, 0, 1), parts, slopes, strict=True):
            near = flat[rows + shift]
            to_bins = torch.addcmul(to_bins, near, part[:, None])
            to_place = torch.addcmul(to_place, torch.einsum("qn,qn->q", near, weight), slope)
        to_strength = torch.einsum("qn,qn->q", to_bins, weight)
        return to_strength, strength * to_place, to_bins * strength[:, None], None, None


def fast_length(count: int) -> int:
    """Return a length of a quick transform; few different ones, since filters are kept."""
    power = 2 ** max(math.floor(math.log2(count)), 3)
    return next(
        int(scipy.fft.next_fast_len(power * part // 4))
        for part in (4, 5, 6, 7, 8)
        if power * part // 4 >= count
    )
