# SPDX-License-Identifier: MIT
r"""Test of pose conventions: which one explains the first echoes best.

First echoes are compared under the stated convention and under others that people mix up. Three
criteria distinguish them, each as a scale of errors s whose logarithm is summed over the pings, the
log-likelihood of errors of an unknown scale:

* how well each ping's range is predicted by the others' (``distance_model``),
* how well the *differences* between its receivers are: they tell left from right,
* how far from the body the heads look.

Another convention is named if it explains the echoes clearly better; one is that each ping belongs
to the pose one row later or earlier. Four faults show without another convention: places that lie a
thousand times too far apart or too close together for the ranges, ranges too long for any body to
fit between the poses, as a late time zero makes them, and poses that explain the echoes no better
than the same poses in any other order.

What first echoes do not show: a time zero that is too early (the body is then larger all around,
and every ping agrees), and a mirrored world as heard by one microphone beside its emitter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from sononerf.geometry.poses import Poses, off_axis
from sononerf.numerics import Floats, Ints
from sononerf.recordings.pose_tables import (
    EULER,
    PLACE,
    QUATERNION,
    Columns,
    frame_matrices,
    has_rotations,
    to_poses,
)
from sononerf.recordings.ranges import RangePrediction, predict_ranges
from sononerf.settings.sections import LENGTHS, ImportSettings

MIN_PINGS = 12
"""Number of pings below which nothing can be tested."""
MAX_PINGS = 400
"""Number of pings, at most, that are tested, evenly over all."""
MOST_SCREENED = 64
"""Number of pings, evenly over all, on which a convention must be better to be tested on all."""
MIN_GAIN_PER_PING = 0.15
"""Least gain in log-likelihood per ping for another convention to be named."""
MIN_GAIN = 12.0
"""Least gain in log-likelihood of all pings: odds of e^12."""
EQUAL_GAIN = 0.95
"""Gain over that of the best convention from which another convention is named beside it."""
MAX_POSE_SPREAD, MIN_POSE_SPREAD = 100.0, 0.01
"""Spread of the poses over the median range beyond which a unit is wrong, no unit. A flight of a
hundred metres past things one metre away is still right."""
MAX_RANGE_ERROR = 1.0
"""A first echo contradicts the others if its range differs by more than this from the range that
they predict, in range resolutions. Sound sets differ by 0.1 to 0.6 in the median."""
MIN_ORDER_GAIN = 0.6
"""A table counts as shuffled if its gain over random orders of the poses is below this, in
log-likelihood per ping. The largest gain of 40 shuffled sets was 0.33; right poses gain 2 or
more."""
MOST_CHANNELS = 8
"""Number of channels, at most, that are swapped in pairs: 28 pairs take some seconds."""
RANGE_FACTORS = tuple(float(f) for f in np.exp(np.linspace(-0.6, 0.6, 13)) if abs(f - 1.0) > 0.01)
"""Factors of all ranges, 10 % apart: those of a wrong sampling rate or speed of sound."""
MIN_SCALE_GAIN = 0.5
"""Least gain in log-likelihood per ping for such a factor to be named. Of 120 sound sets two gained
0.3, and the others less."""
RANDOM_ORDERS = 4
"""Number of random orders that the stated order of the poses is compared with."""
XYZW = (QUATERNION[-1], *QUATERNION[:-1])
"""Columns that hold w, x, y, z if numbers in the order x, y, z, w have the names w, x, y, z."""
MIRROR = np.diag([1.0, -1.0, 1.0])
AXES = "other axes of the head, "
"""Part of the name of such a convention; the settings that correct it follow."""
MOST_NAMED = 3
"""Number of conventions, at most, that a message names."""
AIM_FLOOR = np.radians(20.0)
"""Angle between aim and body below which all heads count as aiming equally well, rad."""
MIN_DIRECTION_SPREAD = 0.15
"""Least fraction of the directions' variance along their weakest axis from which poses count as all
around."""


@dataclass(frozen=True)
class Verdict:
    """Faults of the poses, if there are any."""

    # Name of the convention that explains the echoes best; empty if it is the stated one
    name: str = ""
    message: str = ""  # One line for the user; empty if nothing is wrong
    gain: float = 0.0  # Gain in log-likelihood


def alternatives(columns: Columns, settings: ImportSettings) -> dict[str, Poses]:
    """Return the poses of a table under conventions that are easily mixed up."""
    stated = to_poses(columns, settings)
    readings: dict[str, Poses] = {}
    if settings.turntable is not None:
        table = settings.turntable
        other = "counterclockwise" if table.turns == "clockwise" else "clockwise"
        reversed_table = table.model_copy(update={"turns": other})
        readings["reversed turntable"] = to_poses(
            columns, settings.model_copy(update={"turntable": reversed_table})
        )
        for name, factor in _angle_factors(columns, "angle"):
            readings[name] = to_poses(_scaled(columns, ("angle",), factor), settings)
        return _different(stated, readings)
    readings["left-handed frame"] = mirrored(stated)
    if columns.has(*EULER):
        for name, factor in _angle_factors(columns, "yaw"):
            readings[name] = to_poses(_scaled(columns, EULER, factor), settings)
        for angle in ("yaw", "pitch"):
            readings[f"sign of {angle}"] = to_poses(_scaled(columns, (angle,), -1.0), settings)
        for other in ("roll", "pitch"):
            values = columns.values
            swapped = {**values, "yaw": values[other], other: values["yaw"]}
            readings[f"yaw and {other} swapped"] = to_poses(_with(columns, swapped), settings)
        heading = {**columns.values, "yaw": np.pi / 2.0 - columns.values["yaw"]}
        readings["compass heading"] = to_poses(_with(columns, heading), settings)
        order = "xyz" if settings.euler == "zyx" else "zyx"
        readings[f"import.euler={order}"] = to_poses(
            columns, settings.model_copy(update={"euler": order})
        )
    if columns.has(*QUATERNION):
        parts = {name: columns.values[old] for name, old in zip(QUATERNION, XYZW, strict=True)}
        readings["quaternion order"] = to_poses(
            _with(columns, {**columns.values, **parts}), settings
        )
    if has_rotations(columns):
        for what in ("rotations", "poses"):
            inverse = None if settings.inverse == what else what
            readings[f"inverse {what}"] = to_poses(
                columns, settings.model_copy(update={"inverse": inverse})
            )
        readings |= _head_axes(columns, settings)
    for order in ("yxz", "zyx", "xzy", "yzx", "zxy"):
        places = {name: columns.values[old] for name, old in zip(PLACE, order, strict=True)}
        readings[f"swapped axes, {order} for xyz"] = to_poses(
            _with(columns, {**columns.values, **places}), settings
        )
    stated_unit = columns.units.get(PLACE[0], "m")
    for unit in LENGTHS:
        if unit != stated_unit:
            factor = LENGTHS[unit] / LENGTHS[stated_unit]
            readings[f"{unit} for {stated_unit}"] = to_poses(
                _scaled(columns, PLACE, factor), settings
            )
    for axis in PLACE:
        readings[f"sign of {axis}"] = to_poses(_scaled(columns, (axis,), -1.0), settings)
    return _different(stated, readings)


def shifted(columns: Columns, pings: Ints, settings: ImportSettings) -> dict[str, Poses]:
    """Return the poses of pings if each ping belongs to the next or to the previous row.

    In: pings (P,).
    """
    last = len(columns) - 1
    return {
        name: to_poses(columns.take((pings + step).clip(0, last)), settings)
        for name, step in (("the row after", 1), ("the row before", -1))
    }


def mirrored(poses: Poses) -> Poses:
    """Return poses as a mirror shows them: the world's and the head's y point the other way."""
    return Poses(poses.positions @ MIRROR, MIRROR @ poses.rotations @ MIRROR)


def _head_axes(columns: Columns, settings: ImportSettings) -> dict[str, Poses]:
    """Return the poses if a head has other axes, in a right-handed and a left-handed frame."""
    world, head = frame_matrices(settings)
    readings = {}
    for turn in Rotation.create_group("O").as_matrix().round().astype(int):
        for name, mirror in (("", np.eye(3)), ("a left-handed frame and ", MIRROR)):
            own = {"axes": mirror @ world, "head_axes": turn @ mirror @ head}
            rows = {key: (matrix.round(6) + 0.0).tolist() for key, matrix in own.items()}
            advice = "import.frame=own " + " ".join(
                f"import.{key}=[{','.join(_row(row) for row in matrix)}]"
                for key, matrix in rows.items()
            )
            # Ears hardly tell a mirrored world with the head upside down from the stated one.
            ahead_and_left = (turn @ mirror)[:2, :2]
            if not np.array_equal(ahead_and_left, np.eye(2)):
                readings[f"{name}{AXES}{advice}"] = to_poses(
                    columns, settings.model_copy(update={"frame": "own", **rows})
                )
    return readings


def _row(row: list[float]) -> str:
    return f"[{','.join(f'{value:g}' for value in row)}]"


def _with(columns: Columns, values: dict[str, Floats]) -> Columns:
    return Columns(columns.where, values, columns.texts, columns.rotation, columns.units)


def _scaled(columns: Columns, names: tuple[str, ...], factor: float) -> Columns:
    scaled = {name: factor * columns.values[name] for name in names}
    return _with(columns, {**columns.values, **scaled})


def _angle_factors(columns: Columns, name: str) -> list[tuple[str, float]]:
    if columns.units.get(name) == "rad":
        return [("degrees for radians", np.pi / 180.0)]
    return [("radians for degrees", 180.0 / np.pi)]


def _different(stated: Poses, readings: dict[str, Poses]) -> dict[str, Poses]:
    size = float(np.abs(stated.positions - stated.positions.mean(axis=0)).max()) + 1e-12
    return {
        name: poses
        for name, poses in readings.items()
        if not np.allclose(poses.positions, stated.positions, atol=1e-3 * size)
        or not np.allclose(poses.rotations, stated.rotations, atol=1e-3)
    }


def check_poses(
    first: Floats,
    stated: Poses,
    others: Mapping[str, Poses],
    *,
    emitter: Floats,
    receivers: Floats,
    resolution: float,
) -> Verdict:
    """Name the convention that explains the first echoes, if it is not the stated one.

    In: first ((P, E), m), emitter ((3,), m), receivers ((E, 3), m), resolution (m).
    """
    heard = np.flatnonzero(np.isfinite(first).any(axis=1))
    if len(heard) < MIN_PINGS:
        return Verdict()
    sampled = heard[np.linspace(0, len(heard) - 1, min(MAX_PINGS, len(heard))).round().astype(int)]
    sampled = np.unique(sampled)
    ranges = np.where(np.isfinite(first[sampled]), first[sampled], np.nan)
    unit = _unit(stated[sampled], ranges)
    if unit.name:
        return unit
    head = Consistency(emitter, receivers, resolution)
    own = head.misfit(stated[sampled], ranges)
    scaled = _scaled_ranges(head, stated[sampled], ranges, own)
    few = np.linspace(0, len(sampled) - 1, min(MOST_SCREENED, len(sampled))).round().astype(int)
    own_few = head.misfit(stated[sampled[few]], ranges[few]).total
    misfits = {
        name: head.misfit(poses[sampled], ranges)
        for name, poses in others.items()
        if not _is_unit(name)
        or _disproportion(poses[sampled], ranges) < _disproportion(stated[sampled], ranges)
        if head.misfit(poses[sampled[few]], ranges[few]).total < own_few
    }
    gains = {name: own.total - one.total for name, one in misfits.items()}
    enough = max(MIN_GAIN, MIN_GAIN_PER_PING * len(sampled))
    late = _late(stated[sampled], own.prediction, resolution)
    if late.name:
        # A wrong unit makes them too long as well.
        fit = {
            name: gain
            for name, gain in gains.items()
            if _is_unit(name) and gain > enough
            if not _late(others[name][sampled], misfits[name].prediction, resolution).name
        }
        best = max(fit, key=fit.__getitem__, default="")
        if fit and fit[best] > scaled.gain:
            return Verdict(best, _message([best]), fit[best])
        return scaled if scaled.name else late
    for one, other in combinations(range(min(ranges.shape[1], MOST_CHANNELS)), 2):
        swapped = np.arange(ranges.shape[1])
        swapped[[one, other]] = other, one
        name = f"channels {one} and {other} swapped"
        # Two ears that are swapped hear as a left-handed frame does; that is named first.
        found = head.misfit(stated[sampled], ranges[:, swapped])
        gains[name] = EQUAL_GAIN * (own.total - found.total)
    best = max(gains, key=gains.__getitem__, default="")
    order = _order(head, stated[sampled], ranges, own)
    better = order.gain + max(gains.get(best, 0.0), 0.0)
    if order.name and better < MIN_ORDER_GAIN * len(sampled):
        return order
    if scaled.name and scaled.gain > gains.get(best, 0.0):
        return scaled
    if not best or gains[best] < enough:
        return Verdict()
    equal = [name for name in gains if name != best and gains[name] >= EQUAL_GAIN * gains[best]]
    turns = _turns(stated)
    named = [
        "reversed turntable" if turns and name == "left-handed frame" else name
        # A simpler convention that explains the echoes as well is named first.
        for name in sorted((best, *equal), key=_axes_named)
    ]
    return Verdict(named[0], _message(named), gains[best])


def _scaled_ranges(head: Consistency, poses: Poses, ranges: Floats, own: PoseMisfit) -> Verdict:
    """Return a verdict if all ranges times one factor fit the poses clearly better.

    Poses at one distance from the body fit ranges of any scale.
    """
    gains = {}
    for factor in RANGE_FACTORS:
        # Longer ranges have longer errors.
        found = Consistency(head.emitter, head.receivers, factor * head.resolution).misfit(
            poses, factor * ranges
        )
        gains[factor] = own.total - found.total + found.count * math.log(factor)
    best = max(gains, key=gains.__getitem__)
    if gains[best] < MIN_SCALE_GAIN * len(poses):
        return Verdict()
    return Verdict(
        "scale of ranges",
        f"the poses fit ranges that are {best:.2f} times those of the first echoes: check the "
        "sampling rate (import.sampling_rate) and the speed of sound (air)",
        gains[best],
    )


def _order(head: Consistency, poses: Poses, ranges: Floats, own: PoseMisfit) -> Verdict:
    """Return the gain of the stated order of the poses over random orders.

    The verdict is empty if few echoes contradict the others, because then the order is right, or
    it makes no difference.
    """
    error = np.abs(own.prediction.residual)
    known = np.isfinite(error).any(axis=1)
    count = int((np.nanmean(error[known], axis=1) > MAX_RANGE_ERROR * head.resolution).sum())
    if 2 * count < len(poses):
        return Verdict()
    rng = np.random.default_rng(0)
    shuffled = [poses[rng.permutation(len(poses))] for _ in range(RANDOM_ORDERS)]
    gain = float(np.mean([head.misfit(one, ranges).total for one in shuffled])) - own.total
    return Verdict(
        "shuffled table",
        f"{count} of {len(poses)} first echoes contradict the others, and the poses in random "
        "order explain them as well: check that row n of the table belongs to ping n",
        gain,
    )


@dataclass(frozen=True, eq=False)
class PoseMisfit:
    """Misfit between poses and first echoes."""

    total: float  # Sum of the logarithms of the scales of errors; less is better
    count: float  # Number of errors in the sum
    prediction: RangePrediction  # Prediction of each ping by the others


@dataclass(frozen=True, eq=False)
class Consistency:
    """Consistency of poses with the first echoes of a head."""

    emitter: Floats  # (3,), m: Head frame
    receivers: Floats  # (E, 3), m: Head frame
    resolution: float  # m: Range resolution

    def misfit(self, poses: Poses, first: Floats) -> PoseMisfit:
        """Return the sum of logarithms of error scales of pings (P, E)."""
        out = poses.positions + poses.rotations @ self.emitter
        back = poses.positions[:, None] + np.einsum("pij,ej->pei", poses.rotations, self.receivers)
        middle = (out[:, None] + back) / 2.0
        prediction = predict_ranges(middle, back - out[:, None], first)
        floor = 0.1 * self.resolution
        both = np.isfinite(prediction.residual).sum(axis=1) > 1
        common = np.nanmean(
            prediction.residual[np.isfinite(prediction.residual).any(axis=1)], axis=1
        )
        count = float(len(common))
        total = count * np.log(_scale(common, floor)) if count else 0.0
        if both.any():
            rest = prediction.residual[both]
            apart = rest - np.nanmean(rest, axis=1, keepdims=True)
            apart = apart[np.isfinite(apart)]
            freedom = len(apart) * (1.0 - 1.0 / rest.shape[1])
            total += freedom * np.log(_scale(apart, floor / 2.0))
            count += freedom
        if self._hears_direction():
            angle = off_axis(poses, prediction.centre)
            total += len(angle) * np.log(max(float(np.median(angle)), AIM_FLOOR))
        return PoseMisfit(float(total), count, prediction)

    def _hears_direction(self) -> bool:
        """Return True if the orientation of the head matters."""
        return bool(np.abs(self.receivers - self.emitter).max() > 0.0)


def _scale(error: Floats, floor: float) -> float:
    """Return a robust standard deviation, m."""
    return float(np.hypot(1.48 * np.median(np.abs(error)), floor))


def _spread(poses: Poses) -> float:
    """Return the root mean square distance of poses from their mean, m."""
    away = poses.positions - poses.positions.mean(axis=0)
    return float(np.sqrt(np.square(away).sum(axis=1).mean()))


def _disproportion(poses: Poses, ranges: Floats) -> float:
    """Return the ratio of the spread of poses and their usual range, either way, in nepers."""
    return abs(math.log(max(_spread(poses), 1e-12) / float(np.nanmedian(ranges))))


def _unit(poses: Poses, ranges: Floats) -> Verdict:
    """Compare how far poses lie apart with how far their echoes come from."""
    spread = _spread(poses)
    usual_range = float(np.nanmedian(ranges))
    said = (
        f"poses lie {_length(spread)} from their mean, and their first echoes come from "
        f"{_length(usual_range)}"
    )
    if spread > MAX_POSE_SPREAD * usual_range:
        return Verdict("millimetres for metres", f"{said}: are the lengths in mm?", np.inf)
    if 0.0 < spread < MIN_POSE_SPREAD * usual_range:
        return Verdict("metres for millimetres", f"{said}: are the lengths in m?", np.inf)
    return Verdict()


def _length(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 0.01 else f"{1000 * metres:.3g} mm"


def _late(poses: Poses, prediction: RangePrediction, resolution: float) -> Verdict:
    """Return a verdict if the ranges are too long for any body amid the poses."""
    away = poses.positions - prediction.centre
    distance = np.linalg.norm(away, axis=1)
    direction = away / np.maximum(distance, 1e-12)[:, None]
    if np.linalg.eigvalsh(direction.T @ direction / len(direction))[0] < MIN_DIRECTION_SPREAD:
        return Verdict()
    error = np.abs(prediction.residual[np.isfinite(prediction.residual)])
    slack = resolution + (2.0 * float(np.median(error)) if len(error) else 0.0)
    if prediction.size > -slack:
        return Verdict()
    late = -prediction.size
    return Verdict(
        "time offset",
        f"first echoes come {1000 * late:.0f} mm too late, or more, for any body amid the poses: "
        "check the time of the emission (import.time_offset)",
        np.inf,
    )


def _turns(poses: Poses) -> bool:
    """Return True if poses are those of a turntable: on a cylinder, level, looking at its axis."""
    forward = poses.rotations[:, :, 0]
    if np.abs(forward[:, 2]).max() > 0.05:
        return False
    # The axis is nearest to all lines of sight, seen from above.
    across = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    offset = (across * poses.positions[:, :2]).sum(axis=1)
    axis, *_ = np.linalg.lstsq(across, offset, rcond=None)
    radius = np.linalg.norm(poses.positions[:, :2] - axis, axis=1)
    return bool(np.abs(across @ axis - offset).max() < 0.02 * radius.mean() > 10 * radius.std())


def _is_unit(name: str) -> bool:
    return name.split(" for ")[0] in LENGTHS


HINTS = {
    "inverse rotations": "the rotations lead from the world to the head (import.inverse=rotations)",
    "inverse poses": "rotations and places lead from the world to the head (import.inverse=poses)",
    "compass heading": "yaw is a compass heading, clockwise from y (replace it by 90 degrees "
    "minus yaw)",
    "quaternion order": "the quaternion's scalar is its last number (columns qx, qy, qz, qw)",
    "the row after": "each ping belongs to the pose one row later; pings and poses are off by one",
    "the row before": "each ping belongs to the pose one row earlier; pings and poses are off "
    "by one",
    "left-handed frame": "left and right are mixed up; is the frame left-handed, or does z point "
    "down (import.frame), or are channels swapped (import.channels)?",
    "reversed turntable": "the turntable turns the other way (import.turntable.turns)",
    "degrees for radians": "angles are in degrees, not in radians (import.angle)",
    "radians for degrees": "angles are in radians, not in degrees (import.angle)",
    "yaw and roll swapped": "the columns yaw and roll are swapped",
    "yaw and pitch swapped": "the columns yaw and pitch are swapped",
}


def _axes_named(name: str) -> int:
    """Return 1 for other axes of the head, 2 in a left-handed frame as well, and 0 otherwise."""
    return (AXES in name) + (AXES in name and not name.startswith(AXES))


def _message(names: list[str]) -> str:
    hints = " or ".join(dict.fromkeys(_hint(name) for name in names[:MOST_NAMED]))
    more = len(names) - MOST_NAMED
    further = f"; {more} other conventions explain them as well" if more > 0 else ""
    return f"another convention of poses explains the first echoes better: {hints}{further}"


def _hint(name: str) -> str:
    if name.startswith("swapped axes"):
        order = name.removeprefix("swapped axes, ")[:3]
        return "x, y and z stand in the columns {}, {} and {}".format(*order)
    if _is_unit(name):
        unit, _, stated = name.partition(" for ")
        return (
            f"the lengths are in {unit}, not in {stated}: they are "
            f"{LENGTHS[unit] / LENGTHS[stated]:.3g} times as long (x_{unit}, or import.length)"
        )
    if AXES in name:
        what, _, advice = name.partition(AXES)
        return f"{what}{AXES[:-2]} ({advice})"
    if name.startswith("import.euler"):
        return f"yaw, pitch and roll are applied in the other order ({name})"
    if name.startswith("channels"):
        return f"{name} (import.channels, ears.receivers)"
    if name.startswith("sign of"):
        return f"the {name} is the opposite one"
    return HINTS[name]
