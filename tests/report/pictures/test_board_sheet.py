"""Sheets of boards to print: true to scale, right pattern, a paper that fits."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.circles import Circles
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3
from rigkit.report.pages.plan_page import printed_outlines
from rigkit.report.pictures.board_sheet import board_sheet, pdf_bytes, svg_text
from rigkit.workflows.capture.print_board import print_board
from rigkit.workflows.options.cameras import PrintOptions

POINTS_PER_MM = 72.0 / 25.4
PDF_ROUNDING_MM = 1e-4
"""The writer prints five decimals of a point."""


def test_squares_alternate_and_have_their_size() -> None:
    sheet = board_sheet(Board("b", 8, 5, 20.0, 21.0), "a4")
    squares = np.array(sheet.rectangles)
    assert len(squares) == (9 * 6) / 2
    assert np.allclose(squares[:, 2:], [20.0, 21.0])
    index = (squares[:, :2] - squares[:, :2].min(axis=0)) / [20.0, 21.0]
    assert np.allclose(index, np.round(index))
    assert (np.round(index).astype(int).sum(axis=1) % 2 == 0).all()
    assert squares[:, 0].min() >= 0.0
    assert (squares[:, 0] + squares[:, 2]).max() <= sheet.width_mm


@pytest.mark.parametrize(
    ("board", "count"), [(Board("b", 4, 3, 20.0, 20.0), 10), (Board("c", 4, 3, 20.0, 20.0, pattern=Circles()), 12)]
)
def test_a_view_to_take_shows_what_is_printed(board: Board, count: int) -> None:
    camera = Pinhole((640, 480), np.array([500.0, 500.0, 319.5, 239.5]))
    outlines = printed_outlines(camera, board, Rigid3(np.eye(3), [-30.0, -20.0, 400.0]))
    assert len(outlines) == count
    middles = np.array([outline.mean(axis=0) for outline in outlines])
    # From one to the next of its kind: a square, or two of a chessboard's, of 25 px.
    apart = np.linalg.norm(middles[:, None] - middles, axis=2)[np.triu_indices(count, 1)]
    assert apart.min() == pytest.approx(25.0 if board.pattern.type == "circles" else 25.0 * np.sqrt(2.0), rel=1e-6)


def test_pdf_is_true_to_scale() -> None:
    sheet = board_sheet(Board("b", 8, 5, 20.0, 20.0), "a4")
    data = pdf_bytes(sheet)
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data)
    assert box is not None
    assert float(box[1]) / POINTS_PER_MM == pytest.approx(297.0, abs=PDF_ROUNDING_MM)
    stream = re.search(rb"stream\n(.*)\nendstream", data, re.DOTALL)
    assert stream is not None
    drawn = re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re f", zlib.decompress(stream[1]))
    mm = np.array(drawn, dtype=float) / POINTS_PER_MM
    assert len(mm) == len(sheet.rectangles)
    assert np.abs(mm[:, 2:] - 20.0).max() < PDF_ROUNDING_MM
    expected = np.array(sheet.rectangles)
    assert np.abs(mm[:, 0] - expected[:, 0]).max() < PDF_ROUNDING_MM
    # PDF's y axis points up.
    assert np.abs(sheet.height_mm - mm[:, 1] - mm[:, 3] - expected[:, 1]).max() < PDF_ROUNDING_MM
    # The cross-reference table points at the objects.
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", data), start=1):
        assert data[int(offset) :].startswith(b"%d 0 obj" % number)


def test_svg_says_its_size_in_mm() -> None:
    sheet = board_sheet(Board("b", 5, 8, 20.0, 20.0), "a4")
    root = ElementTree.fromstring(svg_text(sheet))
    assert (root.get("width"), root.get("height")) == ("210mm", "297mm")
    assert root.get("viewBox") == "0 0 210 297"
    black = [r for r in root.iter("{http://www.w3.org/2000/svg}rect") if r.get("fill") == "black"]
    assert len(black) == len(sheet.rectangles)


def test_a_board_too_large_for_the_paper_names_a_paper_that_fits() -> None:
    with pytest.raises(InputError, match="use --paper a2, or squares of up to 26 mm"):
        board_sheet(Board("b", 8, 6, 50.0, 50.0), "a4")
    with pytest.raises(InputError, match="take squares of up to 26 mm"):
        board_sheet(Board("b", 30, 30, 50.0, 50.0), "a0")
    with pytest.raises(InputError, match="known: a4"):
        board_sheet(Board("b", 8, 6, 5.0, 5.0), "a7")


def test_tags_that_are_too_large_are_called_tags(tmp_path: Path) -> None:
    board = Board("b", 12, 12, 24.0, 24.0, pattern=AprilGrid(0.3))
    with pytest.raises(InputError, match=r"^'6 x 6 tags': .* every length 94 % of what it is, at most") as caught:
        print_board(board, PrintOptions(output=tmp_path / "b"))
    assert "12x12" not in str(caught.value)
    smaller = Board("b", 12, 12, 0.94 * 24.0, 0.94 * 24.0, pattern=AprilGrid(0.3))
    assert print_board(smaller, PrintOptions(output=tmp_path / "b", paper="A4"))


@pytest.mark.parametrize("rows", [6, 12])
def test_what_is_written_below_a_board_ends_before_the_page_does(rows: int) -> None:
    pattern = AprilGrid(0.3, corner_squares=False)
    sheet = board_sheet(Board("grid", 8, rows, 20.0, 20.0, pattern=pattern), "a4")
    level = [(x, text) for x, _, turned, text in sheet.texts if turned == 0.0]
    assert any("measure it" in text for _, text in level)
    # Letters of 3 mm are half of that wide on average.
    assert all(x + 1.6 * len(text) <= sheet.width_mm for x, text in level)


@pytest.mark.parametrize(
    "board",
    [
        Board("c", 5, 4, 20.0, 20.0, pattern=Charuco("DICT_4X4_50", 15.0, inverted=True)),
        Board("g", 6, 4, 20.0, 20.0, pattern=AprilGrid(0.3, inverted=True)),
        Board("d", 5, 4, 20.0, 20.0, pattern=Circles(inverted=True)),
    ],
    ids=lambda board: board.pattern.type,
)
def test_an_inverted_board_is_printed_white_on_black(board: Board) -> None:
    sheet = board_sheet(board, "a4")
    assert sheet.ground is not None
    scale = 4.0
    page = np.full((round(scale * sheet.height_mm), round(scale * sheet.width_mm)), 220.0)
    y, x = (np.mgrid[: page.shape[0], : page.shape[1]] + 0.5) / scale
    for (left, top, width, height), level in [(sheet.ground, 20.0), *((part, 220.0) for part in sheet.rectangles)]:
        page[(x >= left) & (x < left + width) & (y >= top) & (y < top + height)] = level
    for a, b, radius in sheet.circles:
        page[np.hypot(x - a, y - b) < radius] = 220.0
    (found,) = detect_boards(cv2.GaussianBlur(page, (0, 0), 1.0).astype(np.uint8), [board])
    assert found.board_id == board.board_id and found.complete
    # The same shapes are in both files, white ones after the ground.
    fills = re.findall(r'fill="(black|white)"', svg_text(sheet))
    assert fills[:2] == ["white", "black"] and fills.count("black") == 1
    stream = re.search(rb"stream\n(.*)\nendstream", pdf_bytes(sheet), re.DOTALL)
    assert stream is not None and zlib.decompress(stream[1]).splitlines()[2] == b"1 g"
