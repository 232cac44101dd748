# SPDX-License-Identifier: MIT
"""Processes that are kept, that die, and that cannot make the object they are sent."""

import os
import signal
import time

import pytest

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
