"""A board to print true to scale, with rulers to measure the print, as SVG and PDF.

The sheet is a list of shapes in mm with the origin at the top left.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.base import Ink

PAPERS = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
"""Width and height in mm in portrait format; wide boards use landscape."""

UNPRINTABLE_MM = 6.0
"""Margin that most printers cannot print."""

RULER_STRIP_MM = 14.0
"""Space below and to the right of the board for a ruler and its text."""

BLACK_MARGIN = 0.5
"""Width, in squares or tags, of the black around inverted squares and tags: outer squares have two sides then."""

RULER_STEP_MM = 10.0
TEXT_MM = 3.0
POINTS_PER_MM = 72.0 / 25.4


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintedSheet:
    """Shapes in mm: rectangles (x, y, width, height) and circles (x, y, radius), white on the black rectangle `ground`
    if there is one, else black; lines (x1, y1, x2, y2) and texts (x, y, degrees, text)."""

    width_mm: float
    height_mm: float
    title: str
    rectangles: tuple[tuple[float, float, float, float], ...]
    circles: tuple[tuple[float, float, float], ...]
    ground: tuple[float, float, float, float] | None
    lines: tuple[tuple[float, float, float, float], ...]
    texts: tuple[tuple[float, float, float, str], ...]
    ruler_x_mm: float
    ruler_y_mm: float


def board_sheet(board: Board, paper: str) -> PrintedSheet:
    """Return the layout of the board and two rulers on a sheet of `paper`.

    The top-left square of a chessboard is black. A white margin around the pattern is left for detectors.

    Raises InputError for an unknown paper, or one that is too small; the message names a paper that fits.
    """
    size = _sheet_size(board, paper.lower())
    low, high = _printed_mm(board)
    w, h = high - low
    x0 = (size[0] - RULER_STRIP_MM - w) / 2.0
    y0 = (size[1] - RULER_STRIP_MM - h) / 2.0
    # Rows and columns of each marker's modules overlap, so that no hairline shows between adjacent ones.
    inks = [board.ink(upright=upright) for upright in (False, True)]
    shapes = np.concatenate([black_squares(board, inks[0]), *(ink.rectangles for ink in inks)])
    shapes[:, :2] += np.array([x0, y0]) - low
    circles = inks[0].circles + np.array([x0 - low[0], y0 - low[1], 0.0])
    rectangles = [(x, y, width, height) for x, y, width, height in shapes.tolist()]
    ruler_x = RULER_STEP_MM * np.floor(w / RULER_STEP_MM)
    ruler_y = RULER_STEP_MM * np.floor(h / RULER_STEP_MM)
    bottom = size[1] - UNPRINTABLE_MM - 7.0
    right = size[0] - UNPRINTABLE_MM - 7.0
    lines = [(x0, bottom, x0 + ruler_x, bottom), (right, y0, right, y0 + ruler_y)]
    lines += [(x0 + t, bottom, x0 + t, bottom - _tick(t)) for t in np.arange(0.0, ruler_x + 1.0, RULER_STEP_MM)]
    lines += [(right, y0 + t, right - _tick(t), y0 + t) for t in np.arange(0.0, ruler_y + 1.0, RULER_STEP_MM)]
    name = board.describe()
    texts = (
        (x0, bottom + 3.5, 0.0, f"Print at 100 %. This ruler should be {ruler_x:g} mm; measure it."),
        # On a separate line from the left edge: names may be nearly as long as a page is wide.
        (UNPRINTABLE_MM, bottom + 6.9, 0.0, f"rigkit: {name}"),
        (right + 2.0, y0, 90.0, f"This ruler should be {ruler_y:g} mm."),
    )
    return PrintedSheet(
        width_mm=size[0],
        height_mm=size[1],
        title=name,
        rectangles=tuple(rectangles),
        circles=tuple((x, y, radius) for x, y, radius in circles.tolist()),
        ground=(float(x0), float(y0), float(w), float(h)) if inks[0].inverted else None,
        lines=tuple(lines),
        texts=texts,
        ruler_x_mm=float(ruler_x),
        ruler_y_mm=float(ruler_y),
    )


def black_squares(board: Board, ink: Ink) -> FloatArray:
    """Return the black squares of a board, as rectangles (M, 4) of `Ink`; (0, 4) for boards without squares."""
    if ink.first_black is None:
        return np.zeros((0, 4))
    row, column = np.mgrid[: board.rows + 1, : board.columns + 1]
    place = np.argwhere((row + column) % 2 == int(not ink.first_black))[:, ::-1] - 1.0
    return np.concatenate([place * board.squares_mm, np.tile(board.squares_mm, (len(place), 1))], axis=1)


def svg_text(sheet: PrintedSheet) -> str:
    """Return the sheet as SVG with its size in mm."""
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{sheet.width_mm:g}mm" height="{sheet.height_mm:g}mm" '
        f'viewBox="0 0 {sheet.width_mm:g} {sheet.height_mm:g}">',
        f"<title>{escape(sheet.title)}</title>",
        f'<rect width="{sheet.width_mm:g}" height="{sheet.height_mm:g}" fill="white"/>',
    ]
    # Squares that touch at a corner must not overlap: no stroke, crisp edges.
    colour = "white" if sheet.ground else "black"
    grounds = [(sheet.ground, "black")] if sheet.ground else []
    out += [
        f'<rect x="{x:.6g}" y="{y:.6g}" width="{w:.6g}" height="{h:.6g}" fill="{fill}"/>'
        for (x, y, w, h), fill in [*grounds, *((rectangle, colour) for rectangle in sheet.rectangles)]
    ]
    out += [f'<circle cx="{x:.6g}" cy="{y:.6g}" r="{r:.6g}" fill="{colour}"/>' for x, y, r in sheet.circles]
    out += [
        f'<line x1="{a:.6g}" y1="{b:.6g}" x2="{c:.6g}" y2="{d:.6g}" stroke="black" stroke-width="0.15"/>'
        for a, b, c, d in sheet.lines
    ]
    out += [
        f'<text transform="translate({x:.6g} {y:.6g}) rotate({turn:g})" font-family="Helvetica, Arial, sans-serif" '
        f'font-size="{TEXT_MM:g}">{escape(words)}</text>'
        for x, y, turn, words in sheet.texts
    ]
    return "\n".join([*out, "</svg>\n"])


def pdf_bytes(sheet: PrintedSheet) -> bytes:
    """Return the sheet as a one-page PDF of exactly its size."""

    def at(x: float, y: float) -> str:
        return f"{x * POINTS_PER_MM:.5f} {(sheet.height_mm - y) * POINTS_PER_MM:.5f}"

    def extent(w: float, h: float) -> str:
        return f"{w * POINTS_PER_MM:.5f} {h * POINTS_PER_MM:.5f}"

    drawing = ["0 g"]

    def filled(x: float, y: float, w: float, h: float) -> str:
        return f"{at(x, y + h)} {extent(w, h)} re f"

    drawing += [filled(*sheet.ground), "1 g"] if sheet.ground else []
    drawing += [filled(*rectangle) for rectangle in sheet.rectangles]
    drawing += [f"{_pdf_circle(x, sheet.height_mm - y, r)} f" for x, y, r in sheet.circles]
    drawing += ["0 g", f"{0.15 * POINTS_PER_MM:.4f} w"]
    drawing += [f"{at(a, b)} m {at(c, d)} l S" for a, b, c, d in sheet.lines]
    for x, y, turn, words in sheet.texts:
        c, s = np.cos(np.deg2rad(-turn)), np.sin(np.deg2rad(-turn))
        safe = words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        matrix = f"{c:.6f} {s:.6f} {-s:.6f} {c:.6f} {at(x, y)}"
        drawing.append(f"BT /F1 {TEXT_MM * POINTS_PER_MM:.4f} Tf {matrix} Tm ({safe}) Tj ET")
    stream = zlib.compress("\n".join(drawing).encode("latin-1", "replace"))
    box = f"[0 0 {extent(sheet.width_mm, sheet.height_mm)}]"
    # PrintScaling None asks the viewer not to fit the page to the paper.
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
        f"/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(stream)} /Filter /FlateDecode >>\nstream\n".encode() + stream + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    offsets = []
    for number, body in enumerate(objects, start=1):
        offsets.append(len(out))
        out += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    start = len(out)
    out += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    out += b"".join(f"{offset:010d} 00000 n \n".encode() for offset in offsets)
    out += f"trailer << /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n".encode()
    return bytes(out)


def _pdf_circle(x: float, y: float, radius: float) -> str:
    """Return the path of a circle as four Bezier curves, with an error of at most 0.03 % of the radius."""
    arm = 4.0 / 3.0 * (np.sqrt(2.0) - 1.0)
    turns = [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 0)]
    path = [(x + radius, y)]
    for (a, b), (c, d) in pairwise(turns):
        path += [(x + radius * (a + arm * c), y + radius * (b + arm * d))]
        path += [(x + radius * (c + arm * a), y + radius * (d + arm * b)), (x + radius * c, y + radius * d)]
    words = [f"{u * POINTS_PER_MM:.5f} {v * POINTS_PER_MM:.5f}" for u, v in path]
    return f"{words[0]} m " + " ".join(f"{' '.join(words[k : k + 3])} c" for k in range(1, len(words), 3))


def _sheet_size(board: Board, paper: str) -> tuple[float, float]:
    if paper not in PAPERS:
        raise InputError(f"paper '{paper}' is unknown; known: {', '.join(PAPERS)}")
    low, high = _printed_mm(board)
    width, height = high - low + 2.0 * UNPRINTABLE_MM + RULER_STRIP_MM
    landscape = width > height

    def fits(size: tuple[float, float]) -> tuple[float, float] | None:
        turned = (max(size), min(size)) if landscape else (min(size), max(size))
        return turned if turned[0] >= width and turned[1] >= height else None

    size = fits(PAPERS[paper])
    if size is None:
        larger = [name for name, candidate in PAPERS.items() if fits(candidate)]
        advice = f"use --paper {larger[0]}, or" if larger else "no known paper is large enough; take"
        edge = 2.0 * UNPRINTABLE_MM + RULER_STRIP_MM
        part = float(((np.sort(PAPERS[paper]) - edge) / (np.sort((width, height)) - edge)).min())
        largest = np.floor(part * max(board.squares_mm))
        smaller = "fewer of them"
        if board.pattern.size_word == "square" and largest >= 1.0:
            smaller = f"squares of up to {largest:.0f} mm"
        elif part > 0.0:
            smaller = f"every length {np.floor(100.0 * part):.0f} % of what it is, at most"
        raise InputError(
            f"a board of {width:.0f} x {height:.0f} mm (with margins and rulers) does not fit on {paper}: "
            f"{advice} {smaller}"
        )
    return size


def _printed_mm(board: Board) -> tuple[FloatArray, FloatArray]:
    """Return the printed area's lower and upper (x, y): of inverted boards with the black margin that detectors need,
    which paper is for others, and which the outline of circles has."""
    outline, ink = board.pattern.outline(*board.size), board.ink()
    margin = BLACK_MARGIN if ink.inverted and not len(ink.circles) else 0.0
    return (outline[0] - margin) * board.squares_mm, (outline[1] + margin) * board.squares_mm


def _tick(at_mm: float) -> float:
    return 3.0 if round(at_mm) % 50 == 0 else 1.8
