# SPDX-License-Identifier: MIT
import dataclasses

import numpy as np
import pytest

from sononerf.head.directivity_files import read_sofa, write_sofa
from sononerf.head.ears import ear_tables
from sononerf.settings.schema import EarSettings
from tests.head.directivity.patterns import pair

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.mark.parametrize("beam", [True, False])
@pytest.mark.parametrize("places", [True, False])
def test_sofar_finds_no_fault_in_what_we_write(tmp_path, beam, places):
    import sofar

    path = tmp_path / "a.sofa"
    write_sofa(path, pair(beam=beam, places=places), title="made up")
    sofa = sofar.read_sofa(str(path), verify=True, verbose=False)
    assert sofa.verify(issue_handling="return") is None
    assert sofa.GLOBAL_SOFAConventions == "GeneralTF"
    assert sofa.Data_Real.shape == (323, 2 + beam, 3)
    assert sofa.GLOBAL_Title == "made up"


@pytest.mark.parametrize("beam", [True, False])
def test_what_is_written_is_read_again(tmp_path, beam):
    path, wanted = tmp_path / "a.sofa", pair(beam=beam)
    write_sofa(path, wanted)
    found = read_sofa(path)
    np.testing.assert_allclose(found.directions, wanted.directions, atol=1e-12)
    np.testing.assert_array_equal(found.frequency, wanted.frequency)
    np.testing.assert_array_equal(found.gains, wanted.gains)
    np.testing.assert_array_equal(found.places, wanted.places)
    if beam:
        np.testing.assert_array_equal(found.beam, wanted.beam)
    else:
        assert found.beam is None


def test_places_that_are_not_known_stay_so(tmp_path):
    write_sofa(tmp_path / "a.sofa", pair(places=False))
    assert read_sofa(tmp_path / "a.sofa").places is None


def test_a_head_comes_back_from_its_file_within_a_tenth_of_a_decibel(tmp_path):
    frequency = np.arange(20e3, 101e3, 10e3)
    head = ear_tables(EarSettings(), frequency)
    path = tmp_path / "head.sofa"
    write_sofa(path, head.directivity())
    again = ear_tables(EarSettings(directivity="file", file=path), frequency)
    for found, wanted in ((again.ears, head.ears), (again.beam, head.beam)):
        heard = wanted > 1e-4
        off = 20 * np.log10(found[heard] / wanted[heard])
        assert np.abs(off).max() < 0.1
    np.testing.assert_allclose(again.positions, head.positions)


def test_one_receiver_goes_both_ways(tmp_path):
    both = pair()
    alone = dataclasses.replace(both, gains=both.gains[:1], places=both.places[:1], beam=None)
    write_sofa(tmp_path / "a.sofa", alone)
    found = read_sofa(tmp_path / "a.sofa")
    np.testing.assert_array_equal(found.gains, alone.gains)
    np.testing.assert_array_equal(found.places, alone.places)
