# SPDX-License-Identifier: MIT
"""Errors of a recording, estimated from a surface and what was heard of it.

The spectrograms of the surface by physical optics are compared with the measured ones, in
compressed decibels. The gain of each receiver and frequency, the range offset and the speed of
sound are found together by Gauss-Newton steps [1]_ on an absolute loss. The derivatives run through
the optics. The surface itself is allowed to grow by a uniform layer and by a scale, because a
surface that was fitted to wrong ranges has taken them up.

A support is a mirror. Without it a fit takes the image for a part of the body that hangs below the
support. The upper part of the surface is surely body. It is heard together with its image in
supports at trial heights, and the height that explains the echoes best is the support's.

References:
    .. [1] B. Triggs et al., "Bundle adjustment, a modern synthesis", Vision Algorithms, 2000.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
import torch.autograd.forward_ad as forward
import trimesh
from numpy.typing import ArrayLike

from sononerf.echoes.echoes import Echoes
from sononerf.errors import InputError
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.head.front_end import ACTIVE_DB, compress
from sononerf.head.head import Head
from sononerf.numerics import Floats
from sononerf.refinement.objective import ERROR_EXPONENT, FLOOR_DB
from sononerf.refinement.optics import Optics
from sononerf.refinement.tracer import StillSurface

UP = (0.0, 0.0, 1.0)
"""Normal of a support that is searched for: a table is level."""
MIDDLE = 0.5
"""Height at which the upper part begins in the first search, as a fraction of the surface's height:
a body and its image are equally high."""
CUTS = (1.0, 2.0, 3.0)
"""Heights above the first answer at which the upper part begins afterwards, range resolutions.
Lower is better as long as no part of the image is included; the spread of the answers is the
uncertainty of the height."""
SEARCH_HALF_WIDTH = 3.0
"""Half width of the second search around the first answer, range resolutions."""


def with_support(head: Head, height: float) -> Head:
    """Return a head above a level support at a height, m, world frame."""
    given = {"point": (0.0, 0.0, height), "normal": UP}
    return dataclasses.replace(head, support=head.support.model_copy(update=given))


def above(mesh: trimesh.Trimesh, height: float) -> trimesh.Trimesh:
    """Return the part of a mesh that lies above a height, m."""
    kept = (np.asarray(mesh.triangles)[:, :, 2] > height).all(axis=1)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[kept])


def find_support(
    mesh: trimesh.Trimesh, echoes: Echoes, shown: Callable[[float], None]
) -> tuple[float, float]:
    """Return the height of a level support and its standard deviation, m, world frame."""
    low, high = mesh.bounds[:, 2]
    step = echoes.head.resolution / 2.0
    if high - low < 8.0 * step:
        raise InputError("the surface is too flat to tell what it stands on; measure the support")

    def search(begin: float, heights: Floats, first: float, last: float) -> float:
        part, errors = above(mesh, begin), []
        for row, height in enumerate(heights.tolist()):
            heard = Echoes(echoes.store, with_support(echoes.head, height), echoes.hull)
            work = Calibrator(part, heard, Optics(heard.head), (), dependent=1.0)
            errors.append(work.error())
            shown(first + (last - first) * (row + 1) / len(heights))
        return float(heights[0] + step * least(errors))

    middle = low + MIDDLE * (high - low)
    about = search(middle, np.arange(low - 2.0 * step, middle, step), 0.0, 0.4)
    half_range = 2.0 * step * SEARCH_HALF_WIDTH
    errors_of_heights = []
    for number, cut in enumerate(CUTS):
        begin = about + 2.0 * step * cut
        heights = np.arange(about - half_range, min(begin, about + half_range), step)
        share = 0.4 + 0.6 * np.array([number, number + 1]) / len(CUTS)
        errors_of_heights.append(search(begin, heights, *share))
    spread = float(np.std(errors_of_heights, ddof=1))
    return float(np.median(errors_of_heights)), math.hypot(spread, step / math.sqrt(12.0))


def least(values: ArrayLike) -> float:
    """Return where a row of values (N,) is least, between two of them too."""
    row = np.asarray(values, dtype=np.float64)
    at = int(row.argmin())
    if at in (0, len(row) - 1):
        return float(at)
    before, here, after = row[at - 1 : at + 2].tolist()
    bend = before - 2.0 * here + after
    return at + (0.5 * (before - after) / bend if math.isfinite(bend) and bend > 0.0 else 0.0)


ErrorKind = Literal["gain", "range_offset", "speed_of_sound", "support"]
KINDS: tuple[ErrorKind, ...] = get_args(ErrorKind)
MOST_POSES = 60
"""Number of poses, at most, that are compared. More poses do not help, because the surface is known
less well than this number of poses determines the errors."""
POSE_GROUPS = 12
"""Number of groups of neighbouring poses that give the uncertainties: each hears the surface from
another side."""
MAX_DOUBLINGS = 4
"""Number of times, at most, that a step is doubled while the error falls. Interference makes the
derivatives of fine cells steep but short, and steps too small."""
LARGEST_STEP = 0.5
"""Largest step of the range offset, range resolutions: beyond it the derivatives do not hold."""
LEAST_DB = 0.5
"""Difference below which all differences have the same weight, dB: physical optics is no more
accurate."""
SMOOTH_DB = 1.0
"""Standard deviation of the difference of a receiver's gain between neighbouring frequencies, dB.
Single rows may hold no echo at all."""
_DB = 20.0 / math.log(10.0)


@dataclass(eq=False)
class Calibration:
    """Errors of a recording; zero where nothing is wrong."""

    gain: Floats  # (E, F): Natural logarithm of how much too loud each receiver is
    range_offset: float = 0.0  # m: Excess of all measured ranges
    speed_of_sound: float = 0.0  # Natural logarithm of the true speed over the assumed one


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated errors of a recording and their uncertainties."""

    calibration: Calibration  # The errors
    deviation: dict[str, float]  # One standard deviation of each kind, in its own unit
    # Mean absolute difference over active cells before each step, and after the last
    error_db: list[float]


class Calibrator:
    """Gauss-Newton steps on the errors of a recording.

    Attributes:
        names: Names of the unknowns but for the gains: ``range_offset`` (m), ``speed_of_sound``
            (natural logarithm), and ``layer`` (m) and ``scale`` (natural logarithm) of the surface.
        values (U,): Their present values.
        gain (E, F): Natural logarithms.
        change: Length of the last step over one standard deviation, of the unknown that changed
            most.
        stretch: Largest distance that the unknowns went, over the step that the derivatives gave,
            no unit, 1 or more. Uncertainties are multiplied by it.
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh,
        echoes: Echoes,
        optics: Optics,
        kinds: Sequence[ErrorKind],
        *,
        dependent: float,
    ) -> None:
        self.mesh, self.echoes, self.optics = mesh, echoes, optics
        self.dependent = dependent
        poses = np.concatenate((echoes.training, echoes.validation))
        count = min(MOST_POSES, len(poses))
        self.poses = poses[np.linspace(0, len(poses) - 1, count).round().astype(int)]
        self.names: list[str] = [kind for kind in kinds if kind != "gain"]
        if {"range_offset", "speed_of_sound"} & set(kinds):
            self.names += ["layer", "scale"]
        # The level of recordings is not known, and every other error would take it up.
        self.learns_gain = "gain" in kinds or not echoes.calibrated
        self.values: Floats = np.zeros(len(self.names))
        self.gain: Floats = np.zeros((optics.ears, len(optics.frequencies)))
        self.weight = np.ones((optics.ears, 1, len(optics.frequencies)))
        self.error_db: list[float] = []
        self._covariance: Floats = np.zeros((len(self.names) + self.gain.size,) * 2)
        self.change = math.inf
        self.stretch = 1.0

    def step(self, shown: Callable[[], None] = lambda: None) -> float:
        """Do one step; return the error before it, dB. ``shown`` is called once per pose."""
        body = self._body()
        self._begin(body)
        count, size = len(self.names), len(self.names) + self.gain.size * self.learns_gain
        normal, slopes, errors = np.zeros((size, size)), [], []
        cost, cells = 0.0, 0.0
        sums = np.zeros((2, *self.weight.shape))
        for number in self.poses.tolist():
            residual, measured, rendered, columns = self._linear(body, number, slopes=True)
            shown()
            slopes.append(np.zeros(size))
            active = (measured >= ACTIVE_DB) | (rendered >= ACTIVE_DB)
            if not active.any():
                continue
            off = np.abs(residual)
            sums += np.stack([(off * active).sum(1, keepdims=True), active.sum(1, keepdims=True)])
            weight = self.weight * active / np.maximum(off, LEAST_DB)
            errors.append(float(off[active].mean()))
            normal[:count, :count] += np.einsum("uerf,erf,verf->uv", columns, weight, columns)
            slopes[-1][:count] = np.einsum("uerf,erf,erf->u", columns, weight, residual)
            if self.learns_gain:
                of_gain = -_DB * np.expm1(-rendered / _DB)
                cross = np.einsum("uerf,erf,erf->uef", columns, weight, of_gain)
                normal[:count, count:] += cross.reshape(count, self.gain.size)
                own = (of_gain * weight * of_gain).sum(axis=1).ravel()
                normal[np.arange(count, size), np.arange(count, size)] += own
                slopes[-1][count:] = (of_gain * weight * residual).sum(axis=1).ravel()
            cost += float((weight * residual**2).sum())
            cells += float(active.sum())
        normal[count:, :count] = normal[:count, count:].T
        self.error_db.append(float(np.mean(errors)) if errors else math.inf)
        noise = cost / max(cells, 1.0) * self.dependent
        towards = np.sum(slopes, axis=0)
        if self.learns_gain:
            steps = np.diff(np.eye(self.gain.shape[1]), axis=0)
            rough = np.kron(np.eye(len(self.gain)), steps.T @ steps)
            rough = rough * (noise * (_DB / SMOOTH_DB) ** 2)
            normal[count:, count:] += rough
            towards[count:] -= rough @ self.gain.ravel()
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
        damped = normal / np.outer(scale, scale) + 1e-6 * np.eye(size)
        inverse = np.linalg.pinv(damped, hermitian=True) / np.outer(scale, scale)
        step = inverse @ towards
        unit = np.sqrt(np.maximum(noise * np.diag(inverse), 1e-30))
        self.change = float((np.abs(step) / unit).max(initial=0.0))
        grouped = inverse @ self._scatter(np.stack(slopes)) @ inverse
        larger = np.maximum(np.diag(noise * inverse), np.diag(grouped)).clip(0.0)
        factor = np.sqrt(larger / np.maximum(np.diag(grouped), 1e-300))
        self._covariance = grouped * np.outer(factor, factor)
        self._move(step)
        if size:
            self._go_on(step)
        usual = sums[0] / np.maximum(sums[1], 1.0)
        usual = np.where(sums[1] > 0.0, usual, usual.max())
        power = np.maximum(usual, 0.25 * np.median(usual)) ** -ERROR_EXPONENT
        self.weight = power / power.mean()
        return self.error_db[-1]

    def error(self) -> float:
        """Return the absolute difference over active cells, dB per measured one."""
        body = self._body()
        self._begin(body)
        total, count = 0.0, 0
        for number in self.poses.tolist():
            residual, measured, rendered, _ = self._linear(body, number)
            active = (measured >= ACTIVE_DB) | (rendered >= ACTIVE_DB)
            total += float(np.abs(residual[active]).sum())
            count += int((measured >= ACTIVE_DB).sum())
        return total / count if count else math.inf

    def result(self) -> Estimate:
        """Return the present estimate."""
        calibration = Calibration(self.gain)
        deviation: dict[str, float] = {}
        spread = self.stretch * np.sqrt(np.diag(self._covariance))
        for index, name in enumerate(self.names):
            if name in ("range_offset", "speed_of_sound"):
                setattr(calibration, name, float(self.values[index]))
                deviation[name] = float(spread[index])
        if self.learns_gain:
            # Of the mean over the frequencies.
            block = self._covariance[len(self.names) :, len(self.names) :]
            block = block.reshape(self.gain.shape * 2)
            means = [float(block[ear, :, ear].mean()) for ear in range(len(self.gain))]
            deviation["gain"] = self.stretch * math.sqrt(max(float(np.mean(means)), 0.0))
        return Estimate(calibration, deviation, list(self.error_db))

    def _begin(self, body: StillSurface) -> None:
        """Take the first level of recordings from their energy."""
        if self.error_db or self.echoes.calibrated or self.gain.any():
            return
        energy = np.zeros((2, self.optics.ears))
        for number in self.poses.tolist():
            pose = slice(number, number + 1)
            rendered = body.render(self.echoes.positions[pose], self.echoes.rotations[pose])[0]
            for row, magnitude in enumerate((self.echoes.magnitude(number).numpy(), rendered)):
                energy[row] += np.square(magnitude, dtype=np.float64).sum(axis=(1, 2))
        level = np.log(np.maximum(energy[0], 1e-300) / np.maximum(energy[1], 1e-300)) / 2
        self.gain = np.broadcast_to(level[:, None], self.gain.shape).copy()

    def _value(self, name: str) -> float:
        return float(self.values[self.names.index(name)]) if name in self.names else 0.0

    def _body(self) -> StillSurface:
        normals, middle = np.array(self.mesh.vertex_normals), self.mesh.centroid
        scale, layer = math.exp(self._value("scale")), self._value("layer")
        places = (self.mesh.vertices - middle) * scale + middle + layer * normals
        return StillSurface(trimesh.Trimesh(places, self.mesh.faces, process=False), self.optics)

    def _linear(
        self, body: StillSurface, number: int, *, slopes: bool = False
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return residual, measured and rendered levels (E, R, F), dB, and slopes (U, E, R, F)."""
        pose = slice(number, number + 1)
        measured = self.echoes.magnitude(number).numpy().astype(np.float64)
        reference = max(float(measured.max()) * 10.0 ** (-FLOOR_DB / 20.0), 1e-30)
        gain = np.exp(self.gain)[:, None]
        at = self.echoes.positions[pose], self.echoes.rotations[pose]
        magnitude, changes = self._rendered(body, *at, slopes=slopes)
        a, b = compress(measured, reference), compress(gain * magnitude, reference)
        columns = _DB * gain * changes / (reference + gain * magnitude)
        return a - b, a, b, columns

    def _rendered(
        self, body: StillSurface, position: Floats, rotation: Floats, *, slopes: bool
    ) -> tuple[Floats, Floats]:
        """Return the magnitude of a pose (E, R, F) and its derivatives (U, E, R, F)."""
        optics = body.optics
        shape = (optics.ears, optics.rows, len(optics.frequencies))
        magnitude = np.zeros(shape)
        changes = np.zeros((len(self.names) if slopes else 0, *shape))
        pieces, heads, middle = body.listen(position, rotation)
        if not len(pieces.pose):
            return magnitude, changes
        points, area = (body.vertices - middle).float(), body.area.float()
        still = torch.zeros_like(points)
        stretch = points.new_tensor([math.exp(-self._value("speed_of_sound"))])
        late = points.new_tensor([2.0 * self._value("range_offset")])
        away = (body.vertices - body.vertices.new_tensor(self.mesh.centroid)).float()
        tangents = {
            "range_offset": (still, 0.0, 2.0),
            "speed_of_sound": (still, -1.0, 0.0),
            "layer": (body.normals.float(), 0.0, 0.0),
            "scale": (away, 0.0, 0.0),
        }
        with torch.no_grad():
            heard = optics.render(points, area, pieces, heads, stretch=stretch, late=late)
            power = [heard.power.sqrt()]
            for name in self.names if slopes else ():
                velocity, slower, later = tangents[name]
                with forward.dual_level():
                    moved = forward.make_dual(points, velocity)
                    both = optics.render(
                        moved,
                        body.operators.areas(moved),
                        pieces,
                        heads,
                        stretch=forward.make_dual(stretch, slower * stretch),
                        late=forward.make_dual(late, torch.full_like(late, later)),
                    )
                    change = forward.unpack_dual(both.power).tangent
                power.append(0.5 * change / power[0].clamp_min(1e-30))
        first = int(heard.row[0])
        low, high = max(first, 0), min(first + power[0].shape[2], optics.rows)
        if high > low:
            magnitude[:, low:high] = power[0][0, :, low - first : high - first].numpy()
            for one, change in zip(changes, power[1:], strict=True):
                one[:, low:high] = change[0, :, low - first : high - first].numpy()
        return magnitude, changes

    def _scatter(self, slopes: Floats) -> Floats:
        """Return the covariance of the sums of slopes (P, N) over groups of neighbouring poses.

        What a surface does not explain is alike at poses that are neighbours, so that their cells
        are no independent measurements.
        """
        away = self.echoes.positions[self.poses] - self.mesh.centroid
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        nearest = (away @ fibonacci_sphere(POSE_GROUPS).T).argmax(axis=1)
        _, group = np.unique(nearest, return_inverse=True)
        sums = np.zeros((group.max() + 1, slopes.shape[1]))
        np.add.at(sums, group, slopes)
        sums -= sums.mean(axis=0)
        return np.asarray(sums.T @ sums * len(sums) / max(len(sums) - 1, 1))

    def _move(self, step: Floats) -> None:
        most = LARGEST_STEP * self.optics.head.resolution
        count = len(self.names)
        bound = np.where(np.isin(self.names, ["range_offset"]), most, np.inf)
        self.values = self.values + step[:count].clip(-bound, bound)
        if self.learns_gain:
            self.gain = self.gain + step[count:].reshape(self.gain.shape)

    def _go_on(self, step: Floats) -> None:
        """Repeat a step, each time doubled, as long as the error falls."""
        best, moved, doubled = self.error(), 1.0, 1.0
        for _ in range(MAX_DOUBLINGS):
            self.stretch = max(self.stretch, moved)
            before = self.values, self.gain
            self._move(step)
            error = self.error()
            if error >= best:
                self.values, self.gain = before
                return
            moved += doubled
            best, step, doubled = error, 2.0 * step, 2.0 * doubled
