# SPDX-License-Identifier: MIT
"""A made-up pair of ears with a beam, and files of it."""

import h5py
import numpy as np
import scipy.io

from sononerf.head.directivity import Directivity, unit_vectors

AZIMUTH = np.arange(-90.0, 91.0, 10.0)
ELEVATION = np.arange(-80.0, 81.0, 10.0)
FREQUENCY = np.array([30e3, 50e3, 80e3])
PLACES = np.array([[0.0, 0.01, 0.002], [0.0, -0.01, 0.002]])


def lobe(directions, axis, frequency=FREQUENCY):
    """Gains (M, F) of a lobe about an axis."""
    angle = np.arccos(np.clip(directions @ np.asarray(axis) / np.linalg.norm(axis), -1, 1))
    return np.exp(-0.5 * (angle[:, None] / 0.9) ** 2 * frequency / 50e3)


def gridded():
    """Gains over azimuth, elevation and frequency (19, 17, 3): left, right, emitter."""
    grid = np.radians(np.meshgrid(AZIMUTH, ELEVATION, indexing="ij"))
    directions = unit_vectors(*grid).reshape(-1, 3)
    axes = ((1, 0.5, 0.2), (1, -0.5, 0.2), (1, 0, 0))
    return directions, *(lobe(directions, axis).reshape(19, 17, 3) for axis in axes)


def pair(source="made up", *, beam=True, places=True):
    directions, left, right, emitter = gridded()
    return Directivity(
        source,
        directions,
        FREQUENCY,
        np.stack([left, right]).reshape(2, -1, 3),
        emitter.reshape(-1, 3) if beam else None,
        PLACES if places else None,
    )


def sononerf_fields(**changed):
    _, left, right, _ = gridded()
    fields = {
        "freq_vec": FREQUENCY[:, None],
        "az_grid_vec": AZIMUTH[:, None],
        "el_grid_vec": ELEVATION[None],
        "left_struct": {"hrtf_gridded_array": left.transpose(1, 0, 2), "FIR_coeffs": np.ones(9)},
        "right_struct": {"hrtf_gridded_array": right.transpose(1, 0, 2)},
    }
    return {"array_struct": {**fields, **changed}}


def batslam_fields(**changed):
    _, left, right, emitter = gridded()
    fields = {
        "freq_vec": FREQUENCY[None],
        "az_vec": AZIMUTH[None],
        "el_vec": ELEVATION[None],
        "hrtf_left": left,
        "hrtf_right": right,
        "hrtf_em": emitter,
        "fs": 500e3,
    }
    return {"bat_hrtf": {**fields, **changed}}


def write_v5(path, fields):
    scipy.io.savemat(path, fields)
    return path


def write_v73(path, fields):
    """Lay fields out as MATLAB does: structs are groups, arrays are transposed, a user block."""

    def fill(group, content):
        for name, value in content.items():
            if isinstance(value, dict):
                child = group.create_group(name)
                child.attrs["MATLAB_class"] = np.bytes_("struct")
                fill(child, value)
            else:
                made = group.create_dataset(name, data=np.atleast_2d(value).T)
                made.attrs["MATLAB_class"] = np.bytes_("double")

    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file, fields)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path
