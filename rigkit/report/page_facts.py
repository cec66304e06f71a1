"""What a page says, apart from its pictures: for the page and for programs alike, so that neither lacks what the other
has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rigkit.core.tables import Table
from rigkit.report.tables import tables_to_list

PAGE_SCHEMA = "rigkit.page/1"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PageFacts:
    """What a page says.

    Attributes
    ----------
    headline : the result in the user's units.
    badge : the verdict in a word or two; "": none.
    passed : its colour: good, bad, or (None) neither.
    sentences : below the headline.
    basis : what the result rests on.
    tables : every table.
    parts : the same of the cameras, or pairs, that the page is of, by name.
    """

    headline: str
    badge: str = ""
    passed: bool | None = None
    sentences: tuple[str, ...] = ()
    basis: str = ""
    tables: tuple[Table, ...] = ()
    parts: Mapping[str, PageFacts] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return it as a document of its own, rigkit.page/1."""
        return {"schema": PAGE_SCHEMA, **self._said(), "parts": {n: part._said() for n, part in self.parts.items()}}

    def _said(self) -> dict[str, Any]:
        return {
            "headline": self.headline,
            "badge": self.badge,
            "passed": self.passed,
            "sentences": list(self.sentences),
            "basis": self.basis,
            "tables": tables_to_list(self.tables),
        }
