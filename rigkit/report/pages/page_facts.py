"""The facts of a page without its pictures, for both the page and `--json`, and the common page layout."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rigkit.core.tables import Table
from rigkit.report.pictures.figures import in_dark_colours
from rigkit.report.render import data_uri, drawing, render, table_context
from rigkit.report.tables import tables_to_list

PAGE_SCHEMA = "rigkit.page/1"
BADGES = {None: "look", True: "pass", False: "fail"}


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PageFacts:
    """The facts of a page.

    Attributes
    ----------
    headline : the result in the user's units.
    badge : the verdict in a word or two; "": none.
    passed : whether the verdict is good; None: neither good nor bad.
    sentences : sentences below the headline.
    basis : data that the result is based on.
    tables : all tables.
    parts : facts of the page's cameras or pairs by name.
    """

    headline: str
    badge: str = ""
    passed: bool | None = None
    sentences: tuple[str, ...] = ()
    basis: str = ""
    tables: tuple[Table, ...] = ()
    parts: Mapping[str, PageFacts] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the facts as a document of schema rigkit.page/1."""
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
    """Return badge, colour and headline for the template."""
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
    """Return the self-contained page of `facts`.

    Parameters
    ----------
    title, facts, provenance : content of every page.
    links : (words, page) below the sentences.
    pictures : (alternative text, function that draws a PNG), drawn for light and for dark screens.
    drawings : (heading, SVG of rigkit).
    signed : whether the page ends in lines for date, name and signature.
    """
    return render(
        "facts.html",
        title=title,
        lead="",
        verdict_line=verdict_line(facts),
        sentences=facts.sentences,
        links=links,
        pictures=[
            (words, *(data_uri("image/png", data) for data in (draw(), in_dark_colours(draw))))
            for words, draw in pictures
        ],
        drawings=[(name, drawing(svg)) for name, svg in drawings],
        tables=[table_context(table) for table in facts.tables],
        signed=signed,
        provenance=provenance,
    )
