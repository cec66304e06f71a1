"""Hostile names of pairs, cameras and boards cannot break a page, a Markdown table or a spreadsheet."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from helpers.reconstructions import make_reconstruction

from rigkit.core.tables import Cell, Column, Table
from rigkit.core.truth import MeasuredAngle, PairTruth
from rigkit.report.pages.validation_page import build_page, pair_section, summary_table
from rigkit.report.pages.validation_verdict import verdict_of
from rigkit.report.tables import tables_to_csv, tables_to_markdown, tables_to_text
from rigkit.validation.checks import validate

NAMES = ("<!--<script>", "</script><script>alert(1)</script>", '"><img src=x>', "a & b", "{{ 7 * 7 }}")


class Outline(HTMLParser):
    """Counts the elements of a page, and keeps its text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.count: dict[str, int] = {}
        self.words = ""
        self.comments = 0
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.count[tag] = self.count.get(tag, 0) + 1

    def handle_data(self, data: str) -> None:
        self.words += data

    def handle_comment(self, data: str) -> None:
        self.comments += 1


def page_of(name: str) -> str:
    made = make_reconstruction()
    boards = tuple(replace(board, board_id=f"board {k}") for k, board in enumerate(made.boards))
    ids = tuple(board.board_id for board in boards)
    reconstruction = replace(made, pair_id=name, boards=boards, cloud=replace(made.cloud, board_ids=ids))
    truth = PairTruth(angles=(MeasuredAngle(ids[0], ids[1], 90.0, 0.3, name),))
    report = validate(reconstruction, truth)
    section = pair_section(reconstruction, [report], [(name, "image/jpeg", b"x")])
    return build_page(name, name, verdict_of([report], [report]), [summary_table([report])], [section], {name: name})


@pytest.mark.parametrize("name", NAMES)
def test_a_page_has_the_same_elements_whatever_the_names(name: str) -> None:
    plain, named = Outline(page_of("plain")), Outline(page_of(name))
    assert named.count == plain.count
    assert plain.count["script"] == 5
    assert named.comments == plain.comments == 0
    assert named.words.count(name) >= 5
    # What opens a comment and a script inside a script would swallow the rest of the page.
    assert "<!--" not in page_of(name)


@pytest.mark.parametrize("name", ["=1+1", "+1+1", "-a", "@sum", "\t=1", "=cmd|' /C calc'!A0"])
def test_words_are_no_formulas_in_a_spreadsheet(name: str) -> None:
    table = Table("k", "title\nof two lines", (Column(name), Column("number")), ((Cell(name), Cell(-1.5)),))
    title, rest = tables_to_csv([table]).split("\n", 1)
    assert title == "# title of two lines"
    head, row = csv.reader(io.StringIO(rest))
    # A tab is shown as a space: no cell obeys a terminal's codes.
    assert head[0] == row[0] == "'" + name.replace("\t", " ")
    assert row[1] == "-1.5"


def test_numbers_in_words_stay_numbers_in_a_spreadsheet() -> None:
    table = Table("k", "t", (Column("value"),), ((Cell("-0.25"),), (Cell("+1e-3"),)))
    assert tables_to_csv([table]).splitlines()[2:] == ["-0.25", "+1e-3"]


def test_markdown_shows_names_as_they_are() -> None:
    table = Table("k", "<script>", (Column("a"),), ((Cell("<script>x</script> [a](b) *c* `d` | e\nf"),),))
    text = tables_to_markdown([table])
    assert text.splitlines()[0] == r"## \<script\>"
    assert text.splitlines()[4] == r"| \<script\>x\</script\> \[a\](b) \*c\* \`d\` \| e f |"


def test_a_terminal_gets_no_control_characters() -> None:
    table = Table("k", "t", (Column("a"),), ((Cell("x\x1b[31m\ny"),),))
    assert tables_to_text([table]).splitlines()[2:] == ["x [31m y"]
