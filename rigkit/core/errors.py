"""The errors that a person sees. Each message says what is wrong, where, and what to do about it."""

from __future__ import annotations

__all__ = ["CheckFailed", "DegenerateError", "InputError", "InstallationError", "RigkitError"]


class RigkitError(Exception):
    """Base of every error that rigkit raises on purpose; `exit_code` is what the command line returns for it."""

    exit_code: int = 2


class CheckFailed(RigkitError):
    """A measured check did not hold."""

    exit_code = 1


class InputError(RigkitError):
    """What was handed in cannot be used: a file, an option, an array."""

    exit_code = 2


class InstallationError(RigkitError):
    """A part of rigkit itself is missing or does not fit: the message says what to type."""

    exit_code = 2


class DegenerateError(RigkitError):
    """The geometry does not determine what was asked for (no baseline, one flat board only, parallel directions)."""

    exit_code = 3
