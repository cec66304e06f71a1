"""What a person should know about a result: how grave it is, what is the matter, where, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How grave a finding is."""

    GOOD = "good"
    LOOK = "look"
    BAD = "bad"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that a person should know about a result.

    Attributes
    ----------
    severity : whether the result can be used (GOOD), deserves a look (LOOK) or must not be trusted (BAD).
    message : what is the matter and how one can tell, without a full stop.
    image : the image that it is about, if it is about one.
    remedy : what to do, if something can be done.

    >>> str(Finding.look("5 images only", "take at least 8"))
    'look: 5 images only; take at least 8'
    """

    severity: Severity
    message: str
    image: str | None = None
    remedy: str | None = None

    @classmethod
    def good(cls, message: str) -> Finding:
        return cls(severity=Severity.GOOD, message=message)

    @classmethod
    def look(cls, message: str, remedy: str | None = None, image: str | None = None) -> Finding:
        return cls(severity=Severity.LOOK, message=message, image=image, remedy=remedy)

    @classmethod
    def bad(cls, message: str, remedy: str | None = None) -> Finding:
        return cls(severity=Severity.BAD, message=message, remedy=remedy)

    def __str__(self) -> str:
        return f"{self.severity}: {self.text}"

    @property
    def text(self) -> str:
        """The message and the remedy, without the severity."""
        return self.message if self.remedy is None else f"{self.message}; {self.remedy}"


def most_severe_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return `findings` in the order of their severity, the gravest first; equally grave ones keep theirs."""
    order = list(Severity)
    return tuple(sorted(findings, key=lambda finding: -order.index(finding.severity)))


def worst(findings: Iterable[Finding]) -> Severity:
    """Return the gravest severity among `findings`; GOOD where there are none."""
    order = list(Severity)
    return max((finding.severity for finding in findings), key=order.index, default=Severity.GOOD)
