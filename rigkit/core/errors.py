"""Errors for the user. Each message says what is wrong, where, and what to do about it."""

from __future__ import annotations

from enum import IntEnum

IN_PYTHON = " (force=True in Python)"
"""Part of messages that the command line leaves out."""


class ExitCode(IntEnum):
    """Exit codes of the command line."""

    WELL = 0
    CHECK_FAILED = 1
    BAD_INPUT = 2
    DEGENERATE = 3
    BUG = 70
    BY_SIGNAL = 128
    """Plus the number of the signal that ended the program."""


class RigkitError(Exception):
    """Base of every error that rigkit raises on purpose; `exit_code` is what the command line returns for it."""

    exit_code: ExitCode = ExitCode.BAD_INPUT

    def __str__(self) -> str:
        """Return the message as one line, with unprintable characters escaped."""
        return printable(super().__str__())


class CheckFailed(RigkitError):
    """A measured check did not hold."""

    exit_code = ExitCode.CHECK_FAILED


class InputError(RigkitError):
    """Invalid input: a file, an option, an array."""

    exit_code = ExitCode.BAD_INPUT


class InstallationError(RigkitError):
    """A part of rigkit itself is missing or out of date: the message says what to type."""

    exit_code = ExitCode.BAD_INPUT


class DegenerateError(RigkitError):
    """The geometry does not determine what was asked for (no baseline, one flat board only, parallel directions)."""

    exit_code = ExitCode.DEGENERATE


class InternalError(RigkitError):
    """A bug of rigkit in one part of the work, while the rest of the work continues."""

    exit_code = ExitCode.BUG

    def __str__(self) -> str:
        """Return the message with its traceback lines."""
        return Exception.__str__(self)


def interruption(error: BaseException) -> KeyboardInterrupt | None:
    """Return the KeyboardInterrupt among the causes of `error`, or None: libraries that are interrupted while they are
    imported raise an ImportError."""
    cause: BaseException | None = error
    # An error raised again from one of its consequences is among its own causes.
    seen: set[int] = set()
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        seen.add(id(cause))
        further = (cause.__cause__, cause.__context__)
        cause = next((one for one in further if one is not None and id(one) not in seen), None)
    return cause


def printable(text: str) -> str:
    """Return the text with line ends, terminal codes and other unprintable characters escaped."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
