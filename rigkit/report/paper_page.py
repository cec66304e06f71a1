"""The paper's comparison repeated on a data set, as a page: how many of its statements hold, and its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rigkit.core.tables import Table
from rigkit.report.page_facts import PageFacts, build_facts_page
from rigkit.validation.paper_claims import NOTHING_TO_COMPARE


def paper_page(name: str, images: str | None, tables: Sequence[Table], provenance: Mapping[str, str]) -> str:
    """Return the page of a data set; `images` says whether they are "real" or "rendered", None where nobody did."""
    claims = next(table for table in tables if table.key == "claims")
    judged = [row[1] for row in claims.rows if row[1].value != NOTHING_TO_COMPARE]
    held = sum(not cell.failed for cell in judged)
    sentences = (
        "The paper's own pipeline: chords to neighbouring corners, equal weights, its linear solvers with the formulas "
        "corrected, no refinement, planes by principal components.",
        f"The images are {images}." if images else "Nobody said whether the images are real or rendered.",
        "What the paper claims passes or fails no check of ours.",
    )
    facts = PageFacts(
        headline=f"{held} of {len(judged)} statements of the paper that this data set can test hold on it",
        sentences=sentences,
        tables=(claims, *(table for table in tables if table.key != "claims")),
    )
    return build_facts_page(f"rigkit, as the paper: {name}", facts, provenance)
