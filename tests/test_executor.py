# SPDX-License-Identifier: MIT
"""Processes that die, that cannot make what they are sent, and that a script starts."""

import importlib
import multiprocessing
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import sononerf
from sononerf import progress
from sononerf.errors import NumericalError, ResourceError
from sononerf.progress import Progress
from sononerf.resources import (
    TaskError,
    available_memory,
    computed,
    may_start_processes,
    require_disk,
    require_memory,
)

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
        "from sononerf.resources import computed\n"
        "import operator\n"
        "print(sorted(computed(operator.add, 1, {2: (2,), 3: (3,)}, 2)))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("begun\n[(2, 3), (3, 4)]\n", 0), done.stderr


@pytest.fixture
def clock(monkeypatch):
    """A clock that is set by hand."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def test_plain_lines_come_now_and_then(clock, capsys):
    with Progress().task("fitting", 50) as task:
        for step in range(50):
            clock.now += 1.0
            task.advance(note=f"loss {step}")
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert lines[0] == "fitting: 10 of 50, 10 s, 1/s, 40 s left loss 9"
    assert lines[-1] == "fitting: 50 of 50, 50 s loss 49"
    # One per ten seconds, and one at the end: once, where both fall together.
    assert [line.split(",")[0] for line in lines] == [
        f"fitting: {n} of 50" for n in (10, 20, 30, 40, 50)
    ]
    assert "\x1b" not in err


def test_short_work_says_nothing(clock, capsys):
    with Progress().task("looking", 3) as task:
        clock.now += 1.0
        task.advance(3)
    assert task.done == 3
    assert capsys.readouterr() == ("", "")


def test_quiet_says_nothing(clock, capsys):
    shown = Progress(quiet=True)
    shown.say("hello")
    with shown.task("fitting", 2) as task:
        clock.now += 60.0
        task.advance(note="x")
        task.advance()
    assert (task.done, task.note) == (2, "x")
    assert capsys.readouterr() == ("", "")


def test_silenced_makes_each_new_one_quiet(clock, monkeypatch, capsys):
    monkeypatch.setattr(Progress, "silenced", True)
    shown = Progress()
    shown.say("hello")
    with shown.task("fitting", 2) as task:
        clock.now += 60.0
        task.advance()
    assert capsys.readouterr() == ("", "")


def test_a_saying_is_one_line_as_it_is(capsys):
    text = "region [-1, 2] mm " + "long " * 60 + "[red]end[/red]"
    Progress().say(text)
    assert capsys.readouterr() == ("", text + "\n")


def test_a_narrow_terminal_gets_the_count_alone(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "40")
    with Progress().task("fitting", 4) as task:
        task.advance(3, note="a note that is longer than the line")
    err = re.sub("\x1b[^a-zA-Z]*[a-zA-Z]", "", capsys.readouterr().err)
    assert "3/4" in err
    assert max(len(line.rstrip()) for line in re.split("[\r\n]", err)) <= 40


def test_a_terminal_gets_a_bar(monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("FORCE_COLOR", "1")  # what makes rich take any stream for a terminal
    shown = Progress()
    with shown.task("fitting", 4) as task:
        task.advance(3, note="loss 7")
    out, err = capsys.readouterr()
    assert out == ""
    assert "fitting" in err
    assert "3/4" in err
    assert "loss 7" in err


def test_available_memory_is_plausible():
    free = available_memory()
    assert free is None or 10_000_000 < free < 10**15


def run(code):
    """Run Python in a process of its own and return what it says."""
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    return found.stdout + found.stderr


def test_work_that_needs_too_much_is_refused_with_the_figure():
    require_memory(1e6, "a small thing", "nothing")
    with pytest.raises(ResourceError, match=r"a fit needs about 1,000,000 GB of memory, and .* GB"):
        require_memory(1e15, "a fit", "make it smaller")


def test_files_that_the_disk_does_not_hold_are_refused(tmp_path):
    require_disk(1e3, tmp_path / "new" / "store", "echoes", "lower it")
    with pytest.raises(
        ResourceError, match=r"^echoes needs about [\d,]+ GB of disk, and .*; lower"
    ):
        require_disk(1e18, tmp_path / "new" / "store", "echoes", "lower it")
    assert not (tmp_path / "new").exists()


PACKAGE = Path(sononerf.__file__).parent
HOLDERS = sorted(
    str(path.relative_to(PACKAGE.parent).with_suffix("")).replace(os.sep, ".")
    for path in PACKAGE.rglob("*.py")
    if "\n@compiled\n" in path.read_text(encoding="utf-8")
)


def is_compiled(value):
    return hasattr(value, "py_func")


@pytest.mark.parametrize("name", HOLDERS)
def test_a_compiled_function_calls_compiled_ones_of_its_own_file_alone(name):
    """Numba looks at the time of that file, and of no other."""
    module = importlib.import_module(name)
    own = {key: value for key, value in vars(module).items() if is_compiled(value)}
    assert own
    for function in own.values():
        if function.py_func.__module__ != name:
            continue
        for called in function.py_func.__code__.co_names:
            value = own.get(called)
            assert value is None or value.py_func.__module__ == name, called


def test_a_worker_of_a_pool_computes_alone():
    assert may_start_processes()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert not pool.apply(may_start_processes)


def test_machine_code_is_kept_apart_where_there_is_no_home(tmp_path):
    """A user without a home and a name: the system leaves the tilde as it is."""
    code = (
        "import os, numba; os.path.expanduser = lambda path: path\n"
        "import sononerf.numerics; print(numba.config.CACHE_DIR)"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    folder = tmp_path / f"numba-{os.geteuid()}"
    assert done.stdout.strip() == str(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)  # somebody else's, as far as one can know
    again = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert again.stdout.strip() in ("", "None")
