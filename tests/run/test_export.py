# SPDX-License-Identifier: MIT
"""A store and a run are written as files that other programs read."""

from __future__ import annotations

import io

import h5py
import numpy as np
import pytest
import scipy.io
import trimesh
import zarr

from sononerf import storage
from sononerf.echoes.store import EnsembleStore
from sononerf.errors import InputError, ResourceError, SettingsError
from sononerf.run import export as export_module
from sononerf.run.export import Named, export, file_bytes
from sononerf.run.predict import predict
from sononerf.run.reconstruct import reconstruct
from sononerf.run.run import Run


@pytest.fixture(scope="module")
def run(fitted, tmp_path_factory):
    predict(fitted)
    reconstruct(fitted)
    return fitted


def test_echoes_of_a_store(echoes, tmp_path):
    found = scipy.io.loadmat(export(echoes, tmp_path / "echoes.mat"))
    store = EnsembleStore.open(echoes)
    assert np.array_equal(found["spectrogram"][3], store.read_pose(3))
    assert np.array_equal(found["frequency"].ravel(), store.frequency)
    assert found["split"].ravel().tolist() == store.split.tolist()
    assert "sphere" not in str(found["attributes"]["origin"])
    assert np.allclose(found["position"], store.positions)


def test_a_mesh_is_written_in_each_frame(run, tmp_path):
    """A simulation has no other frame than the world's unless its scene's file has one."""
    facts = storage.read_json(run / "provenance.json")
    own = Run(run).mesh()
    written = trimesh.load(export(run, tmp_path / "a.ply"), process=False)
    np.testing.assert_allclose(written.vertices, own.vertices, atol=1e-7)
    turned = [[0, 1000, 0, 5], [1000, 0, 0, 0], [0, 0, -1000, 0], [0, 0, 0, 1]]
    storage.commit_json(run / "provenance.json", {**facts, "to_original": turned})
    try:
        there = trimesh.load(export(run, tmp_path / "b.stl", frame="original"))
        np.testing.assert_allclose(there.bounds[1, 0], 1e3 * own.bounds[1, 1] + 5, rtol=1e-3)
        assert there.volume == pytest.approx(1e9 * own.volume, rel=1e-3)
        with pytest.raises(InputError, match="in the world's frame; add --frame world"):
            export(run, tmp_path / "v.h5", what="volume", frame="original")
    finally:
        storage.commit_json(run / "provenance.json", facts)
    with pytest.raises(SettingsError, match=r"a mesh is written as \.ply, \.stl, \.glb"):
        export(run, tmp_path / "m.stl", what="volume")


def test_the_store_opens_with_names_and_units(echoes):
    group = zarr.open_group(echoes, mode="r")
    assert group["spectrogram"].metadata.dimension_names == ("pose", "ear", "range", "frequency")
    assert group["range"].attrs["units"] == "m"
    assert group["frequency"].attrs["units"] == "Hz"


def test_prediction_and_volume_of_a_run(run, tmp_path):
    with h5py.File(export(run, tmp_path / "prediction.h5")) as file:
        assert file["predicted"].shape == file["measured"].shape
        assert file["predicted"].dims[2].label == "range"
    with h5py.File(export(run, tmp_path / "v.h5", what="volume")) as file:
        assert [axis.label for axis in file["reflectivity"].dims] == ["x", "y", "z"]
        reflectivity = file["reflectivity"][...]
        loudest = np.unravel_index(reflectivity.argmax(), reflectivity.shape)
        place = [float(file[axis][k]) for axis, k in zip("xyz", loudest, strict=True)]
    assert np.linalg.norm(place) < 0.04  # the sphere of 20 mm lies at the origin


def test_normals_are_in_the_mesh_file(run):
    head = (run / "reconstruction" / "mesh.ply").read_bytes()[:1000]
    for name in (b"property float nx", b"property float ny", b"property float nz"):
        assert name in head


@pytest.mark.parametrize(
    ("name", "what", "error", "says"),
    [
        ("x.txt", "auto", SettingsError, r"expected a suffix of \.mat"),
        ("x.mat", "echoes", InputError, "is no store"),
    ],
)
def test_what_does_not_fit_is_refused(run, tmp_path, name, what, error, says):
    with pytest.raises(error, match=says):
        export(run, tmp_path / name, what=what)
    assert not (tmp_path / name).exists()


def test_what_is_missing_or_damaged_is_named(tmp_path, fitted):
    with pytest.raises(InputError, match="sononerf predict"):
        export(tmp_path, tmp_path / "x.mat")
    with pytest.raises(InputError, match="sononerf reconstruct"):
        export(tmp_path, tmp_path / "x.mat", what="volume")
    (tmp_path / "prediction").mkdir()
    (tmp_path / "prediction" / "spectrograms.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="damaged"):
        export(tmp_path, tmp_path / "x.mat")


ARRAYS = {
    "level": Named(np.arange(6, dtype=np.float32).reshape(2, 3), ("pose", "range"), "dB", "level"),
    "range": Named(np.array([0.1, 0.2, 0.3]), ("range",), "m", "one-way distance"),
    "number": Named(np.array([7, 8], dtype=np.int64), ("pose",), "", "of the pose"),
}


def test_matlab():
    found = scipy.io.loadmat(io.BytesIO(file_bytes("mat", ARRAYS, {"origin": "simulated"})))
    assert np.array_equal(found["level"], ARRAYS["level"].values)
    assert found["range"].shape == (3, 1)
    assert found["units"]["level"][0, 0][0] == "dB"
    assert found["axes"]["level"][0, 0][0] == "pose, range"
    assert found["attributes"]["origin"][0, 0][0] == "simulated"


def test_hdf5():
    with h5py.File(io.BytesIO(file_bytes("h5", ARRAYS, {"origin": "simulated"}))) as file:
        assert np.array_equal(file["number"][...], [7, 8])
        assert file["level"].attrs["units"] == "dB"
        assert [axis.label for axis in file["level"].dims] == ["pose", "range"]
        assert np.array_equal(file["level"].dims[1][0][...], ARRAYS["range"].values)
        assert file.attrs["origin"] == "simulated"


@pytest.mark.parametrize("kind", ["mat", "h5"])
def test_the_same_arrays_give_the_same_bytes(kind, monkeypatch):
    first = file_bytes(kind, ARRAYS, {})
    monkeypatch.setattr("time.asctime", lambda *given: "another day")
    assert file_bytes(kind, ARRAYS, {}) == first


def test_what_is_too_large_for_a_format_is_refused(monkeypatch):
    monkeypatch.setattr(export_module, "LARGEST", 20)
    with pytest.raises(ResourceError, match=r"level: .* choose a \.h5 file"):
        file_bytes("mat", ARRAYS, {})
