# SPDX-License-Identifier: MIT
"""The numbers of a run follow from its files, or it is told which do not."""

from __future__ import annotations

import shutil

import pytest

from sononerf.errors import IncompatibleError, InputError
from sononerf.run.fit import finish
from sononerf.run.run_folder import RunFolder
from sononerf.run.verify import verify

pytestmark = pytest.mark.usefixtures("without_pictures")


@pytest.fixture(scope="module")
def finished(fitted_run, tmp_path_factory, without_pictures):
    path = tmp_path_factory.mktemp("finished") / "run"
    shutil.copytree(fitted_run, path)
    finish(path, accelerator="cpu")
    return path


@pytest.mark.slow
def test_a_run_as_it_was_written_holds_and_nothing_is_written(finished):
    before = {file: file.stat().st_mtime_ns for file in finished.rglob("*")}
    checked = verify(finished, accelerator="cpu")
    assert checked["files"] > 10
    assert checked["numbers"] > 30
    assert {file: file.stat().st_mtime_ns for file in finished.rglob("*")} == before


@pytest.mark.slow
def test_numbers_that_the_files_do_not_give_are_named(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    run = RunFolder(tmp_path / "run")
    for section, key in (("prediction", "mae_db"), ("geometry", "chamfer_m")):
        run.write_metrics(section, {key: 0.99 * run.read_metrics()[section][key]}, merge=True)
    with pytest.raises(IncompatibleError) as error:
        verify(run.path, accelerator="cpu")
    told = str(error.value).splitlines()
    assert [line.split()[1] for line in told] == ["prediction.mae_db", "geometry.chamfer_m"]
    assert all(", and the files give " in line for line in told)


def test_damaged_and_missing_files_are_named(fitted_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(fitted_run, run)
    data = bytearray((run / "model.json").read_bytes())
    data[-9] ^= 4
    (run / "model.json").write_bytes(data)
    (run / "provenance.json").unlink()
    with pytest.raises(InputError) as error:
        verify(run, accelerator="cpu")
    lines = str(error.value).splitlines()
    names = [str(run / name) for name in ("model.json", "provenance.json")]
    assert [line.partition(":")[0] for line in lines] == names


def test_a_run_without_numbers_is_told_so(fitted_run):
    with pytest.raises(InputError, match="no numbers yet"):
        verify(fitted_run)
