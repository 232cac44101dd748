# SPDX-License-Identifier: MIT
"""Spectrograms of a surface by physical optics, with gradients for its vertices.

In: vertices (V, 3), m, areas and normals, poses. Out: magnitudes (P, E, R, F), differentiable in
the vertices. Each vertex stands for a small piece of surface; between the path by it and the
spectrogram everything is linear but the last magnitude. Section 5 of ``docs/method.md``.
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
from sononerf.refinement.remesh import tangents
from sononerf.simulation.hearing import Hearing, hearing_of
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
        """Power of echoes in each frame and row. Out: power ((receivers, frames, F) float32)."""
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


FADE_FREQUENCY = 0.25
"""Frequency below which the fade no longer falls, over the highest analysed frequency: as in the
simulator, 25 of 100 kHz."""
SILENT_EXPONENT = 3.0
"""Exponent of fade and spread at the lowest analysed frequency above which a piece is left out: 26
dB down. Such pieces cancel one another."""
PATH_VARIANCE = 5.0 / 52.0
"""Variance of the path over a piece of area 1 and slope 1: between that of a hexagon and that of a
triangle."""


@dataclass(frozen=True, eq=False)
class Heard:
    """Rendered spectrograms of some poses, over the ranges that hold echoes."""

    power: Tensor  # (P, E, W, F) float32: Squared magnitude; gradients flow through it
    row: Tensor  # (P,): Index of the first range slice on the store's axis; may be below zero


@dataclass(frozen=True, eq=False)
class Heads:
    """Emitters and receivers. Each pose appears W times, once for each way of the sound.

    Without a support there is one way, from the emitter to the ears. On a support there are four:
    emitter and ears stand for themselves or are mirrored.
    """

    emitters: Tensor  # (W P, 3), m: Their places
    ears: Tensor  # (W P, E, 3), m: Places of the ears
    emitting: Tensor  # W P, 3, 3: Head to world, of emitter and ears; those of images mirror
    hearing: Tensor
    poses: int  # P

    def about(self, middle: Tensor) -> Heads:
        """Return them in single precision, counted from a place (3,), m."""
        emitters, ears = (self.emitters - middle).float(), (self.ears - middle).float()
        return Heads(emitters, ears, self.emitting.float(), self.hearing.float(), self.poses)


@dataclass(frozen=True, eq=False)
class Pieces:
    """Echoes of surface pieces at some poses, one row per way of a pose and vertex."""

    pose: Tensor  # (Q,): Row of :class:`Heads`, one for each way of a pose; vertex
    vertex: Tensor
    weight: Tensor  # (Q, E, N) float32: Gains, absorption, spread, fade and visibility at the nodes
    # (Q, E) float32: Fade and spread at the lowest analysed frequency, 0 to 1; 1 at a mirror point
    reach: Tensor


@dataclass(frozen=True, eq=False)
class Paths:
    """Ways of the sound of a pose by a place to its ears."""

    pose: Tensor  # (Q,): Row of :class:`Heads`
    strength: Tensor  # (Q, E) float32: Gradients run to it, to the length and to the weight
    length: Tensor  # (Q, E) float32, m: From the emitter to the ear
    weight: Tensor  # (Q, E, N) float32: Factors at the nodes


class Optics(nn.Module):
    r"""Physical optics of one head; constant tensors move with the module.

    Each vertex stands for a small piece of surface with the vector area **a** (outward). An ear
    hears

    .. math::
        p(f) = \sum \frac{j f (1 - j \epsilon)}{c}\,
        \frac{\cos\vartheta_1 + \cos\vartheta_2}{2}\, \frac{a}{d_1 d_2}\, v\, B\, E\,
        e^{-\alpha (d_1 + d_2)}\, e^{-(k s)^2 / 2}\, e^{-\epsilon k \delta}\,
        e^{-j k (d_1 + d_2)}

    with the distances :math:`d_1, d_2` from the emitter and to the ear, the visibility v, the gains
    B, E of beam and ear, the absorption :math:`\alpha`, the standard deviation s of the path's
    length over the piece, and the fade over the detour :math:`\delta` against the local mirror
    path, as in the simulator (:mod:`sononerf.simulation.paths`). Everything between path and
    spectrogram is linear and fixed but the last magnitude.

    Attributes:
        head: Without noise.
        plane: The support; None if there is none.
        wavelength (m): The shortest of the analysed band.
        rows, ears: Range slices of a spectrogram, R, and ears, E.
        kept_nodes (N,): Indices of the synthesis' nodes that the band needs.
    """

    def __init__(self, head: Head, hearing: Hearing | None = None) -> None:
        super().__init__()
        self.head = head.without_noise()
        self.plane = head.plane
        hearing, spectrogram = hearing or hearing_of(self.head), head.spectrogram
        self.spectrogram = spectrogram
        self.speed_of_sound = head.speed_of_sound
        rate = spectrogram.sampling_rate
        rows = head.frequency
        self.frequencies = rows
        self.ears = len(head.receivers)
        axis = head.range
        self.rows = len(axis)
        filters = head.row_filters
        start = axis[0] * 2.0 * rate / self.speed_of_sound - filters.centre
        self._first = round(start / spectrogram.hop)
        self.wavelength = head.wavelength
        self._reads = filters.envelope.shape[1]
        self._soft = FADE_FREQUENCY * float(rows[-1])
        self.bank = FilterBank(head, hearing.synthesis.nodes, self._soft)
        self.kept_nodes = self.bank.kept_nodes
        ring = rate / self.bank.spacing + max(0, head.window.shape[1] - self._reads) / 2.0
        self._pad = math.ceil(ring)
        nodes = hearing.synthesis.nodes[self.kept_nodes]
        per_second = 2.0 * math.pi / self.speed_of_sound
        decay = hearing.absorption[self.kept_nodes] * (math.log(10.0) / 20.0)
        tables = hearing.ears._by_direction[:, :, self.kept_nodes]
        self._grid = (len(hearing.ears.elevation), len(hearing.ears.azimuth))
        lowest = float(rows[0])
        for name, values in (
            ("wavenumber", per_second * nodes),
            ("fade", per_second * np.hypot(nodes, self._soft)),
            ("decay", decay),
            ("tables", tables),
            ("emitter", hearing.ears.emitter),
            ("places", hearing.ears.positions),
        ):
            self.register_buffer(name, torch.as_tensor(np.ascontiguousarray(values)).float())
        self._lowest = (per_second * lowest, per_second * math.hypot(lowest, self._soft))

    def heads(self, positions: Tensor, rotations: Tensor) -> Heads:
        """Return emitters and ears of poses (P, 3), m, and (P, 3, 3), with their images."""
        emitter = self.get_buffer("emitter").to(positions.dtype)
        places = self.get_buffer("places").to(positions.dtype)
        emitters = positions + rotations @ emitter
        ears = positions[:, None] + torch.einsum("pij,ej->pei", rotations, places)
        if (plane := self.plane) is None:
            return Heads(emitters, ears, rotations, rotations, len(positions))
        reflection = torch.as_tensor(plane.reflection).to(positions)
        normal = torch.tensor(plane.normal).to(positions)

        def both(points: Tensor) -> tuple[Tensor, Tensor]:
            return points, points - 2.0 * plane.height(points)[..., None] * normal

        from_, to = both(emitters), both(ears)
        rotated = rotations, reflection @ rotations
        paths = ((0, 0), (1, 0), (0, 1), (1, 1))
        return Heads(
            torch.cat([from_[one] for one, _ in paths]),
            torch.cat([to[other] for _, other in paths]),
            torch.cat([rotated[one] for one, _ in paths]),
            torch.cat([rotated[other] for _, other in paths]),
            len(positions),
        )

    def near_mirror(
        self, points: Tensor, area: Tensor, bending: Tensor, emitters: Tensor, ears: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the mask of the pieces that send sound to an ear, and their attenuation.

        In: points, area (..., 3), bending ((..., 6), 1/m), emitters, ears ((..., 3), m). Out:
        facing (...,), spread, detour, path, exponent (...,).
        """
        size = area.norm(dim=-1)
        normal = area / size.clamp_min(1e-18)[..., None]  # squares of less are zero in float32
        u, v = points - emitters, points - ears
        d1, d2 = u.norm(dim=-1), v.norm(dim=-1)
        u, v = u / d1[..., None], v / d2[..., None]
        rise, back = -(u * normal).sum(-1), -(v * normal).sum(-1)
        shape = normal.shape[:-1]
        first, second = (t.reshape(*shape, 3) for t in tangents(normal.reshape(-1, 3)))
        u1, u2 = (u * first).sum(-1), (u * second).sum(-1)
        v1, v2 = (v * first).sum(-1), (v * second).sum(-1)
        g1, g2 = u1 + v1, u2 + v2
        xx, yy, zz, xy, xz, yz = bending.unbind(-1)

        def bent(a: Tensor, b: Tensor) -> Tensor:
            a1, a2, a3 = a.unbind(-1)
            b1, b2, b3 = b.unbind(-1)
            found = a1 * b1 * xx + a2 * b2 * yy + a3 * b3 * zz + (a1 * b2 + a2 * b1) * xy
            return found + (a1 * b3 + a3 * b1) * xz + (a2 * b3 + a3 * b2) * yz

        both = rise + back
        h11 = (1 - u1 * u1) / d1 + (1 - v1 * v1) / d2 + both * bent(first, first)
        h22 = (1 - u2 * u2) / d1 + (1 - v2 * v2) / d2 + both * bent(second, second)
        h12 = -u1 * u2 / d1 - v1 * v2 / d2 + both * bent(first, second)
        # |H|^-1 = a I + b H, such that both eigenvalues fit; none softer than a flat surface.
        least = rise.square().clamp_min(1e-4) / d1 + back.square().clamp_min(1e-4) / d2
        middle, half = 0.5 * (h11 + h22), torch.hypot(0.5 * (h11 - h22), h12)
        high = 1.0 / torch.maximum((middle + half).abs(), least)
        low = 1.0 / torch.maximum((middle - half).abs(), least)
        b = (high - low) / (2.0 * half).clamp_min(1e-6 * least)
        a = high - b * (middle + half)
        slope = g1 * g1 + g2 * g2
        detour = 0.5 * (a * slope + b * (h11 * g1 * g1 + h22 * g2 * g2 + 2.0 * h12 * g1 * g2))
        detour = detour.clamp_min(0.0)
        spread = PATH_VARIANCE * slope * size
        k, fade = self._lowest
        exponent = 0.5 * k * k * spread + fade * detour
        return (rise > 0) & (back > 0), spread, detour, d1 + d2, exponent

    def gains(self, table: Tensor, directions: Tensor, rotations: Tensor) -> Tensor:
        """Gain (Q, N) of tables (Q,) towards world directions (Q, 3); 0 is the beam, then ears."""
        head = torch.einsum("qi,qij->qj", directions, rotations)
        x, y, z = head.unbind(1)
        rows, columns = self._grid
        across = (torch.atan2(y, x) / (2.0 * math.pi) + 0.5) * (columns - 1)
        upward = (torch.atan2(z, torch.hypot(x, y)) / math.pi + 0.5) * (rows - 1)
        column = across.long().clamp(0, columns - 2)
        row = upward.long().clamp(0, rows - 2)
        s, t = across - column, upward - row
        corner = (table * rows + row) * columns + column
        corners = torch.stack([corner, corner + 1, corner + columns, corner + columns + 1], dim=1)
        weights = torch.stack([(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t], dim=1)
        flat = self.get_buffer("tables").flatten(0, 1)
        return nn.functional.embedding_bag(corners, flat, per_sample_weights=weights, mode="sum")

    def pieces(
        self,
        points: Tensor,
        area: Tensor,
        bending: Tensor,
        pose: Tensor,
        vertex: Tensor,
        visible: Tensor,
        heads: Heads,
    ) -> Pieces:
        """Return pieces with their weights: all factors of the sum but path, obliquity and area.

        In: points, area, bending ((V, 3), (V, 3), (V, 6) float32), pose, vertex (Q,), visible ((Q,
        E) float32).
        """
        emitters, ears = heads.emitters, heads.ears
        place, normal, bent = points[vertex], area[vertex], bending[vertex]
        out = place - emitters[pose]
        out = out / out.norm(dim=1, keepdim=True)
        rotation = heads.hearing[pose]
        beam = self.gains(torch.zeros_like(pose), out, heads.emitting[pose])
        weights, reaches = [], []
        wavenumber, fade, decay = (
            self.get_buffer(name) for name in ("wavenumber", "fade", "decay")
        )
        half = 0.5 * wavenumber.square()
        for ear in range(self.ears):
            to = ears[pose, ear]
            facing, spread, detour, path, exponent = self.near_mirror(
                place, normal, bent, emitters[pose], to
            )
            back = place - to
            back = back / back.norm(dim=1, keepdim=True)
            loss = torch.addr(spread[:, None] * half, detour, fade)
            loss = torch.addr(loss, path, decay)
            gain = self.gains(torch.full_like(pose, 1 + ear), back, rotation) * beam
            seen = visible[:, ear] * facing
            weights.append(gain * torch.exp(-loss) * seen[:, None])
            reaches.append(torch.exp(-exponent) * seen)
        return Pieces(pose, vertex, torch.stack(weights, 1), torch.stack(reaches, 1))

    def render(
        self,
        points: Tensor,
        area: Tensor,
        pieces: Pieces,
        heads: Heads,
        *,
        edges: Paths | None = None,
        stretch: Tensor | None = None,
        late: Tensor | None = None,
    ) -> Heard:
        """Return the spectrograms of poses; gradients run to points and areas (V, 3) float32.

        The sound by ``edges`` is added in phase. The paths of a pose are multiplied by ``stretch``
        (P,) and lengthened by ``late`` (P,), m.
        """
        emitters, ears = heads.emitters, heads.ears
        place, normal = points[pieces.vertex], area[pieces.vertex]
        u = place - emitters[pieces.pose]
        v = place[:, None] - ears[pieces.pose]
        d1, d2 = u.norm(dim=1), v.norm(dim=2)
        both = (u / d1[:, None])[:, None] + v / d2[:, :, None]
        strength = -(both * normal[:, None]).sum(2) * 0.5 / (self.speed_of_sound * d1[:, None] * d2)
        paths_by_source: dict[Source, Paths] = {
            "surface": Paths(pieces.pose, strength, d1[:, None] + d2, pieces.weight)
        }
        if edges is not None:
            paths_by_source["edge"] = edges
        # Sound by different ways adds up in phase.
        poses = heads.poses
        pose = {source: some.pose % poses for source, some in paths_by_source.items()}
        samples = self.spectrogram.sampling_rate / self.speed_of_sound
        paths = {}
        for source, some in paths_by_source.items():
            path = some.length
            if stretch is not None:
                path = path * stretch[pose[source]][:, None]
            if late is not None:
                path = path + late[pose[source]][:, None]
            paths[source] = path * samples
        whole = torch.cat([path.detach() for path in paths.values()])
        frames, row = self._span(whole, torch.cat([*pose.values()]), poses)
        origin = (row + self._first) * self.spectrogram.hop
        ear = torch.arange(self.ears, device=row.device)
        arrivals = {}
        for source, some in paths_by_source.items():
            at = paths[source] - origin.to(paths[source].dtype)[pose[source]][:, None]
            receiver = pose[source][:, None] * self.ears + ear
            arrivals[source] = Arrivals(
                some.strength.reshape(-1),
                at.reshape(-1),
                some.weight.flatten(0, 1),
                receiver.reshape(-1),
            )
        power = self.bank.power(arrivals, receivers=poses * self.ears, frames=frames)
        return Heard(power.unflatten(0, (poses, self.ears)), row)

    def later_power(
        self, pose: Tensor, ear: Tensor, delay: Tensor, weight: Tensor, like: Heard
    ) -> Tensor:
        """Power (P, E, W, F) of single echoes, on the rows of others.

        In: pose, ear (N,), delay ((N,), s), weight ((N, N') float32).
        """
        poses, _, frames, _ = like.power.shape
        start = ((like.row + self._first) * self.spectrogram.hop).to(delay.dtype)
        at = delay * self.spectrogram.sampling_rate - start[pose]
        last = frames * self.spectrogram.hop - self._pad
        inside = torch.nonzero((at > self._pad) & (at < last))[:, 0]
        at = at[inside].float()
        receiver = (pose * self.ears + ear)[inside]
        arrivals = Arrivals(torch.ones_like(at), at, weight[inside], receiver)
        power = self.bank.power({"surface": arrivals}, receivers=poses * self.ears, frames=frames)
        return power.unflatten(0, (poses, self.ears))

    def _span(self, path: Tensor, pose: Tensor, poses: int) -> tuple[int, Tensor]:
        """Return the number of frames that holds any pose's echoes, and each pose's first."""
        hop, window = self.spectrogram.hop, self._reads
        late, early = path.amax(1), path.amin(1)
        huge = torch.full((poses,), torch.inf, device=path.device, dtype=path.dtype)
        nearest = huge.scatter_reduce(0, pose, early, "amin")
        farthest = (-huge).scatter_reduce(0, pose, late, "amax")
        empty = torch.isinf(nearest)
        nearest = torch.where(empty, torch.zeros_like(nearest), nearest)
        farthest = torch.where(empty, torch.zeros_like(farthest), farthest)
        row = torch.floor((nearest - self._pad - window) / hop).long()
        span = float((farthest - row * hop).max()) + self._pad + window
        frames = fast_length(max(math.ceil(span / hop), 8))
        return frames, row - self._first
