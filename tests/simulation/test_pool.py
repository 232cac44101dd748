# SPDX-License-Identifier: MIT
"""Processes that are kept, that die, and that cannot make the object they are sent."""

import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from sononerf.errors import NumericalError
from sononerf.simulation.pool import TaskError, computed

TASKS = {number: (number,) for number in range(6)}


def process(thing, number):
    return os.getpid()


def loud(thing, number):
    """Answer with more than a pipe holds."""
    return os.getpid(), number, bytes(3_000_000)


def remembered(thing, number):
    return thing


class Elsewhere:
    """An object that can be made in the process alone that sends it."""

    def __reduce__(self):
        return made_by, (os.getpid(),)


def made_by(number):
    if os.getpid() != number:
        raise ImportError("no module of\nthis name")
    return Elsewhere()


def test_processes_are_kept_for_the_next_time():
    first = set(dict(computed(process, None, TASKS, 2)).values())
    assert os.getpid() not in first
    assert set(dict(computed(process, None, TASKS, 2)).values()) <= first


def test_each_use_has_its_own_object():
    for thing in ("one", "other"):
        assert set(dict(computed(remembered, thing, TASKS, 2)).values()) == {thing}


def test_a_worker_that_is_killed_in_the_middle_of_an_answer_keeps_nobody_waiting():
    answers = computed(loud, None, TASKS, 1)
    number, (worker, *_) = next(answers)
    time.sleep(0.5)  # until the pipe is full
    os.kill(worker, signal.SIGKILL)
    found = {number, *(number for number, _ in answers)}
    assert found == set(TASKS)


def test_an_object_that_workers_cannot_make_is_told_in_one_line():
    with pytest.raises(TaskError, match=r"^ImportError: no module of this name$"):
        list(computed(remembered, Elsewhere(), TASKS, 2))
    assert set(dict(computed(remembered, "other", TASKS, 2)).values()) == {"other"}


def unsound(thing, number):
    raise NumericalError("the spectrogram is not finite")


def test_an_error_keeps_its_text_and_its_exit_code():
    with pytest.raises(TaskError, match=r"^the spectrogram is not finite$") as caught:
        list(computed(unsound, None, TASKS, 1))
    assert caught.value.exit_code == NumericalError.exit_code


def test_several_threads_use_processes_at_once_and_leave_the_script_as_it_was():
    script, environment = dict(vars(sys.modules["__main__"])), dict(os.environ)
    with ThreadPoolExecutor(4) as threads:
        found = [threads.submit(lambda: dict(computed(process, None, TASKS, 2))) for _ in range(8)]
        assert all(each.result().keys() == TASKS.keys() for each in found)
    after = vars(sys.modules["__main__"])
    assert {name: after.get(name) for name in ("__file__", "__spec__")} == {
        name: script.get(name) for name in ("__file__", "__spec__")
    }
    assert dict(os.environ) == environment
