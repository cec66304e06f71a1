"""The HTML report of a validation: a self-contained page with an interactive 3D view of every pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rigkit.core.tables import Table
from rigkit.report.pages.page_facts import PageFacts
from rigkit.report.pages.validation_verdict import ValidationVerdict
from rigkit.report.render import data_uri, render, table_context


@dataclass(frozen=True, eq=False, slots=True)
class PairSection:
    """One pair on the page."""

    pair_id: str
    lead: str
    tables: tuple[Table, ...]
    images: tuple[tuple[str, str, bytes], ...]
    """(caption, MIME type, bytes)."""
    scene: Mapping[str, Any] | None
    notes: tuple[str, ...] = ()


def build_page(
    title: str,
    lead: str,
    verdict: ValidationVerdict,
    summary: Sequence[Table],
    pairs: Sequence[PairSection],
    provenance: Mapping[str, str],
    remarks: Sequence[str] = (),
) -> str:
    """Return the self-contained page. Its first 3D view shows the first failed pair, or the first one; `remarks` are
    below the `summary` tables."""
    shown = [
        {
            "pair_id": pair.pair_id,
            "lead": pair.lead,
            "tables": [table_context(table) for table in pair.tables],
            "images": [(caption, data_uri(mime, data)) for caption, mime, data in pair.images],
            "scene": pair.scene,
            "notes": pair.notes,
        }
        for pair in pairs
    ]
    return render(
        "validation.html",
        title=title,
        lead=lead,
        passed=verdict.passed,
        verdict=_first_screen(verdict, pairs),
        remarks=remarks,
        summary=[table_context(table) for table in summary],
        pairs=shown,
        provenance=provenance,
    )


def validation_facts(
    lead: str,
    verdict: ValidationVerdict,
    summary: Sequence[Table],
    pairs: Sequence[PairSection],
    remarks: Sequence[str] = (),
) -> PageFacts:
    """Return the facts of a validation."""
    return PageFacts(
        headline=verdict.headline,
        badge=verdict.badge,
        passed=verdict.passed,
        sentences=(*verdict.sentences, *remarks),
        basis=lead,
        tables=tuple(summary),
        parts={p.pair_id: PageFacts(headline=p.lead, sentences=p.notes, tables=p.tables) for p in pairs},
    )


def _first_screen(verdict: ValidationVerdict, pairs: Sequence[PairSection]) -> dict[str, Any]:
    failed = {fact.pair_id for fact in verdict.failed}
    seen = [pair for pair in pairs if pair.scene is not None]
    shown = next((pair for pair in seen if pair.pair_id in failed), seen[0] if seen else None)
    return {
        "words": verdict.badge,
        "colour": "pass" if verdict.passed else "fail",
        "headline": verdict.headline,
        "fineness": verdict.fineness,
        "failed": verdict.failed,
        "causes": verdict.causes,
        "shown": "" if shown is None else shown.pair_id,
        "scene": None if shown is None else shown.scene,
    }
