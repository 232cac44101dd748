# SPDX-License-Identifier: MIT
"""White Gaussian noise of the ears, set by a signal-to-noise ratio.

The ratio is one of powers within the analysis band, in the waveform as the ear receives it,
before dechirp and analysis: the mean power of an echo over its loudest stretch, as long as the
call lasts but at least one analysis window, to the noise's power. Whose echo, is a choice:

``target``
    That of a target of ``target_strength_db`` at ``target_distance``, on the beam's axis, to an
    ear of gain 1, in air that absorbs nothing. Microphones have one noise level whatever they
    hear, so this is the default: a pose that hears little is drowned.
``pose``
    Each ear's own, so that all poses are drowned alike. A silent ear has no noise.

Either way a pose's noise depends on settings, seed and the pose alone.
"""

from __future__ import annotations

import numpy as np
import scipy.fft

from sononerf.array_types import Floats
from sononerf.settings.schema import NoiseSettings, SpectrogramSettings

NOISE_STREAM = 1  # keeps a pose's noise independent of other draws from its seed


def target_gain(target_strength_db: float, distance: float) -> float:
    """Echo of a small target, as a part of the call's pressure at 1 m.

    In: target_strength_db (dB), distance (m).

    References:
        .. [1] R. J. Urick, Principles of Underwater Sound, 3rd edition, 1983, table 9.1.

    Examples:
        >>> round(target_gain(-46.02, 0.4), 4)
        0.0313
    """
    return float(10.0 ** (target_strength_db / 20.0)) / distance**2


def loudest_power(echo: Floats, analysis: SpectrogramSettings, samples: int) -> Floats:
    """Mean power within the analysis band over an echo's loudest stretch.

    In: echo (E, S). Out: power (E,).
    """
    padded = np.pad(echo, ((0, 0), (samples, samples)))
    length = int(scipy.fft.next_fast_len(padded.shape[-1], real=True))
    frequency = np.fft.rfftfreq(length, 1.0 / analysis.sampling_rate)
    band = (frequency >= analysis.frequency_min) & (frequency <= analysis.frequency_max)
    heard = np.fft.irfft(np.fft.rfft(padded, length) * band, length)
    total = np.cumsum(heard**2, axis=-1)
    power: Floats = (total[:, samples:] - total[:, :-samples]).max(axis=-1) / samples
    return power


def noise_level(settings: NoiseSettings, power: Floats, analysis: SpectrogramSettings) -> Floats:
    """Set each ear's noise: the standard deviation of its samples.

    In: power (E,). Out: level (E,).
    """
    share = 2.0 * (analysis.frequency_max - analysis.frequency_min) / analysis.sampling_rate
    ratio = 10.0 ** (np.asarray(settings.snr_db, dtype=np.float64) / 10.0)
    level: Floats = np.sqrt(power / (ratio * share))
    return level


def draw_noise(level: Floats, samples: int, *, seed: int) -> Floats:
    """White Gaussian noise, independent for each ear.

    In: level (E,). Out: noise (E, samples).
    """
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(NOISE_STREAM,)))
    return level[:, None] * generator.standard_normal((len(level), samples))
