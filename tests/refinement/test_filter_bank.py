# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.fft import next_fast_len
from torch.autograd import forward_ad

from sononerf.head.call import emit
from sononerf.head.front_end import dechirped_spectrogram, range_axis
from sononerf.head.head import Head
from sononerf.refinement.optics import Arrivals, FilterBank, fast_length
from sononerf.settings.schema import CallSettings, SpectrogramSettings

NODES = (np.arange(19) + 0.5) * 8e3
SOFT = 25e3


def bank_of(kind, harmonics=(1.0,), analysis_kind="stft", **changes):
    given = {"frequency_min": 10e3, "frequency_max": 100e3, "window": 64, "hop": 4, **changes}
    spectrogram = SpectrogramSettings(range_min=0.2, range_max=0.5, kind=analysis_kind, **given)
    call = CallSettings(kind=kind, harmonics=harmonics, frequency_end=40e3 / len(harmonics))
    reception = Head(call=call, spectrogram=spectrogram)
    return FilterBank(reception, NODES, SOFT), reception


def power(bank, strength, at, frames, receiver=0, receivers=1):
    count = len(at)
    weight = torch.ones(count, len(bank.kept_nodes))
    of = torch.full((count,), receiver, dtype=torch.int64)
    arrivals = Arrivals(strength, at, weight, of)
    return bank.power({"surface": arrivals}, receivers=receivers, frames=frames)


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        ("impulse", {}),
        ("linear", {}),
        ("hyperbolic", {}),
        ("linear", {"harmonics": (1.0, 0.5)}),
        ("impulse", {"analysis_kind": "gammatone"}),
        ("linear", {"analysis_kind": "gammatone", "frequency_min": 42e3}),
    ],
)
def test_rows_are_those_of_the_analysis_for_any_call(kind, changes):
    bank, reception = bank_of(kind, **changes)
    spectrogram = reception.spectrogram
    place, first = 1703.3, 1280
    top = 150e3 if spectrogram.kind == "stft" else 200e3  # a gammatone's skirts reach farther
    length = next_fast_len(reception.samples)
    frequency = np.fft.rfftfreq(length, 1 / spectrogram.sampling_rate)
    level = 1j * frequency + np.hypot(frequency, SOFT)
    level *= np.exp(-2j * np.pi * frequency * place / spectrogram.sampling_rate) * (frequency < top)
    echo = emit(np.fft.irfft(level, n=length)[None], reception.waveform)[:, : reception.samples]
    wanted = dechirped_spectrogram(echo, spectrogram, 343.0, reception.delay)[0]
    found = power(bank, torch.ones(1), torch.tensor([place - first]), 512)[0].sqrt().numpy()
    start = range_axis(spectrogram, 343.0)[0] * 2.0 * spectrogram.sampling_rate / 343.0
    row = round((first - start + bank.filters.centre) / spectrogram.hop)
    part = wanted[row + 20 : row + 200]
    loud = part > 0.1 * part.max()
    error = 20 * np.log10(found[20:200][loud] / part[loud])
    # Beyond the window's main lobe nothing is kept: skirts err by a few tenths.
    assert np.abs(error).mean() < 0.1
    assert np.abs(error).max() < 0.7


def test_what_comes_a_frame_later_is_heard_a_frame_later():
    bank, reception = bank_of("impulse")
    times = torch.tensor([300.0, 300.0 + reception.spectrogram.hop])
    early, late = (power(bank, torch.ones(1), at[None], 256)[0] for at in times)
    assert torch.allclose(early[:-1], late[1:], rtol=1e-3, atol=1e-4 * float(early.max()))


def test_receivers_are_kept_apart():
    bank, _ = bank_of("impulse")
    both = power(bank, torch.ones(1), torch.tensor([300.0]), 256, receiver=1, receivers=2)
    assert float(both[0].max()) == 0.0
    assert float(both[1].max()) > 0.0


def test_gradients_are_those_of_finite_differences():
    bank, _ = bank_of("impulse")
    at = torch.tensor([300.2, 306.7, 311.4], requires_grad=True)
    strength = torch.tensor([1.0, 0.7, -0.4], requires_grad=True)

    def value(strength, at):
        # Silent cells are rounding.
        whole = power(bank, strength, at, 128)
        return torch.log(whole + 0.01 * whole.detach().max()).double().mean()

    value(strength, at).backward()
    for tensor, step in ((strength, 0.02), (at, 0.02)):
        for number in range(3):
            moved = []
            for sign in (1, -1):
                parts = [strength.detach().clone(), at.detach().clone()]
                parts[0 if tensor is strength else 1][number] += sign * step
                whole = power(bank, *parts, 128)
                fixed = power(bank, strength.detach(), at.detach(), 128).max()
                moved.append(float(torch.log(whole + 0.01 * fixed).double().mean()))
            wanted = (moved[0] - moved[1]) / (2 * step)
            assert float(tensor.grad[number]) == pytest.approx(wanted, rel=0.05, abs=2e-3)


def test_derivatives_forward_are_those_backward():
    bank, _ = bank_of("linear")
    count, nodes, generator = 3, len(bank.kept_nodes), torch.Generator().manual_seed(0)
    values = [
        torch.tensor([1.0, 0.7, -0.4]),
        torch.tensor([300.2, 306.7, 311.4]),
        torch.rand(count, nodes, generator=generator) + 0.5,
    ]
    of = torch.zeros(count, dtype=torch.int64)

    def total(strength, at, weight):
        arrivals = Arrivals(strength, at, weight, of)
        return bank.power({"surface": arrivals}, receivers=1, frames=256).sqrt().sum()

    for index in range(3):
        leaves = [value.clone().requires_grad_() for value in values]
        total(*leaves).backward()
        direction = torch.randn(values[index].shape, generator=generator)
        with torch.no_grad(), forward_ad.dual_level():
            duals = list(values)
            duals[index] = forward_ad.make_dual(values[index], direction)
            change = forward_ad.unpack_dual(total(*duals)).tangent
        assert float(change) == pytest.approx(
            float((leaves[index].grad * direction).sum()), rel=1e-3
        )


def test_the_gradients_of_weights_do_not_change_those_of_strengths():
    bank, _ = bank_of("impulse")
    at, of = torch.tensor([300.2, 306.7]), torch.zeros(2, dtype=torch.int64)
    found = []
    for both in (False, True):
        strength = torch.tensor([1.0, 0.7], requires_grad=True)
        weight = torch.ones(2, len(bank.kept_nodes), requires_grad=both)
        arrivals = Arrivals(strength, at, weight, of)
        bank.power({"edge": arrivals}, receivers=1, frames=128).sum().backward()
        found.append(strength.grad)
    torch.testing.assert_close(found[0], found[1])
    # A strength multiplies all of its weights.
    torch.testing.assert_close((weight.grad * weight).sum(1), strength.grad * strength)


def test_lengths_are_few_and_no_shorter_than_asked():
    lengths = {fast_length(count) for count in range(8, 1025)}
    assert all(fast_length(count) >= count for count in range(8, 1025))
    assert len(lengths) < 32
