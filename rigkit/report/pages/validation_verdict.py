"""The verdict of a validation in a few sentences, for the page and the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rigkit.report.tables import measured_words
from rigkit.validation.check import Check
from rigkit.validation.checks import ValidationReport
from rigkit.validation.crosscheck import CrossCheckReport

BY_OTHERS = "DISAGREES"
"""Marks the disagreement of an independent method."""
FINER = 4.0
"""If the measured sigma exceeds that of the reconstruction by this factor, the measurement limits the test."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FailedFact:
    """A fact that does not hold: `what` happened, the pair, the estimators (none: an independent method), and words."""

    what: str
    pair_id: str
    methods: tuple[str, ...]
    words: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidationVerdict:
    """The verdict of a validation: whether everything holds, a headline, a sentence on the limit of the measurements or
    "", the failed facts, and their probable causes."""

    passed: bool
    headline: str
    fineness: str
    failed: tuple[FailedFact, ...]
    causes: tuple[str, ...]

    @property
    def badge(self) -> str:
        """The verdict in a word or two."""
        if self.passed or not self.failed:
            return "all checks passed" if self.passed else "not complete"
        return "a cross-check disagrees" if all(f.what == BY_OTHERS for f in self.failed) else "a check failed"

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on failed facts, probable causes, disagreements of other methods, and limits of measurements."""

        def lines_of(facts: Sequence[FailedFact]) -> list[str]:
            return [f"{fact.what.lower()}: {fact.pair_id}: {fact.words}" for fact in facts]

        cause = "to look at" if self.passed else "probable cause"
        own, others = ([f for f in self.failed if (f.what == BY_OTHERS) == other] for other in (False, True))
        return (
            *lines_of(own),
            *(f"{cause}: {words}" for words in self.causes),
            *lines_of(others),
            *filter(None, [self.fineness]),
        )


def verdict_of(
    best: Sequence[ValidationReport],
    reports: Sequence[ValidationReport],
    compared: Sequence[CrossCheckReport] = (),
    causes: Sequence[str] = (),
    *,
    complete: bool = True,
) -> ValidationVerdict:
    """Return the verdict of a validation.

    Parameters
    ----------
    best : report of the shown estimator for each pair.
    reports : reports of all estimators.
    compared, causes : comparisons with independent methods; probable causes of failures.
    complete : whether every pair was reconstructed.
    """
    failed = failed_facts(reports, compared)
    return ValidationVerdict(
        passed=complete and not failed,
        headline=_headline(best),
        fineness=_fineness(best),
        failed=failed,
        causes=tuple(causes),
    )


def failed_facts(
    reports: Sequence[ValidationReport], compared: Sequence[CrossCheckReport] = ()
) -> tuple[FailedFact, ...]:
    """Return the failed and unchecked facts; a fact that several estimators share is listed once."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for report in reports:
        for c in report.checks:
            if not c.passed:
                found.setdefault(("FAILED", report.pair_id, _check_words(c)), []).append(report.affine_method)
        for words in report.unchecked:
            found.setdefault(("NOT CHECKED", report.pair_id, words), []).append(report.affine_method)
    facts = [FailedFact(what=w, pair_id=p, methods=tuple(m), words=words) for (w, p, words), m in found.items()]
    for other in compared:
        for c in other.checks:
            if not c.passed:
                words = f"{c.name}: {c.ours:.4f} {c.unit}, {c.how} {c.measured:.4f}, {c.k:.1f} combined sigmas apart"
                facts.append(FailedFact(what=BY_OTHERS, pair_id=other.pair_id, methods=(), words=words))
    return tuple(facts)


def _check_words(c: Check) -> str:
    return (
        f"{c.name}: {c.ours:.3f} {c.unit}, measured {c.measured:g} ± {c.measured_sigma:g} ({c.how}), off "
        f"by {c.k:.1f} combined sigmas"
    )


def _headline(best: Sequence[ValidationReport]) -> str:
    """Return how many of the measured facts hold, and the largest differences, in words."""
    checks = [(report.pair_id, c) for report in best for c in report.checks]
    unchecked = sum(len(report.unchecked) for report in best)
    held = [(pair, c) for pair, c in checks if c.passed]
    pairs = f"of {len(best)} pairs" if len(best) > 1 else "of the pair"
    words = f"{len(held)} of {len(checks) + unchecked} measured or declared facts {pairs} are confirmed"
    parts = []
    for kinds, what, decimals in ((("baseline", "distance"), "lengths", 2), (("angle",), "angles", 3)):
        own = [(pair, c) for pair, c in held if c.kind in kinds]
        if own:
            pair, worst = max(own, key=lambda of: abs(of[1].difference))
            share = f" ({100.0 * abs(worst.difference) / worst.measured:.2g} %)" if what == "lengths" else ""
            parts.append(f"{what} to {abs(worst.difference):.{decimals}f} {worst.unit}{share}, the worst in '{pair}'")
    return words + (": " + "; ".join(parts) if parts else "") + "."


def _fineness(best: Sequence[ValidationReport]) -> str:
    """Return a sentence if a measurement is too coarse to test the reconstruction; else ""."""
    lengths = [c for report in best for c in report.checks if c.kind in ("baseline", "distance") and c.passed]
    coarse = [c for c in lengths if c.measured_sigma > FINER * c.our_sigma]
    if not coarse:
        return ""
    c = max(coarse, key=lambda c: c.measured_sigma / max(c.our_sigma, 1e-9))
    ours = measured_words(c.ours, c.our_sigma, 2)
    return (
        f"The measurement (±{c.measured_sigma:g} mm) is less precise than the reconstruction ({ours} mm): errors below "
        "it cannot be detected."
    )
