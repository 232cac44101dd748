# SPDX-License-Identifier: MIT
"""Renderer ``profile``: a fine range profile of the field, seen through the analysis window.

In: a field, poses (P, 3) and (P, 3, 3). Out: magnitudes (P, E, R, F), differentiable in the field.
It adds the power of all places in fine range bins, with the true places of emitter and ears,
spreading and air, and convolves with the power of the window over range. Section 3 of
``docs/method.md``.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from pydantic import Field as Option
from torch import Tensor, nn

from sononerf.field.field import Field, lattice_over
from sononerf.field.renderer import Deposit, Possible, Renderer, Window, look_up, tensor
from sononerf.head.head import Head

KERNEL_SKIRT = 31e-6
"""Length by which the kernel exceeds the window, s: beam and ears lengthen an echo."""
KERNEL_FLOOR = -9.0
"""Natural logarithm of the squared kernel beyond the window, at the start of the fit."""
UNEVEN_FLOOR = -14.0
"""KERNEL_FLOOR of a kernel whose two sides differ. Such a kernel is many times longer, and
KERNEL_FLOOR would sum up to a twentieth of an echo's energy."""


class ProfileRenderer(Renderer):
    r"""Power of a fine range profile, seen through the squared analysis window.

    .. math::
        S_e(f, r)^2 = n_f^2 + g^2 \sum_i W_f(r - r_i)\, |\rho(x_i, u_i, f)|^2
        \frac{B(f)^2 E_e(f)^2 e^{-2 \alpha_f (d_i + d_i^e)}}{(d_i\, d_i^e)^2}

    The sum runs over the vertices of a lattice that are kept. Each is deposited, linearly
    between two bins, at :math:`r_i = (d_i + d_i^e) / 2`, emitter and ear at their true places,
    so both ears hear it at their own time; of a sweep each row hears it by the row's lag farther
    off. Spreading and absorption are known physics and stay out of the field. The kernel
    :math:`W_f` starts as the square of a point echo in its row, the analysis window or what that
    makes of a sweep, and is learned on; it has two equal sides where the point echoes have. On a
    support each place is also heard by way of the images; the powers of ways of different length
    add up.

    In: region ((2, 3), m).
    """

    lattice: Tensor
    kept: Tensor
    energy: Tensor
    spacing: Tensor
    absorption: Tensor
    lag: Tensor | None

    def __init__(
        self,
        region: Tensor,
        head: Head,
        *,
        oversampling: Annotated[int, Option(ge=1, le=16)] = 2,
        points: Annotated[int, Option(ge=1)] = 25_000,
        uniform: Annotated[float, Option(gt=0, le=1)] = 0.4,
        start: Annotated[int, Option(ge=1)] = 12_000,
        prune_every: Annotated[int, Option(ge=0)] = 100,
        prune_below: Annotated[float, Option(ge=0, lt=1)] = 1e-6,
        surroundings: Annotated[float, Option(gt=0)] = 5.0,
    ) -> None:
        super().__init__(region, head)
        self.points, self.uniform, self.start = points, uniform, start
        self.prune_every, self.prune_below = prune_every, prune_below
        self.surroundings = surroundings * head.resolution
        self.oversampling = oversampling
        step = float(self.range[1] - self.range[0])
        self.bin = step / oversampling
        per_sample = head.speed_of_sound / head.sampling_rate / 2
        window = tensor(head.window)
        self._even = torch.allclose(window, window.flip(1))
        # A row that is not swept has no middle. Of uneven ones the middle may not be the greatest.
        window = window.clamp(1e-6, 1.0 if self._even else None)
        last = window.shape[1] - 1
        half = last / 2
        half_width = math.ceil((half + KERNEL_SKIRT * head.sampling_rate) * per_sample / self.bin)
        offsets = (
            half - torch.arange(half_width + 1) * self.bin / per_sample
        )  # from the middle down
        left = offsets.floor().long().clamp(0, last - 1)
        part = offsets - left
        floor = KERNEL_FLOOR if self._even else UNEVEN_FLOOR
        sides = []
        for side in (window,) if self._even else (window, window.flip(1)):
            between = side[:, left] * (1 - part) + side[:, left + 1] * part
            skirt = (2 * between.log()).clamp_min(floor)
            sides.append(torch.where(offsets >= 0, skirt, floor).float()[:, 1:])
        self.log_kernel = nn.Parameter(torch.cat(sides, dim=1))
        self._taps = 2 * half_width + 1
        self.first = float(self.range[0]) - half_width * self.bin
        self.register_buffer("absorption", tensor(head.row_absorption))
        self.register_buffer("lag", None if head.lag is None else tensor(head.lag))
        self.log_spectrum = nn.Parameter(torch.zeros(len(self.frequency)))
        self.log_noise = nn.Parameter(torch.full((len(self.frequency),), -16.0))
        self.register_buffer("lattice", torch.zeros(0, 3))
        self.register_buffer("kept", torch.zeros(0, dtype=torch.bool))
        self.register_buffer("energy", torch.zeros(0))
        self.register_buffer("spacing", torch.zeros(()))
        self._kept = (self.kept, -1, self.lattice)  # which, as of when, and where they are

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        # Older runs hold buffers of removed modes, which the default mode never used.
        for name in ("phased", "wave", "opaque"):
            state_dict.pop(prefix + name, None)
        # The lattice's size is found by the fit, so a loaded one replaces ours whole.
        for name in ("lattice", "kept", "energy"):
            if prefix + name in state_dict:
                found = getattr(self, name).new_zeros(state_dict[prefix + name].shape)
                setattr(self, name, found)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    @property
    def places_per_pose(self) -> int | None:
        """Number of places that a step evaluates per pose."""
        return min(len(self._kept_places()), self.points) if len(self.kept) else None

    @torch.no_grad()
    def prepare(self, field: Field, possible: Possible | None, step: int) -> bool:
        """Lay the lattice at the first step; regularly drop places without energy, and refine."""
        if not len(self.lattice):
            self._lay(field, possible)
            return True
        if not self.prune_every or not step or step % self.prune_every:
            return False
        self._prune(field)
        field.keep(self.lattice[self.kept], float(self.spacing))
        if float(self.spacing) > 1.5 * field.resolution:
            self._refine(possible)
            field.keep(self.lattice, float(self.spacing))
            return True
        return False

    def _lay(self, field: Field, possible: Possible | None) -> None:
        """Begin as finely as ``start`` allows; to ask about every fine place would take long."""
        spacing = field.resolution
        while len(lattice_over(self.region, spacing)) > (4 if possible else 1) * self.start:
            spacing *= 2
        while True:
            places = lattice_over(self.region, spacing)
            if possible is not None:
                places = places[possible(places, spacing * math.sqrt(3) / 2)]
            if spacing <= field.resolution or 8 * len(places) > self.start:
                break
            spacing /= 2
        self._replace(places, spacing)
        field.keep(self.lattice, spacing)

    def _refine(self, possible: Possible | None) -> None:
        """Halve the spacing around the remaining places."""
        half = float(self.spacing) / 2
        cell = ((self.lattice[self.kept] - self.region[0]) / half).round().long()
        steps = torch.arange(-1, 2, device=cell.device)
        around = torch.cartesian_prod(steps, steps, steps)
        size = ((self.region[1] - self.region[0]) / half + 1e-3).floor().long() + 1
        cells = (cell[:, None] + around).reshape(-1, 3)
        cells = cells[((cells >= 0) & (cells < size)).all(dim=1)]
        # As one number each: rows are sorted a hundred times slower.
        flat = ((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]).unique()
        line, plane = flat % (size[1] * size[2]), flat // (size[1] * size[2])
        cells = torch.stack((plane, line // size[2], line % size[2]), dim=1)
        places = self.region[0] + cells * half
        if possible is not None:
            places = places[possible(places, half * math.sqrt(3) / 2)]
        self._replace(places, half)

    def _replace(self, places: Tensor, spacing: float) -> None:
        self.lattice = places
        self.kept = places.new_ones(len(places), dtype=torch.bool)
        self.energy = places.new_ones(len(places))
        self.spacing = self.spacing.new_tensor(spacing)

    def _prune(self, field: Field) -> None:
        energy = field.energy(self.lattice[self.kept], 32)
        self.energy = torch.zeros_like(self.energy).masked_scatter(self.kept, energy)
        # The strongest of the surroundings, judged on coarse cubes and their neighbours, so
        # that far and weak parts are not starved by a loud one.
        cell = ((self.lattice - self.region[0]) / self.surroundings).long().clamp_min(0)
        size = (cell.amax(0) + 1).tolist()
        flat = (cell[:, 2] * size[1] + cell[:, 1]) * size[0] + cell[:, 0]
        most = self.energy.new_zeros(size[0] * size[1] * size[2])
        most = most.scatter_reduce(0, flat, self.energy, "amax").reshape(1, 1, *size[::-1])
        most = F.max_pool3d(most, 3, 1, 1).reshape(-1)[flat]
        self.kept = self.kept & (self.energy > self.prune_below * most)

    def _kept_places(self) -> Tensor:
        """Return the places that are kept, (L, 3): the same tensor until others are."""
        kept, version, places = self._kept
        if kept is not self.kept or version != kept._version:
            # Validation may come first, and its tensors have no gradients.
            with torch.inference_mode(False):
                places = self.lattice[self.kept]
            self._kept = (self.kept, self.kept._version, places)
        return places

    def _draw(self) -> tuple[Tensor | None, Tensor | None]:
        """Return the indices of the places of this step, and their weights; None for all."""
        if not self.training or len(self._kept_places()) <= self.points:
            return None, None
        energy = self.energy[self.kept]
        share = (1 - self.uniform) * energy / energy.sum() + self.uniform / len(energy)
        drawn = torch.multinomial(share, self.points, replacement=True)
        return drawn, 1.0 / (share[drawn] * self.points)

    def forward(
        self,
        field: Field,
        position: Tensor,
        rotation: Tensor,
        rows: Tensor,
        bins: Tensor | None = None,
    ) -> Tensor:
        """Render; see the base class. Differentiable in the field, gain, spectrum and noise."""
        which, weight = self._draw()
        if bins is None:
            bins = torch.arange(len(self.frequency), device=self.frequency.device)
        profile, slices = self._profile(field, which, weight, position, rotation, bins)
        half = self.log_kernel.index_select(0, bins).exp()
        before, after = (half, half) if self._even else half.chunk(2, dim=1)
        # A place nearer than a slice is heard there after its own time.
        kernel = torch.cat((after.flip(1), torch.ones_like(half[:, :1]), before), dim=1)
        heard = Window.apply(profile, kernel, self.oversampling)[0]  # (E, B, P, n)
        heard = F.pad(heard, (slices.start, len(self.range) - slices.stop))
        gain = (2 * (self.log_gain + self.log_spectrum[bins])).exp()
        noise = (2 * self.log_noise[bins]).exp()
        heard = torch.addcmul(noise[:, None, None], heard, gain[:, None, None])
        heard = heard.permute(2, 0, 3, 1)  # (P, E, R, B)
        whole = torch.arange(len(self.range), device=rows.device).expand(len(rows), -1)
        if not (self.on_cpu and torch.equal(rows, whole)):
            heard = heard.gather(
                2, rows[:, None, :, None].expand(-1, heard.shape[1], -1, heard.shape[3])
            )
        return heard.clamp_min(1e-24).sqrt()

    def _profile(
        self,
        field: Field,
        which: Tensor | None,
        weight: Tensor | None,
        position: Tensor,
        rotation: Tensor,
        bins: Tensor,
    ) -> tuple[Tensor, range]:
        """Return the power in fine range bins (1, E, B, P, K), and the slices that see them."""
        there = self._kept_places()
        code = field.code_of_lattice(there, which)
        places = there if which is None else there[which]
        # All places in all heads are turned at once: sooner done than pair by pair.
        to_head = rotation.permute(2, 0, 1)  # (3, P, 3), world to head
        origin = (to_head * position).sum(-1).reshape(-1, 1)

        def in_heads(points: Tensor) -> Tensor:
            return (to_head.reshape(-1, 3) @ points.T - origin).reshape(3, -1)

        # A place and its image; the image of a head hears the same of a place.
        places_in_heads = [in_heads(points) for points in self._with_image(places)]
        echoes, at, poses = [], [], []
        for emitters, images in self._paths_from(position + rotation @ self.emitter):
            with torch.no_grad():
                # Ears, vectors and frequencies come first in memory, pairs run along it.
                if self.on_cpu:
                    pair = field.audible(places, emitters, code).reshape(-1).nonzero()[:, 0]
                else:
                    pair = torch.arange(len(position) * len(places), device=places.device)
                pose = pair.div(len(places), rounding_mode="floor")
                place = pair - pose * len(places)
                # From here on a column for each pair of a pose and a place that answers it.
                ray = emitters.T.index_select(1, pose) - places.T.index_select(1, place)
                unit = ray / _length(ray)
                out = places_in_heads[images[0]].index_select(1, pair)
                back = (
                    out
                    if images[0] == images[1]
                    else places_in_heads[images[1]].index_select(1, pair)
                )
                paths, middle = self._paths(out, back, bins)
                paths.square_()
                if weight is not None:
                    paths *= weight.index_select(0, place)
            response, lead = field.echo(places, unit.T, bins, place, code)  # (M, B), (M,)
            response = response.T
            if self.training:
                self.points_evaluated += len(place)
            squared = response.abs().square() if response.is_complex() else response.square()
            echoes.append((squared * paths)[None])
            at.append(middle - lead / self.bin)
            poses.append(pose)
        heard, when, whose = _joined(echoes), _joined(at), _joined(poses)
        slices = self._sounding(when)
        held = (len(slices) - 1) * self.oversampling + self._taps
        when = when - slices.start * self.oversampling
        return Deposit.apply(heard, when, whose, len(position), held), slices

    def _with_image(self, places: Tensor) -> tuple[Tensor, ...]:
        """Return places (N, 3), and on a support their images too."""
        if self.support is None:
            return (places,)
        point, normal = self.support
        return places, places - 2.0 * ((places - point) @ normal)[:, None] * normal

    def _paths_from(self, emitters: Tensor) -> list[tuple[Tensor, tuple[int, int]]]:
        """Return the ways of sound from emitters (P, 3) to places and back."""
        if self.support is None:
            return [(emitters, (0, 0))]
        point, normal = self.support
        foot = emitters - ((emitters - point) @ normal)[:, None] * normal
        return [(emitters, (0, 0)), (foot, (0, 1)), (2.0 * foot - emitters, (1, 1))]

    def _sounding(self, at: Tensor) -> range:
        """Return the slices that may see one of the bins, counted from the first; at least one."""
        last = len(self.range) - 1
        if not at.numel():
            return range(1)
        if not self.on_cpu:
            return range(last + 1)
        nearest, farthest = torch.stack(at.detach().aminmax()).nan_to_num().tolist()
        first = (math.floor(nearest) - self._taps) // self.oversampling
        end = (math.floor(farthest) + 1) // self.oversampling + 1
        first = min(max(first, 0), last)
        return range(first, min(max(end, first), last) + 1)

    def _paths(self, out: Tensor, back: Tensor, bins: Tensor) -> tuple[Tensor, Tensor]:
        """Return the factor of pressure on the way to places and back.

        In: out, back ((3, M), m), bins (B,). Out: known (E, B, M), middle ((E, 1, M) or (E, B, M)).
        """
        if out is not back:
            first, last = (self._path_factor(*pair, bins) for pair in ((out, back), (back, out)))
            return first[0] + last[0], 0.5 * (first[1] + last[1])
        return self._path_factor(out, back, bins)

    def _path_factor(self, emitted: Tensor, heard: Tensor, bins: Tensor) -> tuple[Tensor, Tensor]:
        """Return the factor of one of the ways; see :meth:`_paths`."""
        ray = heard - self.ear_positions[..., None]  # (E, 3, M)
        back = _length(ray)
        head = (ray / back[:, None]).mT
        ray = emitted - self.emitter[:, None]
        out = _length(ray)
        path = out + back  # (E, M) m, there and back
        # Each pass is made once, and in place: memory traffic limits the speed.
        gain = look_up(self.ears.index_select(1, bins), head).mT
        gain *= look_up(self.beam.index_select(0, bins), (ray / out).T).T
        absorption = self.absorption[bins]
        factors = torch.stack((absorption, torch.ones_like(absorption)), dim=1)
        lengths = torch.stack((path, torch.log(out * back)), dim=1)
        gain *= (-factors @ lengths).exp_()
        middle = ((path / 2 - self.first) / self.bin)[:, None]
        if self.lag is not None:
            middle = middle + look_up(self.lag.index_select(1, bins), head).mT / self.bin
        return gain, middle


def _joined(parts: list[Tensor]) -> Tensor:
    """Return parts side by side along the last dimension; one alone is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)


def _length(vectors: Tensor) -> Tensor:
    """Return the lengths of (..., 3, M) vectors, (..., M)."""
    x, y, z = vectors.unbind(-2)
    return (x * x + y * y + z * z).clamp_min(1e-12).sqrt()
