# SPDX-License-Identifier: MIT
"""From impulse responses to what the ears hear of a call, and to its dechirped spectrogram."""

from __future__ import annotations

import logging
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sononerf.acoustics.call import call_waveform, covered, emit, sweep_delay, sweep_rate
from sononerf.acoustics.noise import draw_noise, loudest_power, noise_level, target_gain
from sononerf.acoustics.spectrogram import echo_samples, frequency_axis, spectrogram
from sononerf.config import CallSettings, NoiseSettings, SpectrogramSettings

logger = logging.getLogger("sononerf")

WINDOW_DURATION = 0.528  # of a Hamming window's length, where it is above half its height
WINDOW_BANDWIDTH = 1.81  # over its length: where its transform is above half its height
FAR = 2.0  # factor between a window and the best one that is worth a warning


class Reception:
    """Call, noise and analysis, ready to be applied to the impulse responses of pose after pose.

    Parameters
    ----------
    call : CallSettings
        What is emitted.
    analysis : SpectrogramSettings
        How echoes become spectrograms.
    noise : NoiseSettings
        Of the ears.
    speed_of_sound : float, m/s
        Of the medium.

    Attributes
    ----------
    waveform : (N,) float64
        The call.
    delay : (F,) float64, s
        When each of the analysis' frequencies is emitted.
    samples : int
        Length S of the received waveforms: to the end of what the last frame's rows read.
    """

    def __init__(
        self,
        call: CallSettings,
        analysis: SpectrogramSettings,
        noise: NoiseSettings,
        *,
        speed_of_sound: float,
    ) -> None:
        self.analysis, self.noise, self.speed_of_sound = analysis, noise, speed_of_sound
        self.waveform = call_waveform(call, analysis.sampling_rate)
        self.delay = sweep_delay(call, frequency_axis(analysis))
        self.samples = echo_samples(analysis, speed_of_sound, float(self.delay.max()))
        self._stretch = max(analysis.window, len(self.waveform))
        target = target_gain(noise.target_strength_db, noise.target_distance)
        self._target_power = loudest_power(target * self.waveform[None], analysis, self._stretch)

    def receive(
        self, impulse_responses: ArrayLike, *, seed: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pressure at the ears, noise included, and its spectrogram.

        Parameters
        ----------
        impulse_responses : (E, S) float
            Pressure for a call that is one sample of height 1. They should have ``samples``
            samples; of shorter ones, down to the last frame of an impulse, the last rows lack
            what the window lets in from behind.
        seed : int
            Of the pose; the noise is drawn from it.

        Returns
        -------
        waveform : (E, S) float64
            From the start of the emission on.
        magnitude : (E, R, F) float64
            Linear.

        Raises
        ------
        ValueError
            If the impulse responses are too short.
        """
        waveform = emit(impulse_responses, self.waveform)[:, : self.samples]
        if self.noise.snr_db is not None:
            own = self.noise.relative_to == "pose"
            power = (
                loudest_power(waveform, self.analysis, self._stretch)
                if own
                else np.repeat(self._target_power, len(waveform))
            )
            level = noise_level(self.noise, power, self.analysis)
            waveform = waveform + draw_noise(level, waveform.shape[-1], seed=seed)
        return waveform, self.analyse(waveform)

    def analyse(self, waveform: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the spectrogram (E, R, F) of what was heard, (E, S) from the emission on.

        Raises
        ------
        ValueError
            If the waveform is shorter than ``samples``.
        """
        return spectrogram(waveform, self.analysis, self.speed_of_sound, self.delay)


def row_duration(
    call: CallSettings, analysis: SpectrogramSettings, frequency: ArrayLike
) -> NDArray[np.float64]:
    r"""How long a point echo lasts in a row of the dechirped spectrogram.

    .. math:: \sqrt{T_w^2 + (B_w / |\dot f|)^2}

    with :math:`T_w` the window's own duration, :math:`B_w` its bandwidth and :math:`|\dot f|` the
    sweep rate; each width is counted where the magnitude is above half its greatest (-6 dB). A
    row is the window's transform, turned by the sweep's quadratic phase and transformed back; for
    a Gaussian window and a linear sweep that gives exactly this.

    Parameters
    ----------
    call : CallSettings
        What is emitted.
    analysis : SpectrogramSettings
        Window and sampling rate.
    frequency : (F,) float, Hz
        Of the rows.

    Returns
    -------
    duration : (F,) float64, s
        Two-way: times ``c / 2`` it is a width in range.
    """
    length = analysis.window / analysis.sampling_rate
    swept = WINDOW_BANDWIDTH / length / sweep_rate(call, frequency)
    duration: NDArray[np.float64] = np.hypot(WINDOW_DURATION * length, swept)
    return duration


def best_window(call: CallSettings, analysis: SpectrogramSettings) -> int:
    """Length of the window that keeps a point echo shortest in the dechirped spectrogram.

    A short window is wide in frequency, so a slow sweep stays in it for long; a long one lasts
    long itself. What is made smallest is the root mean square of :func:`row_duration` over the
    analysed frequencies that the call covers.

    Parameters
    ----------
    call : CallSettings
        What is emitted.
    analysis : SpectrogramSettings
        Sampling rate and frequencies.

    Returns
    -------
    window : int
        Samples. For an impulse shorter is always better, so it is the window that is set.

    Examples
    --------
    >>> call = CallSettings(kind="linear", duration=3e-3)
    >>> best_window(call, SpectrogramSettings(frequency_min=40e3))
    306
    """
    if call.kind == "impulse":
        return analysis.window
    slowness = math.sqrt(np.mean(sweep_rate(call, _heard(call, analysis)) ** -2.0))
    return round(analysis.sampling_rate * math.sqrt(WINDOW_BANDWIDTH / WINDOW_DURATION * slowness))


def _within(analysis: SpectrogramSettings) -> NDArray[np.float64]:
    """Return the rows' frequencies, the outermost drawn to the ends of the band asked for."""
    return np.clip(frequency_axis(analysis), analysis.frequency_min, analysis.frequency_max)


def _heard(call: CallSettings, analysis: SpectrogramSettings) -> NDArray[np.float64]:
    """Return those of the rows' frequencies that the call covers; all, where it covers none."""
    frequency = _within(analysis)
    heard = covered(call, frequency)
    return frequency[heard] if heard.any() else frequency


def effective_window(call: CallSettings, analysis: SpectrogramSettings) -> NDArray[np.float64]:
    """Point echo in each row of the dechirped spectrogram, as a window over the received time.

    Parameters
    ----------
    call : CallSettings
        What is emitted.
    analysis : SpectrogramSettings
        Window, transform and frequencies.

    Returns
    -------
    window : (F, W) float64
        One value per sample, symmetric about its middle (the mean power of both sides), where it
        is 1. For an impulse the analysis window, of a height of almost 1; for a sweep as much
        longer as the sweep stays in the window's main lobe.
    """
    frequency, length = frequency_axis(analysis), analysis.window
    if call.kind == "impulse":
        return np.tile(np.hamming(length), (len(frequency), 1))
    slowest = float(sweep_rate(call, _heard(call, analysis)).min())
    lobe = 2.0 * analysis.sampling_rate / length  # Hz, from the middle to the first zero
    extra = math.ceil(lobe / slowest * analysis.sampling_rate)
    count = length + 2 * extra
    # At a speed of 2 m/s ranges are seconds. Frame k is centred on sample k + (length - 1) / 2.
    last = ((length - 1) / 2.0 + count - 0.5) / analysis.sampling_rate
    frames = {"hop": 1, "range_min": 1e-12, "range_max": last}
    fine = analysis.model_copy(update=frames)
    waveform = call_waveform(call, analysis.sampling_rate)
    delay = sweep_delay(call, frequency)
    start = length - 1 + extra
    samples = max(echo_samples(fine, 2.0, float(delay.max())), start + len(waveform))
    echo = np.zeros((1, samples))
    echo[0, start : start + len(waveform)] = waveform
    row = spectrogram(echo, fine, 2.0, delay)[0].T
    power = row**2 + row[:, ::-1] ** 2
    middle = power[:, (count - 1) // 2]
    window: NDArray[np.float64] = np.sqrt(power / middle[:, None])
    return window


def warn_of_call(call: CallSettings, analysis: SpectrogramSettings) -> None:
    """Log one line for each way in which call and analysis do not suit one another.

    Parameters
    ----------
    call : CallSettings
        What is emitted.
    analysis : SpectrogramSettings
        Window and band.
    """
    frequency = _within(analysis)
    silent = ~covered(call, frequency)
    if silent.any():
        edges = np.flatnonzero(np.diff(silent, prepend=False, append=False)).reshape(-1, 2)
        bands = ", ".join(
            f"{frequency[a] / 1e3:.1f} to {frequency[b - 1] / 1e3:.1f} kHz" for a, b in edges
        )
        logger.warning(
            "the call does not cover %s; these rows hold next to nothing. Narrow "
            "spectrogram.frequency_min and frequency_max, or widen the call",
            bands,
        )
    best = best_window(call, analysis)
    if not 1.0 / FAR <= best / analysis.window <= FAR:
        here, there = (
            1e6 * math.sqrt(np.mean(row_duration(call, chosen, _heard(call, analysis)) ** 2))
            for chosen in (analysis, analysis.model_copy(update={"window": best}))
        )
        longer_fft = f" and spectrogram.fft={2 ** math.ceil(math.log2(best))}"
        logger.warning(
            "a point echo lasts %.0f µs in a window of %d samples and %.0f µs in the one that "
            "suits this call best; set spectrogram.window=%d%s",
            here,
            analysis.window,
            there,
            best,
            longer_fft if best > analysis.fft else "",
        )
