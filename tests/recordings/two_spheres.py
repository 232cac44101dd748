# SPDX-License-Identifier: MIT
"""Exact echoes of two rigid spheres, by partial waves and their translation; NumPy and SciPy only.

Nothing of sononerf takes part. Both spheres lie on an axis, so that orders m of azimuth about it do
not mix. With outgoing waves h_n(kr) Y_nm about each centre, the boundary condition on one sphere is

    c_n k h_n'(ka) + sum_n' D_nn' c'_n' = -a_n k j_n'(ka)

where a_n are the coefficients of the source about this centre, c' those of the other sphere's
scattered wave, and D projects its radial derivative on this sphere's surface (Gauss quadrature).
"""

from __future__ import annotations

import numpy as np
from scipy.io import wavfile
from scipy.spatial.transform import Rotation
from scipy.special import spherical_jn, spherical_yn

POINTS = 3


def outgoing(order, x):
    """Return h_n(x) for n = 0 ... order, (N, *x), by upward recurrence, stable for h."""
    found = np.zeros((order + 1, *x.shape), complex)
    found[0] = np.exp(1j * x) / (1j * x)
    if order:
        found[1] = found[0] * (1.0 / x - 1j)
    for n in range(1, order):
        found[n + 1] = (2 * n + 1) / x * found[n] - found[n - 1]
    return found


def legendre(order, m, cosine):
    """Return associated Legendre functions of unit norm over the sphere, n = m ... order."""
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    found = np.zeros((order + 1 - m, *np.shape(cosine)))
    start = np.full(np.shape(cosine), np.sqrt(1.0 / (4.0 * np.pi)))
    for step in range(1, m + 1):
        start = start * sine * np.sqrt((2 * step + 1) / (2 * step))
    found[0] = start
    if order > m:
        found[1] = np.sqrt(2 * m + 3) * cosine * start
    for n in range(m + 2, order + 1):
        a = np.sqrt((4 * n * n - 1) / (n * n - m * m))
        b = np.sqrt(((n - 1) ** 2 - m * m) / (4 * (n - 1) ** 2 - 1))
        found[n - m] = a * (cosine * found[n - 1 - m] - b * found[n - 2 - m])
    return found


def around(places, centre, frame):
    """Return distance, cosine of the polar angle and azimuth of places about a centre."""
    x, y, z = np.moveaxis((places - centre) @ frame.T, -1, 0)
    r = np.sqrt(x * x + y * y + z * z)
    return r, z / r, np.arctan2(y, x)


def scattered(sources, receivers, centres, radius, wavenumbers):
    """Return the scattered pressure of unit sources exp(ikr)/r.

    Args:
        sources (P, 3): m.
        receivers (P, E, 3): m.
        centres (2, 3): Of the spheres, m.
        radius: Of both, m.
        wavenumbers (K,): rad/m.

    Returns:
        pressure (K, P, E): For waves that go as exp(-i omega t).
    """
    axis = (centres[1] - centres[0]) / np.linalg.norm(centres[1] - centres[0])
    side = np.cross(axis, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis])
    apart = float(np.linalg.norm(centres[1] - centres[0]))
    top = int(np.ceil(wavenumbers.max() * radius + 4.0 * (wavenumbers.max() * radius) ** (1 / 3)))
    out = [around(sources, centre, frame) for centre in centres]
    back = [around(receivers, centre, frame) for centre in centres]
    p_out = [[legendre(top, m, c[1]) for m in range(top + 1)] for c in out]
    p_back = [[legendre(top, m, c[1]) for m in range(top + 1)] for c in back]
    nodes, weights = np.polynomial.legendre.leggauss(POINTS * (top + 1))
    p_nodes = [legendre(top, m, nodes) for m in range(top + 1)]
    # Places beside this sphere's surface, seen from the other's centre.
    step = 1e-5 * radius
    beside = []
    for sign in (-1.0, 1.0):
        z = np.stack([(radius + move) * nodes + sign * apart for move in (-step, step)])
        rho = np.stack([(radius + move) * np.sqrt(1.0 - nodes**2) for move in (-step, step)])
        away = np.hypot(z, rho)
        beside.append((away, [legendre(top, m, z / away) for m in range(top + 1)]))
    found = np.zeros((len(wavenumbers), *receivers.shape[:2]), complex)
    for number, k in enumerate(wavenumbers):
        order = int(np.ceil(k * radius + 4.0 * (k * radius) ** (1 / 3)))
        degrees = np.arange(order + 1)
        j_slope = spherical_jn(degrees, k * radius, derivative=True)
        h_slope = j_slope + 1j * spherical_yn(degrees, k * radius, derivative=True)
        h_out = [outgoing(order, k * c[0]) for c in out]
        h_back = [outgoing(order, k * c[0]) for c in back]
        h_beside = [outgoing(order, k * away) for away, _ in beside]
        for m in range(order + 1):
            size = order + 1 - m
            matrix = np.zeros((2 * size, 2 * size), complex)
            for here, other in ((0, 1), (1, 0)):
                wave = h_beside[here][m:] * beside[here][1][m][:size]
                slope = (wave[:, 1] - wave[:, 0]) / (2.0 * step)
                project = p_nodes[m][:size] * weights * 2.0 * np.pi
                own, across = (slice(s * size, (s + 1) * size) for s in (here, other))
                matrix[own, own] = np.diag(k * h_slope[m:])
                matrix[own, across] = project @ slope.T
            right = np.concatenate(
                [
                    # exp(ikr)/r = 4 pi i k sum j_n h_n Y Y*
                    -4j * np.pi * k * k * j_slope[m:, None] * h_out[s][m:] * p_out[s][m][:size]
                    for s in (0, 1)
                ]
            )
            # Columns are scaled so that large orders do not swamp small ones.
            scale = np.abs(np.diag(matrix))
            solved = np.linalg.solve(matrix / scale[None], right) / scale[:, None]
            for s in (0, 1):
                coefficient = solved[s * size : (s + 1) * size]  # (n, P)
                heard = np.einsum("np,npe->pe", coefficient, h_back[s][m:] * p_back[s][m][:size])
                turn = m * (back[s][2] - out[s][2][:, None])
                found[number] += heard * (1.0 if m == 0 else 2.0 * np.cos(turn))
    return found


RATE, SAMPLES, SPEED = 400_000, 1600, 343.0
DURATION, LOW, HIGH = 1e-3, 20e3, 80e3
RADIUS, GAP = 0.015, 0.0145
MIDDLE = np.array([0.35, -0.2, 0.5])
"""Between the spheres, off the origin of the recordings; north, east, down, m."""
MICROPHONES = np.array([[0.0, 0.02, 0.0], [0.0, -0.02, 0.0], [0.0, 0.0, 0.02], [0.0, 0.0, -0.02]])
"""Forward, right, down, m; the loudspeaker is amid them."""
SNR_DB = 35.0


def centres():
    """Return the spheres' centres (2, 3); north, east, down, m."""
    axis = np.array([0.6, 0.5, 0.4]) / np.linalg.norm([0.6, 0.5, 0.4])
    return MIDDLE + np.outer([-0.5, 0.5], axis * (2.0 * RADIUS + GAP))


def poses(count, seed=0):
    """Return places (P, 3) all around and rotations (P, 3, 3) that look at the spheres, roughly."""
    rng = np.random.default_rng(seed)
    turn = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    z = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    level = np.sqrt(1.0 - z * z)
    away = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)
    places = MIDDLE + away * rng.uniform(0.25, 0.35, (count, 1))
    forward = -away + 0.05 * rng.standard_normal((count, 3))
    forward /= np.linalg.norm(forward, axis=1)[:, None]
    right = np.cross([0.0, 0.0, 1.0], forward)
    right /= np.linalg.norm(right, axis=1)[:, None]
    return places, np.stack([forward, right, np.cross(forward, right)], axis=2)


def sweep():
    """Return the call, a falling sweep with smooth ends, (N,)."""
    time = np.arange(round(DURATION * RATE)) / RATE
    phase = 2.0 * np.pi * (HIGH * time - (HIGH - LOW) / (2.0 * DURATION) * time**2)
    return np.sin(phase) * np.sin(np.pi * (np.arange(len(time)) + 0.5) / len(time)) ** 0.5


def waveforms(places, rotations, seed=0):
    """Return what the microphones record from the emission on, (P, E, S), full scale 1."""
    heads = places[:, None] + np.einsum("pij,ej->pei", rotations, MICROPHONES)
    frequency = np.fft.rfftfreq(SAMPLES, 1.0 / RATE)
    band = (frequency > LOW - 5e3) & (frequency < HIGH + 5e3)
    wavenumbers = 2.0 * np.pi * frequency[band] / SPEED
    spectrum = np.zeros((len(frequency), *heads.shape[:2]), complex)
    # A wave that goes as exp(-i omega t) has the conjugate spectrum of NumPy's.
    spectrum[band] = scattered(places, heads, centres(), RADIUS, wavenumbers).conj()
    call = np.fft.rfft(sweep(), SAMPLES)
    heard = np.fft.irfft(np.moveaxis(spectrum, 0, -1) * call, SAMPLES)
    heard *= 0.5 / np.abs(heard).max()
    loud = np.sqrt(np.mean(np.max(heard**2, axis=-1)) / 2.0)
    rng = np.random.default_rng([seed, 1])
    return heard + loud * 10.0 ** (-SNR_DB / 20.0) * rng.standard_normal(heard.shape)


def quaternions(rotations):
    """Return unit quaternions w, x, y, z, (P, 4)."""
    return np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=1)


SETTINGS = f"""\
air: {{speed_of_sound: {SPEED}}}
ears:
  receivers: [[0, -0.02, 0], [0, 0.02, 0], [0, 0, -0.02], [0, 0, 0.02]]
  emitter: [0, 0, 0]
  directivity: omnidirectional
  beam_radius: 0
call: {{kind: file, file: call.wav}}
spectrogram: {{frequency_min: {LOW}, frequency_max: {HIGH}}}
import: {{frame: ned, quaternion: wxyz, compress: true}}
"""


def table(places, rotations, first, name):
    """Return the table of poses: north, east, down in mm, and quaternions.

    Args:
        places (P, 3): m.
        rotations (P, 3, 3): Head to world.
        first: The first column of each row.
        name: Of the first column.
    """
    rows = np.column_stack([1e3 * places, quaternions(rotations)])
    lines = [
        ",".join([one, *(f"{value:.7f}" for value in row)])
        for one, row in zip(first, rows, strict=True)
    ]
    return "\n".join([f"{name},x_mm,y_mm,z_mm,qw,qx,qy,qz", *lines]) + "\n"


def write_folder(folder, count=120, seed=0):
    """Write a folder of recordings: 16-bit WAV files, ``poses.csv`` and ``import.yaml``."""
    folder.mkdir(parents=True, exist_ok=True)
    places, rotations = poses(count, seed)
    names = [f"ping_{number:03d}.wav" for number in range(count)]
    for name, heard in zip(names, waveforms(places, rotations, seed), strict=True):
        wavfile.write(folder / name, RATE, np.round(32767.0 * heard).astype(np.int16).T)
    (folder / "poses.csv").write_text(table(places, rotations, names, "file"))
    wavfile.write(folder / "call.wav", RATE, np.round(32767.0 * sweep()).astype(np.int16))
    (folder / "import.yaml").write_text(SETTINGS)


def write_long(folder, count=120, seed=0):
    """Write the same as one long file, ``flight.wav``, with the time of each call."""
    folder.mkdir(parents=True, exist_ok=True)
    places, rotations = poses(count, seed)
    heard = np.round(32767.0 * waveforms(places, rotations, seed)).astype(np.int16)
    begins = 500 + (SAMPLES + 300) * np.arange(count)
    samples = np.zeros((begins[-1] + SAMPLES + 500, heard.shape[1]), np.int16)
    for begin, one in zip(begins, heard, strict=True):
        samples[begin : begin + SAMPLES] = one.T
    wavfile.write(folder / "flight.wav", RATE, samples)
    times = [f"{begin / RATE:.9f}" for begin in begins]
    (folder / "poses.csv").write_text(table(places, rotations, times, "time_s"))
    wavfile.write(folder / "call.wav", RATE, np.round(32767.0 * sweep()).astype(np.int16))
    (folder / "import.yaml").write_text(SETTINGS)
