"""Findings about a result: severity, message, image, remedy, and the reason for leaving images out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """Severity of a finding."""

    GOOD = "good"
    LOOK = "look"
    BAD = "bad"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One finding about a result.

    Attributes
    ----------
    severity : whether the result can be used (GOOD), should be looked at (LOOK) or must not be trusted (BAD).
    message : what is wrong and what shows it, without a full stop.
    image : the image concerned, if it is a single one.
    remedy : what to do, if anything.
    reason : why images are left out, as in `Calibration.dropped`, if that is what the finding says.
    contradiction : how images contradict each other, so that the sigmas are invalid, if that is what the finding says.

    >>> str(Finding.look("5 images only", "take at least 8"))
    'look: 5 images only; take at least 8'
    """

    severity: Severity
    message: str
    image: str | None = None
    remedy: str | None = None
    reason: str | None = None
    contradiction: str | None = None

    @classmethod
    def good(cls, message: str) -> Finding:
        return cls(severity=Severity.GOOD, message=message)

    @classmethod
    def look(cls, message: str, remedy: str | None = None, image: str | None = None) -> Finding:
        return cls(severity=Severity.LOOK, message=message, image=image, remedy=remedy)

    @classmethod
    def left_out(cls, what: str, reason: str, image: str | None = None) -> Finding:
        """Return a finding LOOK: `what` says which images are left out, `reason` why."""
        return cls(severity=Severity.LOOK, message=f"{what}: {reason}", image=image, reason=reason)

    @classmethod
    def bad(cls, message: str, remedy: str | None = None) -> Finding:
        return cls(severity=Severity.BAD, message=message, remedy=remedy)

    @classmethod
    def contradicting(cls, message: str, remedy: str) -> Finding:
        """Return a finding BAD: images contradict each other."""
        message = f"{message}; the stated uncertainties are invalid"
        return cls(severity=Severity.BAD, message=message, remedy=remedy, contradiction=message)

    def __str__(self) -> str:
        return f"{self.severity}: {self.text}"

    @property
    def text(self) -> str:
        """The message and the remedy, without the severity."""
        return self.message if self.remedy is None else f"{self.message}; {self.remedy}"


def most_severe_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return `findings` in the order of their severity, the worst first (stable)."""
    order = list(Severity)
    return tuple(sorted(findings, key=lambda finding: -order.index(finding.severity)))


def worst(findings: Iterable[Finding]) -> Severity:
    """Return the worst severity of `findings`; GOOD if there are none."""
    order = list(Severity)
    return max((finding.severity for finding in findings), key=order.index, default=Severity.GOOD)
