"""Contents of a page, parsed from its HTML and compared with those in `--json`."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from typing import Any

import pytest

from helpers.reconstructions import make_reconstruction
from rigkit.core.truth import MeasuredAngle, MeasuredLength, PairTruth
from rigkit.report.pages.validation_page import build_page, pair_section, summary_table
from rigkit.report.pages.validation_verdict import verdict_of
from rigkit.validation.checks import ValidationReport, validate
from rigkit.validation.diagnose import diagnose

SKIPPED = ("script", "style", "svg", "nav", "button")


class Page(HTMLParser):
    """The text of the first screens, and every table with its title."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.printed: list[str] = []
        self.tables: list[tuple[str, list[list[str]]]] = []
        self._open: list[str] = []
        self._first = 0
        self._title, self._words = "", ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("img", "br", "meta", "link", "input", "hr"):
            return
        self._open.append(tag)
        kind = dict(attrs).get("class") or ""
        self._first += self._first > 0 or (tag == "div" and kind.split()[:1] == ["first"])
        if tag in ("h2", "h3", "p", "td", "th"):
            self._words = ""
        if tag == "table":
            self.tables.append((self._title, []))
        if tag == "tr":
            self.tables[-1][1].append([])

    def handle_endtag(self, tag: str) -> None:
        while self._open and self._open.pop() != tag:
            self._first -= self._first > 0
        words = re.sub(r"\s+", " ", self._words).strip()
        if tag in ("h2", "h3"):
            self._title = words
        if tag in ("td", "th"):
            self.tables[-1][1][-1].append(words)
        if tag == "p" and self._first:
            self.printed.append(words)
        if tag in ("h3", "p", "td", "th"):
            self._words = ""
        self._first -= self._first > 0

    def handle_data(self, data: str) -> None:
        if not any(tag in self._open for tag in SKIPPED):
            self._words += data


def plain(words: str) -> str:
    """Return text without the punctuation between a badge and its sentence."""
    return re.sub(r"[\s:]+", " ", words).strip().lower()


def facts_of(page: dict[str, Any]) -> tuple[list[str], list[dict[str, Any]]]:
    """Return all sentences and all tables of a page's facts, those of its parts included."""
    parts = [page, *page["parts"].values()]
    words = [w for p in parts for w in (f"{p['badge']} {p['headline']}", *p["sentences"], p["basis"])]
    return words, [table for p in parts for table in p["tables"]]


def assert_all_is_in(html: str, page: dict[str, Any], also: tuple[str, ...] = ()) -> None:
    """Check that every sentence of the first screens, and every cell of every table, is in the JSON, numbers to the
    digits shown; `also`: beginnings of paragraphs that repeat figures or explain a term."""
    read = Page(html)
    words, tables = facts_of(page)
    known = [plain(w) for w in words]
    assert read.printed
    for printed in read.printed:
        if printed and not printed.startswith(also):
            assert any(plain(printed) in w or (w and w in plain(printed)) for w in known), printed
    shown = [(title, rows) for title, rows in read.tables if title != "Provenance"]
    assert shown
    cells = 0
    for title, (head, *rows) in shown:
        of_title = [table for table in tables if table["title"] == title]
        assert of_title, title
        assert any(_same(head, rows, table) for table in of_title), (title, rows[0], of_title[0]["rows"][0])
        cells += sum(map(len, rows))
    assert cells


def _same(head: list[str], rows: list[list[str]], table: dict[str, Any]) -> bool:
    if len(rows) != len(table["rows"]):
        return False
    # Columns that are empty in every row are in the JSON only.
    filled = [key for key in table["rows"][0] if any(row[key] not in (None, "") for row in table["rows"])]
    for row, everything in zip(rows, table["rows"], strict=True):
        known = {key: everything[key] for key in filled}
        # Pictures have a column of their own, first in the row.
        shown = row[len(row) - len(known) :]
        if not all(_as_shown(text, value) for text, value in zip(shown, known.values(), strict=True)):
            return False
    return len(head) == len(rows[0])


def _as_shown(text: str, cell: Any) -> bool:
    """Say whether a cell's text equals the value, to the digits shown."""
    value = cell["value"] if isinstance(cell, dict) else cell
    if isinstance(value, str):
        return text == re.sub(r"\s+", " ", value).strip()
    if value is None:
        return text == "–"
    first = text.split(" ")[0]
    digits = len(first.partition(".")[2])
    return float(first) == pytest.approx(value, abs=0.51 * 10.0**-digits)


def reported(stated_deg: float) -> ValidationReport:
    """Return the report on an exact reconstruction, whose first angle (90 degrees) was measured as `stated_deg`."""
    made = make_reconstruction(baseline_sigma_mm=0.1)
    angles = tuple(
        MeasuredAngle(a, b, stated_deg if (a, b) == ("plane1", "plane2") else 90.0, 0.3, "set square")
        for a, b in (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))
    )
    return validate(made, PairTruth(MeasuredLength(made.baseline_mm + 0.5, 2.0, "steel rule"), angles))


def page_of(report: ValidationReport) -> str:
    """Return the page of a report."""
    verdict = verdict_of([report], [report], causes=diagnose([report]))
    section = pair_section(make_reconstruction(), [report], [])
    return build_page("title", "lead", verdict, [summary_table([report])], [section], {"rigkit": "x"})
