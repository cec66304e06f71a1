"""A page of facts in the one look of all: the verdict and its sentences, pictures, drawings, tables, provenance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rigkit.report.figures import drawn_dark
from rigkit.report.page_facts import PageFacts
from rigkit.report.render import data_uri, drawing, render, shown_table

BADGES = {None: "look", True: "pass", False: "fail"}


def told(facts: PageFacts) -> dict[str, str]:
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
        told=told(facts),
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
