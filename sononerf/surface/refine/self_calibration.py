# SPDX-License-Identifier: MIT
r"""Errors of a recording, estimated from a surface and what was heard of it.

The spectrograms of the surface by physical optics are compared with the measured ones, in
compressed decibels. The gain of each receiver, the range offset and the speed of sound are found
together by Gauss-Newton steps [1]_ on an absolute loss. The surface itself is allowed to grow by a
uniform layer and by a scale, because a surface that was fitted to wrong ranges has taken them up.

References:
    .. [1] B. Triggs et al., "Bundle adjustment, a modern synthesis", Vision Algorithms, 2000.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import trimesh

from sononerf.array_types import Bools, Floats
from sononerf.echoes.echoes import Echoes
from sononerf.geometry.directions import fibonacci_sphere
from sononerf.head.decibels import ACTIVE_DB, compress
from sononerf.surface.refine.objective import FLOOR_DB, TRUST
from sononerf.surface.refine.optics import Optics
from sononerf.surface.refine.recording_errors import Calibration, Estimate, Kind
from sononerf.surface.refine.still_surface import StillSurface

STEP = 0.02
"""Length of a finite difference, shortest wavelengths: small against interference, large against
rounding."""
LEVEL_POSES = 50
"""Number of poses from which the first level of a recording is taken, and on which errors are
compared. Later steps improve the level."""
MOST_POSES = 60
"""Number of poses, at most, that are compared. More poses do not help, because the surface is known
less well than this number of poses determines the errors."""
GROUPS = 12
"""Number of groups of neighbouring poses that give the uncertainties: each hears the surface from
another side."""
FARTHER = 4
"""Number of times, at most, that a step is doubled while the error falls. Interference makes the
derivatives of fine cells steep but short, and steps too small."""
LARGEST_STEP = 0.5
"""Largest step of the range offset, range resolutions: beyond it the derivatives do not hold."""
LEAST_DB = 0.5
"""Difference below which all differences have the same weight, dB: physical optics is no more
accurate."""
_DB = 20.0 / math.log(10.0)


class Calibrator:
    """Gauss-Newton steps on the errors of a recording.

    Attributes:
        names: Name of each unknown: ``gain`` once for each ear, ``range_offset`` (m),
            ``speed_of_sound``, and ``layer`` (m) and ``scale`` of the surface.
        values (U,): Their present values; gains, speed and scale are natural logarithms.
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
        kinds: Sequence[Kind],
        *,
        dependent: float,
    ) -> None:
        self.mesh, self.echoes, self.optics = mesh, echoes, optics
        self.dependent = dependent
        poses = np.concatenate((echoes.training, echoes.validation))
        count = min(MOST_POSES, len(poses))
        self.poses = poses[np.linspace(0, len(poses) - 1, count).round().astype(int)]
        length = STEP * optics.wavelength
        reach = float(np.linalg.norm(echoes.positions - mesh.centroid, axis=1).mean())
        steps: dict[str, list[float]] = {}
        # The level of recordings is not known, and every other error would take it up.
        if "gain" in kinds or not echoes.calibrated:
            steps["gain"] = [0.0] * optics.ears
        if "range_offset" in kinds:
            steps["range_offset"] = [length]
        if "speed_of_sound" in kinds:
            steps["speed_of_sound"] = [length / reach]
        if {"range_offset", "speed_of_sound"} & set(kinds):
            steps |= {"layer": [length], "scale": [length / float(mesh.scale)]}
        self.names = [name for name, each in steps.items() for _ in each]
        self._steps = np.array([step for each in steps.values() for step in each])
        self.values: Floats = np.zeros(len(self.names))
        self._of_gain = np.flatnonzero([name == "gain" for name in self.names])
        self.weight = np.ones((optics.ears, 1, len(optics.frequencies)))
        self.error_db: list[float] = []
        self.deviation: Floats = np.zeros(len(self.names))
        self.change = math.inf
        self.stretch = 1.0

    def step(self, shown: Callable[[], None] = lambda: None) -> float:
        """Do one step; return the error before it, dB. ``shown`` is called once per pose."""
        count = len(self.names)
        bodies = self._bodies(slopes=True)
        self._begin(bodies[-1])
        normal, towards, slopes = np.zeros((count, count)), np.zeros(count), []
        errors, cost, cells = [], 0.0, 0.0
        sums = np.zeros((2, *self.weight.shape))
        for number in self.poses.tolist():
            residual, jacobian, active = self._linear(bodies, number)
            shown()
            slopes.append(np.zeros(count))
            if not active.any():
                continue
            sums[0] += (np.abs(residual) * active).sum(axis=1, keepdims=True)
            sums[1] += active.sum(axis=1, keepdims=True)
            weight = np.broadcast_to(self.weight, active.shape)[active]
            r, j = residual[active], jacobian[:, active]
            weight = weight / np.maximum(np.abs(r), LEAST_DB)
            errors.append(float(np.abs(r).mean()))
            normal += (j * weight) @ j.T
            slopes[-1] = (j * weight) @ r
            towards += slopes[-1]
            cost += float((weight * r * r).sum())
            cells += float(len(r))
        self.error_db.append(float(np.mean(errors)) if errors else math.inf)
        noise = cost / max(cells, 1.0) * self.dependent
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
        damped = normal / np.outer(scale, scale) + 1e-6 * np.eye(count)
        covariance = np.linalg.pinv(damped, hermitian=True) / np.outer(scale, scale)
        step = covariance @ towards
        unit = np.sqrt(np.maximum(noise * np.diag(covariance), 1e-30))
        self.change = float((np.abs(step) / unit).max(initial=0.0))
        spread = covariance @ self._scatter(np.stack(slopes)) @ covariance
        self.deviation = np.sqrt(np.maximum(noise * np.diag(covariance), np.diag(spread)).clip(0.0))
        self._move(step)
        if count:
            self._go_on(step)
        usual = sums[0] / np.maximum(sums[1], 1.0)
        usual = np.where(sums[1] > 0.0, usual, usual.max())
        power = np.maximum(usual, 0.25 * np.median(usual)) ** -TRUST
        self.weight = power / power.mean()
        return self.error_db[-1]

    def error(self) -> float:
        """Return the absolute difference of some poses over active cells, dB per measured one."""
        bodies = self._bodies(slopes=False)
        self._begin(bodies[-1])
        total, count = 0.0, 0
        for number in self._some():
            residual, measured, active = self._linear(bodies, number)
            total += float(np.abs(residual[active]).sum())
            count += int((measured >= ACTIVE_DB).sum())
        return total / count if count else math.inf

    def result(self) -> Estimate:
        """Return what was found so far."""
        calibration = Calibration.none(self.optics.ears)
        deviation: dict[str, float] = {}
        parts = zip(self.names, self.values.tolist(), self.deviation.tolist(), strict=True)
        for name, value, spread in parts:
            if name in ("range_offset", "speed_of_sound"):
                setattr(calibration, name, value)
            if name not in ("layer", "scale"):
                deviation[name] = max(deviation.get(name, 0.0), self.stretch * spread)
        if len(self._of_gain):
            calibration.gain = self.values[self._of_gain]
        return Estimate(calibration, deviation, list(self.error_db))

    def _some(self) -> list[int]:
        some: list[int] = self.poses[:: max(len(self.poses) // LEVEL_POSES, 1)].tolist()
        return some

    def _begin(self, body: StillSurface) -> None:
        """Take the first level of recordings from the energy of some poses."""
        if self.error_db or self.echoes.calibrated:
            return
        energy = np.zeros((2, self.optics.ears))
        for number in self._some():
            pose = slice(number, number + 1)
            rendered = body.render(self.echoes.positions[pose], self.echoes.rotations[pose])[0]
            for row, magnitude in enumerate((self.echoes.magnitude(number).numpy(), rendered)):
                energy[row] += np.square(magnitude, dtype=np.float64).sum(axis=(1, 2))
        level = np.log(np.maximum(energy[0], 1e-300) / np.maximum(energy[1], 1e-300)) / 2
        self.values[self._of_gain] = level

    def _value(self, name: str, values: Floats) -> float:
        return float(values[self.names.index(name)]) if name in self.names else 0.0

    def _bodies(self, *, slopes: bool) -> list[StillSurface]:
        """Return the surface for a change of each unknown, and as it is, last."""
        normals, middle = np.array(self.mesh.vertex_normals), self.mesh.centroid

        def body(values: Floats) -> StillSurface:
            layer, scale = (self._value(name, values) for name in ("layer", "scale"))
            places = (self.mesh.vertices - middle) * math.exp(scale) + middle + layer * normals
            moved = trimesh.Trimesh(places, self.mesh.faces, process=False)
            return StillSurface(moved, self.optics)

        now = body(self.values)
        if not slopes:
            return [now]
        changed = [
            body(self.values + step) if name in ("layer", "scale") else now
            for name, step in zip(self.names, np.diag(self._steps), strict=True)
        ]
        return [*changed, now]

    def _linear(self, bodies: list[StillSurface], number: int) -> tuple[Floats, Floats, Bools]:
        """Return residual (E, R, F) dB, derivatives (U, E, R, F) and active cells of a pose.

        With one body, what was measured (E, R, F) stands in place of the derivatives.
        """
        pose = slice(number, number + 1)
        gain = np.zeros(self.optics.ears)
        if len(self._of_gain):
            gain = self.values[self._of_gain]
        measured = self.echoes.magnitude(number).numpy().astype(np.float64)
        reference = max(float(measured.max()) * 10.0 ** (-FLOOR_DB / 20.0), 1e-30)

        def level(body: StillSurface, values: Floats) -> Floats:
            stretch = math.exp(-self._value("speed_of_sound", values))
            late = 2.0 * self._value("range_offset", values)
            at = self.echoes.positions[pose], self.echoes.rotations[pose]
            magnitude = np.exp(gain)[:, None, None] * body.render(*at, stretch, late)[0]
            return compress(magnitude, reference)

        a, b = compress(measured, reference), level(bodies[-1], self.values)
        active = (a >= ACTIVE_DB) | (b >= ACTIVE_DB)
        if len(bodies) == 1:
            return a - b, a, active
        slopes = []
        changes = zip(self._steps, np.diag(self._steps), bodies, strict=False)
        for index, (step, change, body) in enumerate(changes):
            if step:
                slopes.append((level(body, self.values + change) - b) / step)
                continue
            slope = -_DB * np.expm1(-b / _DB)  # of a gain
            slope[np.arange(len(slope)) != np.flatnonzero(self._of_gain == index)] = 0.0
            slopes.append(slope)
        return a - b, np.stack(slopes) if slopes else np.zeros((0, *b.shape)), active

    def _scatter(self, slopes: Floats) -> Floats:
        """Return the covariance of the sums of slopes (P, U) over groups of neighbouring poses.

        What a surface does not explain is alike at poses that are neighbours, so that their cells
        are no independent measurements.
        """
        away = self.echoes.positions[self.poses] - self.mesh.centroid
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        _, group = np.unique(
            (away @ fibonacci_sphere(GROUPS).T).argmax(axis=1), return_inverse=True
        )
        sums = np.zeros((group.max() + 1, slopes.shape[1]))
        np.add.at(sums, group, slopes)
        sums -= sums.mean(axis=0)
        return np.asarray(sums.T @ sums * len(sums) / max(len(sums) - 1, 1))

    def _move(self, step: Floats) -> None:
        bound = np.full(len(step), np.inf)
        bound[[name == "range_offset" for name in self.names]] = (
            LARGEST_STEP * self.optics.head.resolution
        )
        self.values = self.values + step.clip(-bound, bound)

    def _go_on(self, step: Floats) -> None:
        """Repeat a step, each time doubled, as long as the error falls."""
        best, moved, doubled = self.error(), 1.0, 1.0
        for _ in range(FARTHER):
            self.stretch = max(self.stretch, moved)
            before = self.values
            self._move(step)
            error = self.error()
            if error >= best:
                self.values = before
                return
            moved += doubled
            best, step, doubled = error, 2.0 * step, 2.0 * doubled
