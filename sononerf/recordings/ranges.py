# SPDX-License-Identifier: MIT
r"""Model of the distance between a body's nearest point and any place, from first echoes.

Half of the way from emitter to receiver over a far body is the distance :math:`d(m)` of the point
:math:`m` half way between the two, but for :math:`b^2 / 8 d` with b the part of their separation
across the line of sight. The distance is modelled as

.. math:: d(m) = |m - c| - \sum_k a_k Y_k\!\left(\frac{m - c}{|m - c|}\right)

with polynomials Y of the direction. Centre and coefficients are fitted robustly; each ping is
predicted by a fit without its own part of the pings.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sononerf.echoes.detection import MOST_POSES
from sononerf.echoes.region import echo_extent
from sononerf.errors import InputError
from sononerf.head.call import call_waveform, covered, sweep_delay
from sononerf.head.ears import beam_gain, ear_gain
from sononerf.head.front_end import dechirped_spectrogram, frequency_axis, range_axis
from sononerf.head.head import Head
from sononerf.numerics import Floats
from sononerf.progress import Progress
from sononerf.recordings.readers import read_sound
from sononerf.recordings.recording import Cutter, Recording, cut, mixed_channels
from sononerf.resources import require_memory
from sononerf.settings.schema import CallSettings, SpectrogramSettings
from sononerf.settings.sections import ImportSettings, ReferenceSettings

DEGREE = 4
"""Largest degree of the polynomials, no unit: it separates parts of a body 45 degrees apart."""
PER_COEFFICIENT = 4
"""Least number of pings for each coefficient, no unit."""
PARTS = 6
"""Number of parts of the pings; each part is predicted from the others (cross-validation)."""
ROUNDS = 8
"""Number of passes of the robust fit; after these the weights no longer change."""
RIDGE = 1e-3
"""Weight of the ridge penalty on the coefficients, no unit: that of one in a thousand pings."""


@dataclass(frozen=True, eq=False)
class RangePrediction:
    """First echoes of the pings as predicted from one another.

    Attributes:
        residual ((P, E), m): Measured less predicted; NaN where nothing was measured.
        centre ((3,), m): From where distances are counted.
        size (m): Mean distance from there to the body's surface; negative if the echoes contradict
            one another by so much.
    """

    residual: Floats
    centre: Floats
    size: float


def predict_ranges(middle: Floats, separation: Floats, first: Floats) -> RangePrediction:
    """Predict each ping's first echoes from the other pings'.

    Args:
        middle ((P, E, 3), m): Points half way between emitter and receivers.
        separation ((P, E, 3), m): From the emitter to each receiver.
        first ((P, E), m): Ranges of first echoes; not finite without an echo.
    """
    known = np.isfinite(first).any(axis=1)
    pings = np.flatnonzero(known)
    residual = np.full(first.shape, np.nan)
    centre, size = _sphere(middle[pings], first[pings])
    away = middle - centre
    radius = np.linalg.norm(away, axis=2)
    direction = away / np.maximum(radius, 1e-12)[..., None]
    across = separation - (separation * direction).sum(2, keepdims=True) * direction
    wide = (across**2).sum(2)
    measured = first - wide / (8.0 * np.maximum(first, 1e-3))
    degree = DEGREE
    while degree > 1 and len(_powers(degree)) * PER_COEFFICIENT > len(pings):
        degree -= 1
    basis = _basis(direction, degree)
    target = radius - measured  # the body's extent towards each ping
    part = np.arange(len(pings)) % min(PARTS, max(len(pings), 1))
    for held in range(part.max(initial=-1) + 1):
        rest, own = pings[part != held], pings[part == held]
        there = np.isfinite(first[rest])
        if there.sum() <= basis.shape[2]:
            continue
        weights = _robust(basis[rest][there], target[rest][there])
        residual[own] = basis[own] @ weights - target[own]
    residual[~np.isfinite(first)] = np.nan
    return RangePrediction(residual, centre, size)


def _powers(degree: int) -> list[tuple[int, ...]]:
    """Return the monomials of x, y, z of a degree and one less: all polynomials on the sphere."""
    return [
        powers
        for total in (degree - 1, degree)
        for powers in combinations_with_replacement(range(3), total)
    ]


def _basis(direction: Floats, degree: int) -> Floats:
    columns = [
        np.prod(direction[..., list(powers)], axis=-1) if powers else np.ones(direction.shape[:-1])
        for powers in _powers(degree)
    ]
    return np.stack(columns, axis=-1)


def _robust(basis: Floats, target: Floats) -> Floats:
    """Fit coefficients by least squares whose weights fall with the residual."""
    weight = np.ones(len(target))
    middle = float(np.median(target))
    pull = RIDGE * len(target) * np.eye(basis.shape[1])
    # The pull is towards a sphere, not towards nothing.
    sphere = np.linalg.lstsq(basis, np.full(len(basis), middle), rcond=None)[0]
    fitted = sphere
    for _ in range(ROUNDS):
        scaled = basis * weight[:, None]
        rest = target - basis @ sphere
        fitted = sphere + np.linalg.solve(basis.T @ scaled + pull, scaled.T @ rest)
        error = target - basis @ fitted
        scale = 1.48 * float(np.median(np.abs(error))) + 1e-9
        weight = 1.0 / np.maximum(np.abs(error) / (1.5 * scale), 1.0) ** 2
    return fitted


def _sphere(middle: Floats, first: Floats) -> tuple[Floats, float]:
    """Return centre (3,) and radius of the sphere that explains first echoes best."""
    there = np.isfinite(first)
    places, ranges = middle[there], first[there]
    start = places.mean(axis=0)
    spread = float(np.linalg.norm(places - start, axis=1).mean())
    scale = max(float(np.median(ranges)), 1e-6)

    def misfit(unknown: Floats) -> Floats:
        return (np.linalg.norm(places - unknown[:3], axis=1) - unknown[3] - ranges) / scale

    def slope(unknown: Floats) -> Floats:
        away = places - unknown[:3]
        length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        return -np.hstack([away / length, np.ones((len(away), 1))]) / scale

    best = None
    # Poses on one side of a body leave two sides to look on.
    for side in _sides(places, start, scale):
        guess = np.r_[side, np.linalg.norm(places - side, axis=1).mean() - np.median(ranges)]
        solution = least_squares(
            misfit,
            guess,
            slope,
            loss="soft_l1",
            f_scale=0.02,
            max_nfev=60,
            x_scale=max(spread, scale),
        )
        if best is None or solution.cost < best.cost:
            best = solution
    assert best is not None
    return best.x[:3], float(best.x[3])


def _sides(places: Floats, start: Floats, scale: float) -> list[Floats]:
    """Return guesses of a centre: amid the places, and beside them where they are flattest."""
    normal = np.linalg.eigh(np.cov((places - start).T))[1][:, 0]
    return [start, start + scale * normal, start - scale * normal]


SEARCH_FRACTION = 0.25
"""Half width of the search for the sphere's echo, as a fraction of the sphere's distance."""


@dataclass(frozen=True, eq=False)
class SphereCalibration:
    """Calibration from the echo of the reference target."""

    gain: Floats  # (E,): Factor that brings each receiver to the call's pressure at 1 m
    range_offset: float  # m: To be added to every range


def calibrate_recording(
    echo: Floats, reference: ReferenceSettings, head: Head
) -> SphereCalibration:
    r"""Compare the echo of a reference target with theory.

    A rigid sphere of radius a, large against the wavelength, sends back a/2 of the pressure that
    falls on it, at 1 m [1]_. Heard at distance r of its surface that is, of the call's pressure at
    1 m,

    .. math:: \frac{a}{2} \frac{10^{-\alpha (d_e + d_r) / 20}}{(d_e + a)(d_r + a)} G_e G_r

    with :math:`d_e, d_r` from emitter and receiver to the surface and G the gains straight ahead.

    In: echo (E, S).

    References:
        .. [1] R. J. Urick, Principles of Underwater Sound, 3rd edition, 1983, table 9.1.
    """
    ears, call, speed_of_sound = head.gains, head.call, head.speed_of_sound
    absorption = head.absorption(head.frequency)
    near = head.spectrogram.model_copy(
        update={
            "hop": 1,
            "range_min": reference.distance * (1.0 - SEARCH_FRACTION),
            "range_max": reference.distance * (1.0 + SEARCH_FRACTION),
        }
    )
    frequency = frequency_axis(near)
    delay = sweep_delay(call, frequency)
    axis = range_axis(near, speed_of_sound)
    try:
        heard = dechirped_spectrogram(echo, near, speed_of_sound, delay)
    except ValueError as error:
        raise InputError(f"import.reference: {error}") from None
    swept = covered(call, frequency)
    swept = swept if swept.any() else np.ones_like(swept)
    power = np.square(heard[..., swept]).mean(axis=-1)  # (E, R)
    top = power.argmax(axis=1)
    if not (power.max(axis=1) > 0.0).all() or (top == 0).any() or (top == len(axis) - 1).any():
        raise InputError(
            f"{reference.file}: no echo of the reference target within "
            f"{100 * SEARCH_FRACTION:.0f} % of {reference.distance:g} m; check "
            "import.reference.distance and time"
        )
    centre = ears.emitter + np.array([reference.distance + reference.radius, 0.0, 0.0])
    to_emitter = centre - ears.emitter
    to_ears = centre - ears.positions
    out = np.linalg.norm(to_emitter)
    back = np.linalg.norm(to_ears, axis=1)
    path = (out + back) / 2.0 - reference.radius
    gain = np.stack(
        [
            beam_gain(ears, to_emitter[None] / out)[0]
            * ear_gain(ears, ear, to_ears[ear : ear + 1] / back[ear])[0]
            for ear in range(len(back))
        ]
    )
    loss = 10.0 ** (-absorption[None] * 2.0 * path[:, None] / 20.0)
    expected = reference.radius / 2.0 * loss * gain / (out * back)[:, None]
    time, direct = _call_itself(call, near, delay)
    model = np.square(expected * direct.max(axis=0))[:, swept].mean(axis=1)
    measured = np.take_along_axis(power, top[:, None], axis=1)[:, 0]
    # Rows at the ends of a sweep are lopsided, and so is the peak of their mean.
    profile = np.square(direct * expected[:, None])[..., swept].mean(axis=-1)
    bias = speed_of_sound / 2.0 * _peak(time, profile, profile.argmax(axis=1))
    offsets = path + bias - _peak(axis, power, top)
    return SphereCalibration(np.sqrt(model / measured), float(offsets.mean()))


def _call_itself(
    call: CallSettings, spectrogram: SpectrogramSettings, delay: Floats
) -> tuple[Floats, Floats]:
    """Return the dechirped spectrogram (T, F) of the call, and its times (T,) s."""
    waveform, rate = call_waveform(call, spectrogram.sampling_rate), spectrogram.sampling_rate
    lead = len(waveform) + 2 * spectrogram.window
    # At a speed of 2 m/s ranges are seconds.
    own = spectrogram.model_copy(update={"range_min": 1e-12, "range_max": 2 * lead / rate})
    echo = np.zeros((1, 4 * lead + spectrogram.window + int(delay.max() * rate)))
    echo[0, lead : lead + len(waveform)] = waveform
    return range_axis(own, 2.0) - lead / rate, dechirped_spectrogram(echo, own, 2.0, delay)[0]


def _peak(axis: Floats, power: Floats, top: NDArray[np.intp]) -> Floats:
    """Return the ranges of the tops, between slices, (E,) m."""
    rows = np.arange(len(top))
    before, at, after = (np.log(power[rows, top + step] + 1e-300) for step in (-1, 0, 1))
    bend = 2.0 * at - before - after
    shift = np.where(bend > 1e-12, 0.5 * (after - before) / np.maximum(bend, 1e-12), 0.0)
    return axis[top] + shift.clip(-1, 1) * (axis[1] - axis[0])


INAUDIBLE_DB = 140.0
"""Two-way absorption beyond which no echo is sought, dB: 24 bits record 144 dB."""
MAX_SHORT_FRACTION = 0.1
"""Largest fraction of the pings that may be shorter than the analysed range; they are named if
echoes of the others come later."""
MAX_PINGS = 64
"""Number of pings, evenly over all, that determine ranges and noise."""


def analysis_bytes(head: Head, pings: int) -> float:
    """Return the memory of an analysis, bytes: frames of one ping, and copies of all powers."""
    frame = head.spectrogram.window + 4 * len(head.frequency)
    return 8.0 * len(head.receivers) * len(head.range) * (frame + 6 * min(pings, MOST_POSES))


def range_limits(
    head: Head, cutter: Cutter, recording: Recording, given: Collection[str], progress: Progress
) -> tuple[dict[str, float], Floats]:
    """Find range limits that are left out from the echoes. Out: power (P, E, R)."""
    spectrogram, speed = head.spectrogram, head.speed_of_sound
    rate = spectrogram.sampling_rate
    lengths = np.array([cutter.samples(index) for index in range(len(recording))])
    count = int(np.quantile(lengths, MAX_SHORT_FRACTION, method="lower"))
    begins = max(cutter.begins(index) for index in range(len(recording)))
    metre = speed / 2.0 / rate  # of a sample
    longest = float(head.delay.max())
    loss = 2.0 * float(head.absorption(head.frequency).min())  # dB/m, there and back
    audible = INAUDIBLE_DB / loss if loss > 0.0 else math.inf
    whole = min(_widest(spectrogram.window, count, longest * rate, metre), audible)
    apart = np.linalg.norm(head.receivers - head.emitter, axis=1)
    # The call itself comes first, smeared by a window.
    dead = float(apart.max()) / 2.0 + 2.0 * spectrogram.window * metre
    first = max(dead, (begins + spectrogram.window / 2.0) * metre)
    low = spectrogram.range_min if "range_min" in given else first
    high = spectrogram.range_max if "range_max" in given else whole
    if low < (begins + (spectrogram.window - 1) / 2.0) * metre - metre:
        raise InputError(
            f"{recording.path}: a recording begins after spectrogram.range_min ({low:g} m); raise "
            "it, or leave it out"
        )
    if not low < high:
        what = "the recordings end" if recording.until is None else "the next call leaves"
        raise InputError(
            f"{recording.path}: {what} {1e3 * count / rate:.3g} ms after the emission, before "
            f"anything can be heard from {low:.3g} m on ({2e3 * low / speed:.3g} ms); check column "
            "time and its unit"
        )
    chosen = {"range_min": low, "range_max": high}
    wide = dataclasses.replace(head, spectrogram=spectrogram.model_copy(update=chosen))
    if wide.samples > count:
        raise InputError(
            f"{recording.path}: the recordings end {whole:.4g} m after the emission, before "
            f"spectrogram.range_max ({high:g} m); lower it, or leave it out"
        )
    long_enough = np.flatnonzero(lengths >= count)
    asked = (
        np.linspace(0, len(long_enough) - 1, min(MAX_PINGS, len(long_enough))).round().astype(int)
    )
    pings = long_enough[np.unique(asked)]
    require_memory(
        analysis_bytes(wide, len(pings)),
        f"{recording.path}: the analysis of {high:.3g} m of range",
        "set spectrogram.range_max",
    )
    power = []
    with progress.task("searching for echoes", len(pings)) as task:
        for number in pings.tolist():
            heard = wide.analyse(cutter.echo(number, wide.samples))
            power.append(np.square(heard).mean(axis=-1))
            task.advance()
    echo = head.point_echo
    ahead = echo.ahead(float(wide.range[1] - wide.range[0]))
    found = echo_extent(np.stack(power), wide.range, echo.looks, 2.0 * head.resolution, ahead)
    limits = {
        "range_min": low if "range_min" in given else round(found[0], 4),
        "range_max": high if "range_max" in given else round(found[1], 4),
    }
    return limits, np.stack(power)


def _widest(window: int, count: int, delay: float, metre: float) -> float:
    """Return the greatest range (m) whose frame lies within ``samples``."""
    return (count - np.ceil(delay) - 1.0 - window / 2.0) * metre


def calibrated(
    recording: Recording, settings: ImportSettings, head: Head, folder: Path
) -> tuple[Cutter, dict[str, Any]]:
    """Return the cutter of pings, with all corrections, and the applied calibration."""
    speed, rate = head.speed_of_sound, recording.sampling_rate
    applied: dict[str, Any] = {
        "scale": settings.scale,
        "time_offset_s": settings.time_offset,
        "range_offset_m": settings.range_offset,
    }
    # An echo from farther away comes later; the emission is moved the other way.
    delay = settings.time_offset - 2.0 * settings.range_offset / speed
    cutter = Cutter(recording, settings.channels, delay, settings.scale)
    if settings.background is not None:
        quiet = _beside(folder / settings.background, recording, settings)
        begin = settings.background_time + delay
        background = cut(quiet, begin * rate, quiet.shape[1] - int(begin * rate))
        cutter = replace(cutter, background=background)
        applied["background"] = settings.background.name
    if settings.reference is not None:
        target = settings.reference
        heard = _beside(folder / target.file, recording, settings)
        begin = (target.time + delay) * rate
        echo = cut(heard, begin, heard.shape[1] - int(begin))
        if cutter.background is not None:
            size = min(echo.shape[1], cutter.background.shape[1])
            echo[:, :size] -= cutter.background[:, :size]
        calibration = calibrate_recording(
            mixed_channels(echo, settings.channels) * settings.scale, target, head
        )
        delay -= 2.0 * calibration.range_offset / speed
        cutter = replace(cutter, delay=delay, gain=settings.scale * calibration.gain)
        if cutter.background is not None:
            begin = settings.background_time + delay
            background = cut(quiet, begin * rate, quiet.shape[1] - int(begin * rate))
            cutter = replace(cutter, background=background)
        applied["reference"] = {
            "file": target.file.name,
            "gain_db": np.round(20.0 * np.log10(calibration.gain), 3).tolist(),
            "range_offset_m": round(calibration.range_offset, 6),
        }
    return cutter, applied


def _beside(path: Path, recording: Recording, settings: ImportSettings) -> NDArray[Any]:
    """Read another recording of the same rate and channels."""
    rate, samples = read_sound(path, settings)
    channels = recording.read(0).shape[0]
    if rate != recording.sampling_rate or len(samples) != channels:
        raise InputError(
            f"{path}: {len(samples)} channels at {rate:g} Hz, the pings have {channels} at "
            f"{recording.sampling_rate:g} Hz; all must have the same"
        )
    return samples
