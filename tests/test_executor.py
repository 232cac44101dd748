# SPDX-License-Identifier: MIT
"""Processes that die, that cannot make what they are sent, and that a script starts."""

import os
import signal
import subprocess
import sys

import pytest

from sononerf.errors import NumericalError, ResourceError
from sononerf.executor import TaskError, computed

TASKS = {number: (number,) for number in range(6)}


def process(thing, number):
    return os.getpid()


def remembered(thing, number):
    return thing


def killed_once(folder, number):
    """Kill the worker of one task, the first time."""
    mark = folder / "killed"
    if number == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def killed(thing, number):
    os.kill(os.getpid(), signal.SIGKILL)


class Elsewhere:
    """An object that can be made in the process alone that sends it."""

    def __reduce__(self):
        return made_by, (os.getpid(),)


def made_by(number):
    if os.getpid() != number:
        raise ImportError("no module of\nthis name")
    return Elsewhere()


def unsound(thing, number):
    raise NumericalError("the spectrogram is not finite")


def test_tasks_are_computed_by_other_processes_with_the_thing_they_were_given():
    assert os.getpid() not in dict(computed(process, None, TASKS, 2)).values()
    for thing in ("one", "other"):
        assert dict(computed(remembered, thing, TASKS, 2)) == dict.fromkeys(TASKS, thing)


def test_the_task_of_a_killed_worker_is_computed_once_more(tmp_path):
    assert dict(computed(killed_once, tmp_path, TASKS, 2)) == {number: number for number in TASKS}
    (tmp_path / "killed").unlink()
    assert dict(computed(killed_once, tmp_path, {3: (3,)}, 1)) == {3: 3}  # the first of all


def test_workers_that_are_always_killed_are_an_error_of_one_line():
    with pytest.raises(ResourceError, match=r"^pose 0: every worker that took it was killed"):
        list(computed(killed, None, TASKS, 1))


def test_an_object_that_workers_cannot_make_is_reported_in_one_line():
    with pytest.raises(TaskError, match=r"^ImportError: no module of this name$"):
        list(computed(remembered, Elsewhere(), TASKS, 2))


def test_an_error_keeps_its_text_and_its_exit_code():
    with pytest.raises(TaskError, match=r"^the spectrogram is not finite$") as caught:
        list(computed(unsound, None, TASKS, 1))
    assert caught.value.exit_code == NumericalError.exit_code


def test_a_script_without_a_guard_starts_workers(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "print('begun')\n"
        "from sononerf.executor import computed\n"
        "import operator\n"
        "print(sorted(computed(operator.add, 1, {2: (2,), 3: (3,)}, 2)))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("begun\n[(2, 3), (3, 4)]\n", 0), done.stderr
