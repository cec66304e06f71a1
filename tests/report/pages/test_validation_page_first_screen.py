"""The first screen of a page: the verdict in the user's units, what failed and why, and the remedy."""

from __future__ import annotations

import re

from helpers.pages import page_of, reported

from rigkit.report.pages.validation_verdict import BY_OTHERS, FailedFact, ValidationVerdict


def words_of(page: str) -> str:
    """The words before the first heading of a section."""
    return re.sub(r"\s+", " ", re.sub(r"<(script|style).*?</\1>|<[^>]+>", " ", page[: page.index("<h2>")], flags=re.S))


def test_a_check_that_failed_stands_first_with_its_cause() -> None:
    report = reported(88.0)
    first = words_of(page_of(report))
    assert "a check failed" in first and "3 of 4 measured or declared facts" in first
    found_words = first.index("angle plane1-plane2: 90.000 deg, measured 88 ± 0.3 (set square)")
    cause = first.index("88 was probably misread")
    assert found_words < cause
    assert "lengths to 0.50 mm" in first
    assert page_of(report).index("canvas") < page_of(report).index("<h2>")


def test_a_passed_verdict_is_in_the_users_units_with_the_accuracy_of_the_ruler() -> None:
    first = words_of(page_of(reported(90.0)))
    assert "all checks passed" in first and "4 of 4 measured or declared facts" in first
    assert "lengths to 0.50 mm" in first and "angles to 0.000 deg" in first
    assert "The measurement (±2 mm) is less precise" in first
    assert "probably" not in first


def test_a_verdict_says_whether_a_measurement_or_another_method_disagrees() -> None:
    by_others = FailedFact(what=BY_OTHERS, pair_id="p", methods=(), words="")
    own = FailedFact(what="FAILED", pair_id="p", methods=("3SDIR",), words="")
    for failed, words in (((by_others,), "a cross-check disagrees"), ((own, by_others), "a check failed")):
        verdict = ValidationVerdict(passed=False, headline="", fineness="", failed=failed, causes=())
        assert verdict.badge == words
