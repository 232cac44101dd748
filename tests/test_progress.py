# SPDX-License-Identifier: MIT
import re
from types import SimpleNamespace

import pytest

from sononerf import progress
from sononerf.progress import Progress


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
