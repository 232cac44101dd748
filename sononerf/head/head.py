# SPDX-License-Identifier: MIT
"""The head: emitter, receivers, air, call, noise and front end in one object.

In: sections of the settings, or their keys. Out: places (E, 3), gains of beam and ears over
frequency and direction, ranges (R,) and frequencies (F,) of a spectrogram, and the spectrogram of a
waveform.

Simulator, renderers, refinement, detection of echoes and import of recordings all use this object.
Frames and units: ``docs/receivers.md``; how a call is heard: ``docs/simulator.md``.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter1d

from sononerf.display import NotebookRepr
from sononerf.errors import InputError, SettingsError
from sononerf.geometry.meshes import Plane
from sononerf.head.call import call_waveform, covered, emit, load_call, sweep_delay
from sononerf.head.ears import Ears, analysed_ears, ear_tables, receiver_places
from sononerf.head.front_end import dechirped_spectrogram, echo_samples, frequency_axis, range_axis
from sononerf.head.reception import (
    absorption_in,
    draw_noise,
    effective_window,
    loudest_power,
    noise_level,
    precursors,
    speed_in,
    suited,
    target_gain,
    within_band,
)
from sononerf.head.row_filters import RowFilters, band_mean, band_parts, row_filters
from sononerf.numerics import Floats, Singles
from sononerf.settings.loading import checked_section
from sononerf.settings.schema import (
    AirSettings,
    CallSettings,
    EarSettings,
    NoiseSettings,
    SpectrogramSettings,
    check_call,
)
from sononerf.settings.sections import SupportSettings


@dataclass(frozen=True, eq=False)
class PointEcho:
    """Spectrogram of the echo of one point."""

    # (W,): Its power over range, averaged over the part of the band that the call has
    window: Floats
    spacing: float  # m: Between these values
    looks: float  # Number of independent values among the frequencies
    # (F, W) or None: The same of each row, which the window is the sum of; None where all rows are
    # about alike. If low rows swell more slowly, an echo without high frequencies does so too
    rows: Floats | None = None
    # (L,) or None: Power of the precursors divided by that of the echo, at the same spacing, from
    # the nearest one on, as far as the call is long; None for an impulse
    precursors: Floats | None = None

    @classmethod
    def of(
        cls, call: CallSettings, spectrogram: SpectrogramSettings, speed_of_sound: float
    ) -> PointEcho:
        """Return the echo of a call (m/s) in a spectrogram."""
        rows = effective_window(call, spectrogram)
        filters = row_filters(spectrogram)
        swept = covered(call, filters.frequency)
        kept = swept if swept.any() else np.arange(len(rows)) < 1
        part = band_parts(filters.frequency)
        return cls(
            window=band_mean((rows[kept] ** 2).T, filters.frequency[kept]),
            rows=None if part is None else rows**2 * (part * kept)[:, None],
            spacing=speed_of_sound / 2.0 / spectrogram.sampling_rate,
            looks=filters.looks,
            precursors=None if call.kind == "impulse" else precursors(call, spectrogram),
        )

    @property
    def tail(self) -> float:
        """Distance by which it is louder than -20 dB beyond its resolution, m.

        Zero for an impulse. Of harmonics that overlap, the later echoes lie within it.
        """
        loud = np.flatnonzero(self.window >= 0.01 * self.window.max())
        behind = (int(loud[-1]) - (len(self.window) - 1) / 2.0) * self.spacing
        return max(behind - self.resolution, 0.0)

    def ahead(self, step: float) -> Floats:
        """Return the power of the precursors (L,) in slices that are a step (m) apart.

        Each is that of the loudest precursor within a range resolution, because the precursors of
        several points add up.
        """
        if self.precursors is None:
            return np.zeros(0)
        size = 2 * math.ceil(self.resolution / self.spacing)
        whole = np.pad(self.precursors, (0, size))
        before = np.where(np.arange(len(whole)) < size, 0.0, whole)
        loudest = np.maximum(whole, maximum_filter1d(before, size + 1))
        count = int(len(loudest) * self.spacing / step)
        return np.asarray(loudest[(np.arange(1, count + 1) * step / self.spacing).astype(int) - 1])

    def of_spectrum(self, magnitude: NDArray[np.floating]) -> Floats:
        """Return the window (W,) of an echo whose rows have some magnitudes (F,)."""
        assert self.rows is not None
        return np.asarray(np.square(magnitude, dtype=np.float64) @ self.rows)

    @property
    def resolution(self) -> float:
        """Width in range over which its magnitude is above half of its maximum, m.

        Separate echoes, such as another harmonic's, do not count.
        """
        top = own_top(self.window)
        low = np.flatnonzero(self.window < 0.25 * self.window[top])
        first = int(low[low < top].max(initial=-1)) + 1
        last = int(low[low > top].min(initial=len(self.window))) - 1
        return float(last - first + 1) * self.spacing


def own_top(window: Floats) -> int:
    """Return the maximum of a point echo (W,) about its own range, which is in the middle.

    Separate echoes, such as another harmonic's, may be greater.
    """
    top = (len(window) - 1) // 2
    while 0 < top < len(window) - 1:
        beside = top + (1 if window[top + 1] > window[top - 1] else -1)
        if window[beside] <= window[top]:
            break
        top = beside
    return top


SECTIONS = ("ears", "call", "air", "spectrogram", "noise", "support")
"""Sections of the settings that describe a head."""


@dataclass(frozen=True, eq=False, init=False)
class Head(NotebookRepr):
    """Emitter and receivers in air, the call, and the filters that make spectrograms.

    Two synthetic ears, an impulse and the filters of the paper by default. Slow results are
    computed at their first use, and kept.

    Args:
        ears: Places and directivities of emitter and receivers, m and degrees, head frame: keys of
            the section ``ears`` of the settings, such as ``{"receivers": [(0, 0.02, 0)],
            "directivity": "omnidirectional"}``.
        call: The emitted call, s and Hz: section ``call``, such as ``{"kind": "hyperbolic",
            "duration": 1e-3, "frequency_start": 90e3, "frequency_end": 30e3}``, or ``{"kind":
            "file", "file": "call.wav"}``.
        air: Speed of sound and absorption: section ``air``, such as ``{"temperature_c": 20}``.
        spectrogram: Filters, hop, range limits, Hz and m: section ``spectrogram``, such as
            ``{"frequency_min": 20e3, "frequency_max": 90e3, "range_max": 1.0}``. Where they are not
            set, band, window, hop and FFT follow from the call.
        noise: Noise of the receivers: section ``noise``, such as ``{"snr_db": 20}``.
        support: A rigid plane that the body stands on, m, world frame: section ``support``, such as
            ``{"point": (0, 0, -0.05)}``; none by default.

    Raises:
        InputError: If a file of the call or of the directivity cannot be used.
        SettingsError: If a key or a value is not allowed, or keys do not fit together.

    Examples:
        >>> head = Head(air={"temperature_c": 20.0})
        >>> round(head.speed_of_sound, 1), len(head.receivers), len(head.frequency)
        (343.2, 2, 47)
    """

    ears: EarSettings
    call: CallSettings
    air: AirSettings
    spectrogram: SpectrogramSettings
    noise: NoiseSettings
    support: SupportSettings

    def __init__(
        self,
        ears: EarSettings | Mapping[str, Any] | None = None,
        call: CallSettings | Mapping[str, Any] | None = None,
        air: AirSettings | Mapping[str, Any] | None = None,
        spectrogram: SpectrogramSettings | Mapping[str, Any] | None = None,
        noise: NoiseSettings | Mapping[str, Any] | None = None,
        support: SupportSettings | Mapping[str, Any] | None = None,
        **unknown: object,
    ) -> None:
        if unknown:
            name = next(iter(unknown))
            near = difflib.get_close_matches(name, [*SECTIONS, "analysis"], n=1)
            meant = near[0].replace("analysis", "spectrogram") if near else ""
            hint = f"did you mean {meant}?" if near else f"known: {', '.join(SECTIONS)}"
            raise SettingsError(f"Head: unknown section {name!r}; {hint}")
        for name, kind, given in (
            ("ears", EarSettings, ears),
            ("call", CallSettings, call),
            ("air", AirSettings, air),
            ("spectrogram", SpectrogramSettings, spectrogram),
            ("noise", NoiseSettings, noise),
            ("support", SupportSettings, support),
        ):
            object.__setattr__(self, name, checked_section(kind, given or {}, name))
        object.__setattr__(self, "spectrogram", suited(self.call, self.spectrogram))
        if isinstance(self.noise.snr_db, tuple) and len(self.receivers) != 2:
            count = len(self.receivers)
            raise SettingsError(
                f"noise.snr_db: gives 2 levels, but {self.ears.file or 'the head'} holds {count} "
                f"receiver{'s' * (count != 1)}; give one level for all"
            )
        try:
            check_call(self.call, self.spectrogram)
        except ValueError as error:
            raise SettingsError(str(error)) from None
        if self.call.file is not None:
            self._check_band()

    def plain(self) -> dict[str, Any]:
        """Return the sections of the settings that describe this head, as plain data."""
        return {name: getattr(self, name).model_dump(mode="json") for name in SECTIONS}

    @classmethod
    def from_plain(cls, sections: Mapping[str, Any]) -> Head:
        """Return the head that :meth:`plain` described."""
        return cls(**{name: sections[name] for name in SECTIONS if name in sections})

    def __getstate__(self) -> dict[str, object]:
        # Other processes compute these again if needed; the tables are large.
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def without_noise(self) -> Head:
        """Return the same head with receivers that have no noise."""
        return (
            self if self.noise.snr_db is None else dataclasses.replace(self, noise=NoiseSettings())
        )

    def of_impulse(self) -> Head:
        """Return the same head with an impulse, and the analysis that suits it in this band."""
        own = self.spectrogram.model_dump(exclude={"window", "hop", "fft"})
        return dataclasses.replace(
            self, call=CallSettings(), spectrogram=SpectrogramSettings(**own)
        )

    @cached_property
    def plane(self) -> Plane | None:
        """The support; None if there is no support."""
        if self.support.point is None:
            return None
        return Plane.through(np.asarray(self.support.point), np.asarray(self.support.normal))

    @cached_property
    def emitter(self) -> Floats:
        """Place of the emitter (3,), m, head frame."""
        return np.asarray(self.ears.emitter, dtype=np.float64)

    @cached_property
    def receivers(self) -> Floats:
        """Places of the receivers (E, 3), m, head frame."""
        return receiver_places(self.ears)

    def places(self, positions: ArrayLike, rotations: ArrayLike) -> tuple[Floats, Floats]:
        """Return emitters (..., 3) and receivers (..., E, 3), m, world frame.

        Args:
            positions ((..., 3), m): Places of the head, world frame.
            rotations (..., 3, 3): Head to world.
        """
        at, turn = np.asarray(positions, np.float64), np.asarray(rotations, np.float64)
        return at + turn @ self.emitter, at[..., None, :] + self.receivers @ turn.swapaxes(-1, -2)

    @cached_property
    def speed_of_sound(self) -> float:
        """Speed of sound, m/s."""
        return speed_in(self.air)

    def absorption(self, frequency: ArrayLike) -> Floats:
        """Return the absorption of the air (F,), dB/m, at frequencies (F,), Hz."""
        return absorption_in(self.air, frequency)

    @cached_property
    def row_absorption(self) -> Floats:
        """Amplitude loss of the air at the frequencies of the rows (F,), Np/m."""
        return self.absorption(self.frequency) * (math.log(10.0) / 20.0)

    @property
    def sampling_rate(self) -> float:
        """Sampling rate of waveforms, Hz."""
        return self.spectrogram.sampling_rate

    @cached_property
    def frequency(self) -> Floats:
        """Frequencies of the spectrogram's rows (F,), Hz."""
        return frequency_axis(self.spectrogram)

    @cached_property
    def range(self) -> Floats:
        """Ranges of the spectrogram's slices (R,), m."""
        return range_axis(self.spectrogram, self.speed_of_sound)

    @property
    def wavelength(self) -> float:
        """Shortest wavelength of the analysed band, m."""
        return self.speed_of_sound / float(self.frequency[-1])

    @cached_property
    def row_filters(self) -> RowFilters:
        """Filters of the spectrogram's rows."""
        return row_filters(self.spectrogram)

    @cached_property
    def point_echo(self) -> PointEcho:
        """The echo of a single point in the spectrogram."""
        return PointEcho.of(self.call, self.spectrogram, self.speed_of_sound)

    @property
    def resolution(self) -> float:
        """Range resolution, m: -6 dB width of a point echo over range, averaged over the band."""
        return self.point_echo.resolution

    @cached_property
    def window(self) -> Floats:
        """Magnitude of a point echo in each row (F, W), one value per sample, 1 in the middle."""
        return effective_window(self.call, self.spectrogram)

    def tables(self, frequency: ArrayLike) -> Ears:
        """Return the gains of emitter and receivers at frequencies (F,), Hz."""
        return ear_tables(self.ears, frequency)

    @cached_property
    def gains(self) -> Ears:
        """The gains at the frequencies of the rows, as they are."""
        return self.tables(self.frequency)

    @cached_property
    def _smeared(self) -> tuple[Ears, Singles | None]:
        return analysed_ears(self.ears, self.call, self.spectrogram)

    @property
    def row_gains(self) -> Ears:
        """The gains that the rows measure: smeared over the bandwidth of each row's filter."""
        return self._smeared[0]

    @property
    def lag(self) -> Singles | None:
        """Additional range (E, F, L, A), m, that rows hear, beam included; None for an impulse."""
        lag = self._smeared[1]
        return None if lag is None else lag * np.float32(self.speed_of_sound / 2.0)

    @cached_property
    def mean_lag(self) -> float:
        """Mean of the lag over rows and directions as a range, m, weighted by power.

        Rows that are nearly silent in a direction may lag by many times as much, but they have no
        part in the onset.
        """
        if self.lag is None:
            return 0.0
        known = self.row_gains
        power = np.square((known.beam * known.ears).astype(np.float64))
        power *= np.cos(known.elevation)[:, None]
        return float((power * self.lag).sum() / power.sum())

    @cached_property
    def waveform(self) -> Floats:
        """The call (N,), pressure at 1 m."""
        return call_waveform(self.call, self.sampling_rate)

    @cached_property
    def delay(self) -> Floats:
        """Time (F,), s, at which the call emits the frequency of each row."""
        return sweep_delay(self.call, self.frequency)

    @cached_property
    def samples(self) -> int:
        """Number of samples from the emission to the end of the last frame."""
        return echo_samples(self.spectrogram, self.speed_of_sound, float(self.delay.max()))

    def receive(self, impulse_responses: ArrayLike, *, seed: int) -> tuple[Floats, Floats]:
        """Return the pressure at the receivers, noise included, and its spectrogram.

        Args:
            impulse_responses (E, S): Pressure for a call that is one sample of height 1. They
                should have ``samples`` samples; of shorter ones, down to the last frame of an
                impulse, the last rows lack later sound in their window.
            seed: Seed of the pose; the noise is drawn from it.

        Returns:
            waveform (E, S): From the start of the emission on.
            magnitude (E, R, F): Linear.
        """
        waveform = emit(impulse_responses, self.waveform)[:, : self.samples]
        if self.noise.snr_db is not None:
            if self.noise.relative_to == "pose":
                power = loudest_power(waveform, self.spectrogram, self._stretch)
            else:
                power = np.repeat(self._target_power, len(waveform))
            level = noise_level(self.noise, power, self.spectrogram)
            waveform = waveform + draw_noise(level, waveform.shape[-1], seed=seed)
        return waveform, self.analyse(waveform)

    def analyse(self, waveform: Floats) -> Floats:
        """Return the spectrogram (E, R, F) of a waveform (E, S) that starts at the emission."""
        return dechirped_spectrogram(waveform, self.spectrogram, self.speed_of_sound, self.delay)

    @cached_property
    def _stretch(self) -> int:
        """Length of the stretch over which the power of an echo is averaged, samples."""
        return max(self.row_filters.length, len(self.waveform))

    @cached_property
    def _target_power(self) -> Floats:
        """Power (1,) of the target that the noise is relative to."""
        target = target_gain(self.noise.target_strength_db, self.noise.target_distance)
        return loudest_power(target * self.waveform[None], self.spectrogram, self._stretch)

    def _check_band(self) -> None:
        spectrogram = self.spectrogram
        if covered(self.call, within_band(spectrogram)).any():
            return
        assert self.call.file is not None
        bands = load_call(self.call.file).bands
        held = ", ".join(f"{low / 1e3:.1f} to {high / 1e3:.1f}" for low, high in bands)
        raise InputError(
            f"{self.call.file}: holds sound at {held} kHz, nothing within spectrogram.frequency_min"
            f" to frequency_max ({spectrogram.frequency_min / 1e3:g} to "
            f"{spectrogram.frequency_max / 1e3:g} kHz); change these, or take another call"
        )
