"""What stands first on a page: the verdict in the user's units, what failed and why, and what to do."""

from __future__ import annotations

import re

from helpers.reconstructions import make_reconstruction

from rigkit.core.truth import MeasuredAngle, MeasuredLength, PairTruth
from rigkit.report.pages.page import build_page
from rigkit.report.pages.validation_page import pair_section, summary_table
from rigkit.report.pages.validation_verdict import verdict_of
from rigkit.validation.checks import ValidationReport, validate
from rigkit.validation.diagnose import diagnose


def reported(stated_deg: float) -> ValidationReport:
    made = make_reconstruction(baseline_sigma_mm=0.1)
    angles = tuple(
        MeasuredAngle(a, b, stated_deg if (a, b) == ("plane1", "plane2") else 90.0, 0.3, "set square")
        for a, b in (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))
    )
    return validate(made, PairTruth(MeasuredLength(made.baseline_mm + 0.5, 2.0, "steel rule"), angles))


def words_of(page: str) -> str:
    """The words before the first heading of a section."""
    return re.sub(r"\s+", " ", re.sub(r"<(script|style).*?</\1>|<[^>]+>", " ", page[: page.index("<h2>")], flags=re.S))


def page_of(report: ValidationReport) -> str:
    verdict = verdict_of([report], [report], causes=diagnose([report]))
    section = pair_section(make_reconstruction(), [report], [])
    return build_page("title", "lead", verdict, [summary_table([report])], [section], {"rigkit": "x"})


def test_a_check_that_failed_stands_first_with_its_cause() -> None:
    report = reported(88.0)
    first = words_of(page_of(report))
    assert "a check failed" in first and "3 of 4 facts" in first
    found_words = first.index("angle plane1-plane2: 90.000 deg, measured 88 ± 0.3 (set square)")
    cause = first.index("88 was probably misread")
    assert found_words < cause
    assert "lengths to 0.50 mm" in first
    assert page_of(report).index("canvas") < page_of(report).index("<h2>")


def test_a_passed_verdict_is_in_the_users_units_with_the_accuracy_of_the_ruler() -> None:
    first = words_of(page_of(reported(90.0)))
    assert "all checks passed" in first and "4 of 4 facts" in first
    assert "lengths to 0.50 mm" in first and "angles to 0.000 deg" in first
    assert "The rule (±2 mm) is coarser" in first
    assert "probably" not in first
