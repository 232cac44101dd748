# SPDX-License-Identifier: MIT
"""Synthesis of the pressure at an ear from single echoes with a strength per frequency.

Each echo is laid into fine time bins, one column of bins per frequency node; a column is then
filtered, once, with the part of the spectrum that its node stands for. Synthesis is linear in the
strengths, so this equals a filter per echo.

An echo that stands for a patch of surface does not come all at once. It is laid into bins as wide
as its arrival times are spread, as a texture seen from afar is read from a coarser image [1]_: so
patches that are too large for the shortest wavelengths fall silent there instead of adding noise.

Most of a record is silent. Only the stretch of bins that holds echoes is filtered: as if the record
were a half or a quarter as long, with every second or fourth frequency of the filters. This is the
same where the filters have faded out before the shorter record begins anew.

References:
    .. [1] L. Williams, "Pyramidal parametrics", SIGGRAPH 1983.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sononerf.head.ears import NOTCH_WIDTH
from sononerf.numerics import Complexes, Floats, Ints, compiled
from sononerf.settings.schema import SpectrogramSettings

HIGHEST = 150e3
"""Frequency up to which echoes are complete, Hz. Half more than the default band needs."""
NODE_SPACING = NOTCH_WIDTH
"""Distance between frequency nodes, Hz. The responses of ears are then kept for 62 us about an
echo, three standard deviations of the response of their notch."""
ROLL_OFF = 0.3
"""Width of the fall at that limit, as a fraction of it. A smaller one rings longer; a larger one
cuts more."""
IMAGES = 2
"""Periods of the nodes on each side that count; the kernel falls as the third power."""
OVERSAMPLING = 4
LEVELS = 10  # of bins, each twice as wide as the one before; the last smooths away even 10 kHz
FILTER_GUARD = (
    512  # samples behind the last frame, for the filters' response before and after an echo
)
RING = 384  # samples; farther from an echo the filters' response is some 100 dB down
MIN_RECORD_PARTS = 4  # the part of a record that is filtered is no less than one over this
# Laying an echo between two bins of width 1 and reading them as triangles spreads it by 1/6 twice.
LEVEL_VARIANCE = 1.0 / 3.0


@dataclass(frozen=True, eq=False)
class Synthesis:
    """Time bins, frequency nodes and the filters that join them."""

    nodes: Floats  # (F,), Hz: Frequencies of the strengths
    hats: Complexes  # (K, F) complex128: Spectrum that each node stands for
    basis: Complexes  # (K, F) complex128: The same times ``j f`` in Hz, for reflections
    # (K, F) complex128: As ``hats``, for strengths that are odd functions of frequency, as
    # imaginary parts are
    odd_hats: Complexes
    sampling_rate: float  # (Hz): Sampling rate of the echo
    samples: int  # Length of the echo, S
    length: int  # Length of the transform, at the sampling rate

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of time bins of each level; together B."""
        return tuple(OVERSAMPLING * self.length >> level for level in range(LEVELS))

    @property
    def frequency(self) -> Floats:
        """Frequencies of the filters (K,), Hz."""
        return np.fft.rfftfreq(self.length, 1.0 / self.sampling_rate).astype(np.float64)

    def silence(self, dtype: Any = np.float32) -> Bins:
        """Return empty bins; single precision adds errors that are 120 dB down."""
        return Bins(np.zeros((sum(self.sizes), len(self.nodes)), dtype=dtype))


@dataclass(eq=False)
class Bins:
    """Time bins that echoes are laid into."""

    values: NDArray[Any]  # (B, F): All levels, one after the other
    # samples: All echoes lie between these two; the last is below the first where there is none
    first: float = math.inf
    last: float = -math.inf


def plan_synthesis(settings: SpectrogramSettings, samples: int) -> Synthesis:
    """Lay out nodes and filters for an analysis.

    Between nodes strengths are interpolated by raised cosines (:func:`between`). They are even
    about zero frequency, as gains are, and constant above the highest node; there the echo falls
    smoothly to zero within a third of that frequency. The factor ``j f`` that every
    reflection has is part of the filters: a flat reflection is then a short derivative pulse and
    no long tail.
    """
    rate = settings.sampling_rate
    top = min(max(HIGHEST, 1.2 * settings.frequency_max), 0.45 * rate)
    count = max(2, round(top / NODE_SPACING))
    nodes: Floats = (np.arange(count, dtype=np.float64) + 0.5) * (top / count)
    # The coarsest level must hold a whole number of bins.
    unit = 2 ** (LEVELS - 1)
    length = unit * int(
        scipy.fft.next_fast_len(math.ceil((samples + FILTER_GUARD) / unit), real=True)
    )
    frequency = np.fft.rfftfreq(length, 1.0 / rate)
    even, odd = between(np.minimum(frequency, top), nodes)
    end = min(top * 4.0 / 3.0, rate / 2.0)
    fall = np.clip((frequency - top) / (end - top), 0.0, 1.0)
    # Laying an echo between two of the finest bins damps it by this much, on average over where
    # it falls.
    damping = np.sinc(frequency / (OVERSAMPLING * rate)) ** 2
    shape = 0.5 * (1.0 + np.cos(np.pi * fall)) / damping
    hats, odd_hats = ((part * shape[:, None]).astype(np.complex128) for part in (even, odd))
    basis = hats * (1j * frequency)[:, None]
    return Synthesis(nodes, hats, basis, odd_hats, rate, samples, length)


def between(frequency: Floats, nodes: Floats) -> tuple[Floats, Floats]:
    r"""Return the weight (K, F) of each node in a value at each frequency.

    The interpolation is Nyquist's raised cosine, with :math:`x` the distance in node spacings and
    :math:`\rho` the roll-off,

    .. math:: \operatorname{sinc}(x) \frac{\cos \pi \rho x}{1 - (2 \rho x)^2}

    In time it is a window that keeps sound within :math:`1 / (2 \Delta f)` of an echo and removes
    the rest. Straight lines between the nodes would repeat each echo there every
    :math:`1 / \Delta f`, before it too. The nodes lie at odd multiples of half the spacing, so the
    values are continued as an even function about the upper end, and as an even or an odd one about
    zero. An odd one continued as an even one would jump at zero, and ring on as one over time.

    In: frequency ((K,), Hz), nodes ((F,), Hz). Out: even (K, F), odd (K, F).
    """
    spacing = 2.0 * nodes[0]
    period = 2.0 * len(nodes) * spacing
    even, odd = np.zeros((2, len(frequency), len(nodes)))
    for image in range(-IMAGES, IMAGES + 1):
        for side in (1.0, -1.0):
            x = (frequency[:, None] - image * period - side * nodes) / spacing
            below = 1.0 - np.square(2.0 * ROLL_OFF * x)
            pole = np.abs(below) < 1e-9
            roll = np.cos(np.pi * ROLL_OFF * x) / np.where(pole, 1.0, below)
            weight = np.sinc(x) * np.where(pole, np.pi / 4.0, roll)
            even += weight
            odd += side * (-1.0) ** image * weight
    return even, odd


def deposit(
    synthesis: Synthesis,
    bins: Bins,
    delay: Floats,
    spread: Floats,
    strength: NDArray[np.floating[Any]],
) -> None:
    """Lay echoes into time bins, each into the two nearest bins of its two neighbouring levels.

    In: delay ((N,), s), spread ((N,), s), strength (N, F).
    """
    kind = bins.values.dtype
    earliest, latest = _lay(
        bins.values,
        np.cumsum([0, *synthesis.sizes]),
        np.array(delay, dtype=np.float64),
        np.array(spread, dtype=np.float64),
        np.array(strength, dtype=kind, order="C"),
        synthesis.sampling_rate * OVERSAMPLING,
        float(OVERSAMPLING * (synthesis.samples + FILTER_GUARD // 2)),
    )
    bins.first = min(bins.first, earliest / OVERSAMPLING)
    bins.last = max(bins.last, latest / OVERSAMPLING)


@compiled
def _lay(
    values: NDArray[Any],
    start: Ints,
    delay: Floats,
    spread: Floats,
    strength: NDArray[Any],
    rate: float,
    last: float,
) -> tuple[float, float]:
    """Add echoes to bins in place; return the first and the last place, in bins.

    In: values (B, F), start (L + 1,), rate (Hz), last (bins).
    """
    earliest, latest = math.inf, -math.inf
    for i in range(len(delay)):
        place = delay[i] * rate
        if not place < last:
            continue
        earliest, latest = min(earliest, place), max(latest, place)
        # In units of the finest bin; level l spreads by LEVEL_VARIANCE * 4**l, level 0 not at all.
        variance = (spread[i] * rate) ** 2 / LEVEL_VARIANCE
        level = min(max((math.frexp(variance)[1] - 1) // 2, 0), LEVELS - 2)
        floor = 4.0**level
        below = floor if level > 0 else 0.0
        share = min(max((variance - below) / (4.0 * floor - below), 0.0), 1.0)
        for step in range(2):
            part = share if step else 1.0 - share
            at = math.ldexp(place, -(level + step))
            row = start[level + step] + int(at)
            late = (at - int(at)) * part
            soon = values.dtype.type(part - late)
            then = values.dtype.type(late)
            for k in range(values.shape[1]):
                values[row, k] += soon * strength[i, k]
                values[row + 1, k] += then * strength[i, k]
    return earliest, latest


def air_loss(synthesis: Synthesis, decay: Floats) -> Floats:
    """Return the attenuation by air in each bin (B, F), from its decay (F,) in 1/s."""
    rate = OVERSAMPLING * synthesis.sampling_rate
    times = [np.arange(size) * (2.0**level / rate) for level, size in enumerate(synthesis.sizes)]
    return np.exp(-np.multiply.outer(np.concatenate(times), decay))


def synthesise(
    synthesis: Synthesis, bins: Bins, air: NDArray[np.floating[Any]], basis: Complexes
) -> Floats:
    """Weaken each node's bins by the air, filter them with its part of the spectrum, add up.

    In: air (B, F), basis ((K, F) complex128). Out: echo (S,).
    """
    echo = np.zeros(synthesis.samples)
    if bins.last < bins.first:
        return echo
    begin, part = _stretch(synthesis, bins)
    length = synthesis.length // part
    spectrum = np.zeros(length // 2 + 1, dtype=np.complex128)
    first = 0
    for level, whole_size in enumerate(synthesis.sizes):
        size = whole_size // part
        start = first + (OVERSAMPLING * begin >> level)
        first += whole_size
        laid = bins.values[start : start + size]
        if not laid.any():
            continue
        half = scipy.fft.rfft(laid * air[start : start + size], axis=0, overwrite_x=True)
        _filter(spectrum, half, basis, size, part, 2.0**level)
    sound = scipy.fft.irfft(spectrum, n=length)
    end = min(begin + length, synthesis.samples)
    echo[begin:end] = sound[: end - begin]
    return echo


@compiled
def _filter(
    spectrum: Complexes, half: NDArray[Any], basis: Complexes, size: int, part: int, width: float
) -> None:
    """Add one level of bins, filtered, to a spectrum (K / part,), in place.

    In: spectrum (K / part,), half (size // 2 + 1, F), basis (K, F).
    """
    finest = OVERSAMPLING * 2.0 * (len(spectrum) - 1)  # bins at the level of the finest
    for k in range(len(spectrum)):
        # Beyond half their own rate the bins' spectrum repeats; the triangle fades that out.
        index = k % size
        mirrored = index > size // 2
        if mirrored:
            index = size - index
        real, imag = 0.0, 0.0
        for f in range(half.shape[1]):
            one, other = half[index, f], basis[k * part, f]
            along = -one.imag if mirrored else one.imag
            real += one.real * other.real - along * other.imag
            imag += one.real * other.imag + along * other.real
        if width > 1.0 and k > 0:
            # The loss that the filters compensate occurs in the finest bins alone.
            wide, fine = math.pi * k / finest * width, math.pi * k / finest
            fade = (math.sin(wide) / wide * math.sin(fine) / fine) ** 2
            real, imag = fade * real, fade * imag
        spectrum[k] += complex(real, imag)


def _stretch(synthesis: Synthesis, bins: Bins) -> tuple[int, int]:
    """Return the first sample of the record that is filtered, and one over its length.

    It begins at a bin of the coarsest level, and holds the filters' response around echoes.
    """
    unit = 2 ** (LEVELS - 1) // OVERSAMPLING
    earliest = unit * math.floor((bins.first - RING) / unit)
    part = MIN_RECORD_PARTS
    while part > 1:
        length = synthesis.length // part
        begin = min(earliest, synthesis.length - length)
        # Behind the last echo there may be one more bin of the coarsest level.
        fits = begin >= 0 and bins.last + unit + RING <= begin + length
        if fits and length % unit == 0:
            return begin, part
        part //= 2
    return 0, 1
