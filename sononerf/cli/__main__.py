# SPDX-License-Identifier: MIT
"""Entry point of the command ``sononerf``: it catches signals before it imports anything large."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from sononerf.errors import StoppedError, StorageError

GOES_ON = "the same command goes on where it stopped"
AFTERWARDS = {
    "simulate": GOES_ON,
    "import": GOES_ON,
    "fit": GOES_ON,
    "reconstruct": "the same command goes on with the refinement as it was last saved, if it was",
    "calibrate": "the same command keeps finished trials and does the rest anew",
}
"""Message after a signal, by command; any other command begins anew."""
ANEW = "the same command begins anew"


class _SignalledError(BaseException):
    """A signal came; nothing on the way may take it for a fault and go on."""


@contextmanager
def _signals_unwind(came: list[int]) -> Iterator[None]:
    """Let signals close files and end child processes on the way out; note their numbers."""

    def unwind(number: int, frame: FrameType | None) -> None:
        del frame
        came.append(number)
        raise _SignalledError

    before = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # Signals that were ignored at the start (nohup, a shell's &) stay ignored.
        if signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, unwind)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(came: list[int]) -> int:
    try:
        Path.cwd()
    except OSError:  # libraries end the process without it
        sys.stderr.write("error: the working folder was deleted; change to another one\n")
        return StorageError.exit_code
    try:
        with _signals_unwind(came):
            from sononerf.cli import app

            try:
                return app.run()
            except BrokenPipeError:
                raise
            except Exception as error:
                if came:  # compiled modules turn it into an error of their own
                    raise _SignalledError from error
                fault = app.fault_of(error)
    except (_SignalledError, ImportError):
        if not came:
            raise
        words = [word for word in sys.argv[1:] if not word.startswith("-")]
        rest = AFTERWARDS.get(words[0], ANEW) if words else ANEW
        fault = StoppedError(came[0], f"stopped; {rest}")
    kind = "" if isinstance(fault, StoppedError) else "error: "  # the user's wish is no fault
    if kind or not {"-q", "--quiet"} & set(sys.argv):
        for line in str(fault).splitlines():
            sys.stderr.write(f"{kind}{line}\n")
    return fault.exit_code


def main() -> None:
    """Run the command line and end with its exit code."""
    try:
        sys.exit(_run([]))
    except BrokenPipeError:
        # The reader of our output went away, as `head` does.
        sys.stderr.close()
        sys.exit(141)


if __name__ == "__main__":
    main()
