"""A synthetic study as a page: which statements hold, the box plots, the tables."""

from __future__ import annotations

from collections.abc import Mapping

from rigkit.report.facts_page import build_facts_page
from rigkit.report.page_facts import PageFacts
from rigkit.report.study_figure import study_figure
from rigkit.report.study_tables import study_setup, study_tables
from rigkit.study.table import StudyTable


def study_page(found: StudyTable, provenance: Mapping[str, str]) -> str:
    """Return the study as an HTML page that needs no other file."""
    held = sum(verdict.holds for verdict in found.verdicts)
    count = len(found.verdicts)
    headline = f"{held} of {count} statements of this study hold" if count else "A study without statements to judge"
    return build_facts_page(
        f"rigkit study: {found.study.title}",
        PageFacts(
            headline=headline,
            badge="" if not count else "all hold" if held == count else "not all hold",
            passed=held == count if count else None,
            sentences=(
                *(f"{v.text}: {v.words}." for v in found.verdicts if not v.holds),
                study_setup(found.study).capitalize() + ".",
            ),
            tables=tuple(study_tables(found)),
        ),
        provenance,
        pictures=[(f"Normal errors: {found.study.title}", lambda: study_figure(found))],
    )
