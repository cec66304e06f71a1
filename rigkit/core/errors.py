"""The errors that a person sees. Each message says what is wrong, where, and what to do about it."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """What the command line returns."""

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
        """One line, whatever characters the name of a file or a value in it has."""
        return printable(super().__str__())


class CheckFailed(RigkitError):
    """A measured check did not hold."""

    exit_code = ExitCode.CHECK_FAILED


class InputError(RigkitError):
    """What was handed in cannot be used: a file, an option, an array."""

    exit_code = ExitCode.BAD_INPUT


class InstallationError(RigkitError):
    """A part of rigkit itself is missing or does not fit: the message says what to type."""

    exit_code = ExitCode.BAD_INPUT


class DegenerateError(RigkitError):
    """The geometry does not determine what was asked for (no baseline, one flat board only, parallel directions)."""

    exit_code = ExitCode.DEGENERATE


class InternalError(RigkitError):
    """A fault of rigkit itself in one part of the work, where the rest of the work goes on."""

    exit_code = ExitCode.BUG

    def __str__(self) -> str:
        """With the lines that say where it happened."""
        return Exception.__str__(self)


def interruption(error: BaseException) -> KeyboardInterrupt | None:
    """Return the interruption that `error` came of; None where it came of something else. Libraries that are
    interrupted while they are loaded say that they could not be."""
    cause: BaseException | None = error
    # An error that is raised again from one that came of it is among its own causes.
    seen: set[int] = set()
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        seen.add(id(cause))
        further = (cause.__cause__, cause.__context__)
        cause = next((one for one in further if one is not None and id(one) not in seen), None)
    return cause


def printable(text: str) -> str:
    """Return the text with escapes in place of line ends, codes for terminals and characters that no file can hold."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
