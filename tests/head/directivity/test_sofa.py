# SPDX-License-Identifier: MIT
import h5py
import numpy as np
import pytest

from sononerf.errors import InputError
from sononerf.head.directivity_files import read_directivity, read_sofa
from tests.head.directivity.patterns import FREQUENCY, PLACES, pair
from tests.head.directivity.sofa_files import written

# What sofar imports warns of its own matters.
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.mark.parametrize("convention", ["GeneralTF", "SimpleFreeFieldHRTF"])
def test_transfer_functions_that_sofar_wrote(tmp_path, convention):
    found, wanted = read_sofa(written(tmp_path / "a.sofa", convention)), pair()
    np.testing.assert_allclose(found.directions, wanted.directions, atol=1e-9)
    np.testing.assert_array_equal(found.frequency, FREQUENCY)
    np.testing.assert_allclose(found.gains, wanted.gains, atol=1e-12)
    np.testing.assert_allclose(found.places, PLACES)
    assert found.beam is None


def test_impulse_responses_that_sofar_wrote(tmp_path):
    found = read_sofa(written(tmp_path / "a.sofa", "SimpleFreeFieldHRIR"))
    assert found.frequency[-1] == 100e3
    np.testing.assert_allclose(found.gains, np.repeat(pair().gains[..., 1:2], 17, axis=2))


def test_a_transducer_that_sofar_wrote_hears_as_it_sends(tmp_path):
    found, wanted = read_sofa(written(tmp_path / "a.sofa", "FreeFieldDirectivityTF")), pair()
    np.testing.assert_allclose(found.directions, wanted.directions, atol=1e-9)
    np.testing.assert_allclose(found.beam, wanted.beam, atol=1e-12)
    np.testing.assert_array_equal(found.gains[0], found.beam)
    assert found.places is None


def test_cartesian_sources_and_complex_gains(tmp_path):
    known = pair()
    path = written(
        tmp_path / "a.sofa",
        "GeneralTF",
        SourcePosition=3.0 * known.directions + [0.1, 0.2, 0.3],
        SourcePosition_Type="cartesian",
        SourcePosition_Units="metre",
        ListenerPosition=np.array([[0.1, 0.2, 0.3]]),
        Data_Real=0.6 * known.gains.transpose(1, 0, 2),
        Data_Imag=-0.8 * known.gains.transpose(1, 0, 2),
    )
    found = read_sofa(path)
    np.testing.assert_allclose(found.directions, known.directions, atol=1e-9)
    np.testing.assert_allclose(found.gains, known.gains)


def test_the_listener_looks_ahead(tmp_path):
    """A listener who looks to the left, head upright: what was left is ahead."""
    path = written(
        tmp_path / "a.sofa", "SimpleFreeFieldHRTF", ListenerView=np.array([[0.0, 1.0, 0.0]])
    )
    x, y, z = pair().directions.T
    found = read_sofa(path)
    np.testing.assert_allclose(found.directions, np.stack([y, -x, z], axis=1), atol=1e-9)
    np.testing.assert_allclose(found.places, PLACES)  # these are the listener's own


def test_receivers_all_at_one_point_have_no_places(tmp_path):
    path = written(tmp_path / "a.sofa", "GeneralTF", ReceiverPosition=np.zeros((2, 3)))
    assert read_sofa(path).places is None


@pytest.mark.parametrize("unit", ["kilohertz", "kHz"])
def test_frequencies_are_in_the_unit_that_the_file_states(tmp_path, unit):
    path = written(tmp_path / "a.sofa", "GeneralTF", N=FREQUENCY / 1e3)
    with h5py.File(path, "r+") as file:
        attribute("N", "Units", unit)(file)
    np.testing.assert_allclose(read_sofa(path).frequency, FREQUENCY)


def test_directions_at_several_distances_are_refused(tmp_path):
    gains = pair().gains.transpose(1, 0, 2)
    places = pair().directions
    path = written(
        tmp_path / "a.sofa",
        "GeneralTF",
        SourcePosition=np.concatenate([places, 0.5 * places]),
        SourcePosition_Type="cartesian",
        SourcePosition_Units="metre",
        Data_Real=np.concatenate([gains, 0.5 * gains]),
        Data_Imag=np.zeros((2 * len(gains), *gains.shape[1:])),
    )
    with pytest.raises(InputError, match=r"several distances, from 0\.5 to 1;"):
        read_sofa(path)


def test_a_table_in_radians_that_says_degrees_is_told(tmp_path, caplog):
    x, y, z = pair().directions.T
    angles = np.stack([np.arctan2(y, x), np.arcsin(z), np.ones(len(x))], axis=1)
    read_directivity(written(tmp_path / "a.sofa", "GeneralTF", SourcePosition=angles))
    assert "are the angles radians" in caplog.text


def attribute(owner, name, value):
    def change(file):
        (file[owner] if owner else file).attrs[name] = np.bytes_(value)

    return change


def replaced(name, make):
    def change(file):
        values = make(file[name][()])
        # What netCDF hangs on to a variable goes with it.
        kept = {key: file[name].attrs[key] for key in ("Type", "Units") if key in file[name].attrs}
        del file[name]
        file[name] = values
        file[name].attrs.update(kept)

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            attribute("", "SOFAConventions", "MultiSpeakerBRIR"),
            "MultiSpeakerBRIR v2.0 is not a valid SOFA Convention",
        ),
        (attribute("SourcePosition", "Type", "spherical harmonics"), "is spherical harmonics"),
        (attribute("ReceiverPosition", "Units", "mm"), "ReceiverPosition is in mm, expected metre"),
        (replaced("Data.Real", lambda v: v * np.nan), "the gains hold NaN"),
        (replaced("Data.Real", lambda v: v[:, :, 1:]), "Data.Real and Data.Imag differ"),
        (attribute("N", "Units", "radian per second"), "N is in radian per second, expected hertz"),
        (
            replaced("SourcePosition", lambda v: np.abs([1, 1, 1] * v - [0, 90, 0])),
            "elevation of 1[678]. degrees, expected -90 to 90",
        ),
        (replaced("SourcePosition", lambda v: v[1:]), r"SourcePosition has the shape \(322, 3\)"),
        (replaced("SourcePosition", lambda v: 0 * v), "a position or view gives no direction"),
        (replaced("ReceiverPosition", lambda v: np.ones((3, 3))), r"expected \(2, 3\)"),
        (lambda file: file.__delitem__("Data.Real"), "holds no Data.Real"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path, change, said):
    path = written(tmp_path / "a.sofa", "GeneralTF")
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InputError, match=said) as raised:
        read_sofa(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("rate", [0.0, np.nan])
def test_a_sampling_rate_that_is_none_is_refused(tmp_path, rate):
    path = written(tmp_path / "a.sofa", "SimpleFreeFieldHRIR")
    with h5py.File(path, "r+") as file:
        replaced("Data.SamplingRate", lambda v: np.full(np.shape(v), rate))(file)
    with pytest.raises(InputError, match="SamplingRate is"):
        read_sofa(path)


def test_angles_in_radians_are_told_and_read(tmp_path, caplog):
    path = written(tmp_path / "a.sofa", "GeneralTF")
    with h5py.File(path, "r+") as file:
        replaced("SourcePosition", lambda v: v * [np.pi / 180, np.pi / 180, 1])(file)
        attribute("SourcePosition", "Units", "radian, radian, metre")(file)
    np.testing.assert_allclose(read_sofa(path).directions, pair().directions, atol=1e-9)
    assert "SourcePosition is in radians" in caplog.text


def test_a_missing_place_of_the_receivers_is_no_fault(tmp_path):
    path = written(tmp_path / "a.sofa", "GeneralTF")
    with h5py.File(path, "r+") as file:
        del file["ReceiverPosition"]
    assert read_sofa(path).places is None


@pytest.mark.parametrize(
    ("convention", "version"), [("SimpleFreeFieldHRIR", "0.4"), ("FreeFieldDirectivityTF", "1.0")]
)
def test_old_versions_are_read(tmp_path, convention, version):
    path = written(tmp_path / "a.sofa", convention)
    new = read_sofa(path)
    with h5py.File(path, "r+") as file:
        attribute("", "SOFAConventionsVersion", version)(file)
    old = read_sofa(path)
    np.testing.assert_array_equal(old.gains, new.gains)
    np.testing.assert_array_equal(old.directions, new.directions)
