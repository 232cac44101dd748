# SPDX-License-Identifier: MIT
"""Errors of sononerf, each with the exit code of the command line."""

from __future__ import annotations


class SonoNerfError(Exception):
    """An error in one line: the fault, its place, the allowed values, and a remedy."""

    exit_code = 1


class SettingsError(SonoNerfError):
    """Wrong usage or settings; may hold several lines, one per fault."""

    exit_code = 2


class InputError(SonoNerfError):
    """A bad input file or plugin."""

    exit_code = 3


class StorageError(SonoNerfError):
    """Storage is full, read-only, or failing."""

    exit_code = 4


class NumericalError(SonoNerfError):
    """NaN, no echo, no surface."""

    exit_code = 5


class ResourceError(SonoNerfError):
    """Not enough memory, or a device that is not there."""

    exit_code = 6


class LockedError(SonoNerfError):
    """Another process works in the same folder."""

    exit_code = 7


class IncompatibleError(SonoNerfError):
    """Artefacts, settings or versions that do not fit together."""

    exit_code = 8


class StoppedError(SonoNerfError):
    """Stopped by a signal; the message says what the same command does."""

    def __init__(self, signal_number: int, message: str) -> None:
        super().__init__(message)
        self.exit_code = 128 + signal_number


def expect(value: object, kind: type, name: str) -> None:
    """Refuse a value of another kind."""
    if not isinstance(value, kind):
        raise InputError(f"{name} is a {type(value).__name__}, expected a {kind.__name__}")
