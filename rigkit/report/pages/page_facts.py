"""What a page says, apart from its pictures: for the page and for programs alike, so that neither lacks what the other
has; and the page of such facts in the one look of all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rigkit.core.tables import Table
from rigkit.report.pictures.figures import drawn_dark
from rigkit.report.render import data_uri, drawing, render, shown_table
from rigkit.report.tables import tables_to_list

PAGE_SCHEMA = "rigkit.page/1"
BADGES = {None: "look", True: "pass", False: "fail"}


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
        return {
            "schema": PAGE_SCHEMA,
            **self._summary(),
            "parts": {n: part._summary() for n, part in self.parts.items()},
        }

    def _summary(self) -> dict[str, Any]:
        return {
            "headline": self.headline,
            "badge": self.badge,
            "passed": self.passed,
            "sentences": list(self.sentences),
            "basis": self.basis,
            "tables": tables_to_list(self.tables),
        }


def verdict_line(facts: PageFacts) -> dict[str, str]:
    """Return the verdict that stands first: in a word or two, and the result in the user's units."""
    return {"words": facts.badge, "colour": BADGES[facts.passed], "headline": facts.headline}


def build_facts_page(
    title: str,
    facts: PageFacts,
    provenance: Mapping[str, str],
    *,
    links: Sequence[tuple[str, str]] = (),
    pictures: Sequence[tuple[str, Callable[[], bytes]]] = (),
    drawings: Sequence[tuple[str, str]] = (),
    signed: bool = False,
) -> str:
    """Return the page as text; everything it needs is inside it.

    Parameters
    ----------
    title, facts, provenance : what every page has.
    links : (words, page) below the sentences.
    pictures : (words for those who cannot see them, what draws a figure as PNG), drawn for light and for dark screens.
    drawings : (heading, SVG of rigkit itself).
    signed : whether it ends in lines for date, name and signature.
    """
    return render(
        "facts.html",
        title=title,
        lead="",
        verdict_line=verdict_line(facts),
        sentences=facts.sentences,
        links=links,
        pictures=[
            (words, *(data_uri("image/png", data) for data in (draw(), drawn_dark(draw)))) for words, draw in pictures
        ],
        drawings=[(name, drawing(svg)) for name, svg in drawings],
        tables=[shown_table(table) for table in facts.tables],
        signed=signed,
        provenance=provenance,
    )
