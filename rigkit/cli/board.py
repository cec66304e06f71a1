"""`rigkit board`: a chessboard or ChArUco board to print, true to scale, and the measured print back into its file."""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rigkit.core.errors import InputError

if TYPE_CHECKING:
    from rigkit.core.boards import Board, Markers

HELP = "a board to print, true to scale (PDF and SVG), and its measured size back into the board file"

MARKER_SHARE = 0.75
"""Side of a marker in squares: large enough to be read, with white left around it for the corners."""

MOST_UNEVEN = 1.05
"""Ratio of the stretches along and across a sheet: printers are a per cent apart, misread rulers more."""

BOARD_SIZE = re.compile(r"^(\d+)[xX](\d+)$")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("size", metavar="COLUMNSxROWS|BOARD.toml", help="inner corners, such as 9x6, or a board file")
    parser.add_argument("--square-mm", type=float, help="side of a square (with COLUMNSxROWS)")
    parser.add_argument("--paper", default="a4", help="a4 (default), a3, a2, a1, a0, letter or tabloid")
    parser.add_argument("-o", "--output", metavar="NAME", help="write NAME.pdf, NAME.svg and NAME.toml")
    parser.add_argument("--force", action="store_true", help="replace existing files")
    charuco = parser.add_argument_group("ChArUco", "markers in the white squares (with COLUMNSxROWS)")
    charuco.add_argument("--charuco", metavar="DICTIONARY", help="OpenCV's name, such as DICT_5X5_100")
    charuco.add_argument("--marker-mm", type=float, metavar="MM", help="side of a marker (three quarters of a square)")
    charuco.add_argument("--first-marker", type=int, default=0, metavar="N", help="number of the first marker (0)")
    charuco.add_argument("--legacy", action="store_true", help="pattern of OpenCV before 4.6")
    measured = parser.add_argument_group(
        "measured print", "what a rule shows on the print's two rulers; the board file gets the true square size"
    )
    measured.add_argument("--ruler-x-mm", type=float, metavar="MM", help="measured length of the lower ruler")
    measured.add_argument("--ruler-y-mm", type=float, metavar="MM", help="measured length of the right ruler")
    measured.add_argument("--sigma-mm", type=float, metavar="MM", help="how well you could read the rule")


def run(args: argparse.Namespace) -> int:
    from rigkit.core.boards import Board
    from rigkit.io.board_file import load_layout
    from rigkit.io.files import write_together
    from rigkit.report.board_sheet import board_sheet, pdf_bytes, svg_text

    size = BOARD_SIZE.match(args.size)
    if size is not None:
        if args.square_mm is None:
            raise InputError("board: --square-mm is missing; give the side of a square, such as --square-mm 30")
        if args.output is None:
            raise InputError("board: -o is missing; give a name for the files, such as -o boards/a9x6_30")
        board = Board("board", int(size[1]), int(size[2]), args.square_mm, args.square_mm, None, _markers(args))
    elif args.charuco or args.marker_mm is not None or args.first_marker or args.legacy:
        raise InputError("board: a board file says itself what markers it has; give a size such as 9x6 with --charuco")
    else:
        board = load_layout(args.size)
    sheet = board_sheet(board, args.paper)
    if args.ruler_x_mm is not None or args.ruler_y_mm is not None:
        return _store_measured(args, board, sheet.ruler_x_mm, sheet.ruler_y_mm)
    if args.output is None:
        raise InputError("board: -o is missing; give a name for the files, such as -o boards/a9x6_30")
    files: dict[str, str | bytes] = {
        f"{args.output}.pdf": pdf_bytes(sheet),
        f"{args.output}.svg": svg_text(sheet),
    }
    if size is not None:
        own = Path(f"{args.output}.toml")
        board = replace(board, board_id=own.stem)
        files[str(own)] = _board_toml(board, "nominal: print, measure both rulers, run rigkit board again", own)
    write_together({Path(path): data for path, data in files.items()}, force=args.force)
    for path in files:
        print(path)
    return 0


def _markers(args: argparse.Namespace) -> Markers | None:
    from rigkit.core.boards import Markers

    if args.charuco is None:
        if args.marker_mm is not None or args.first_marker or args.legacy:
            raise InputError("board: markers need a dictionary; give it, such as --charuco DICT_5X5_100")
        return None
    side = args.marker_mm if args.marker_mm is not None else MARKER_SHARE * args.square_mm
    return Markers(args.charuco, side, args.first_marker, args.legacy)


def _store_measured(args: argparse.Namespace, board: Board, ruler_x_mm: float, ruler_y_mm: float) -> int:
    from rigkit.io.board_file import with_squares
    from rigkit.io.files import write_atomic

    path = Path(args.size)
    if BOARD_SIZE.match(args.size):
        raise InputError("board: a measured print belongs to a board file; give BOARD.toml instead of a size")
    if args.ruler_x_mm is None or args.ruler_y_mm is None:
        raise InputError("board: measure both rulers; printers stretch the two directions differently")
    for measured, nominal in ((args.ruler_x_mm, ruler_x_mm), (args.ruler_y_mm, ruler_y_mm)):
        if not 0.5 < measured / nominal < 2.0:
            raise InputError(f"board: a ruler of {nominal:g} mm cannot measure {measured:g} mm; check the reading")
    stretch_x, stretch_y = args.ruler_x_mm / ruler_x_mm, args.ruler_y_mm / ruler_y_mm
    if not 1.0 / MOST_UNEVEN < stretch_x / stretch_y < MOST_UNEVEN:
        raise InputError(
            f"board: rulers of {ruler_x_mm:g} and {ruler_y_mm:g} mm that read {args.ruler_x_mm:g} and "
            f"{args.ruler_y_mm:g}: no printer stretches its two directions so differently; check the readings"
        )
    x, y = board.square_x_mm * stretch_x, board.square_y_mm * stretch_y
    sigma = None
    if args.sigma_mm is not None:
        sigma = args.sigma_mm * max(board.square_x_mm / ruler_x_mm, board.square_y_mm / ruler_y_mm)
    measured_board = replace(with_squares(board, x, y), square_sigma_mm=sigma)
    words = f"measured: rulers of {ruler_x_mm:g} and {ruler_y_mm:g} mm read {args.ruler_x_mm:g} and {args.ruler_y_mm:g}"
    write_atomic(path, _board_toml(measured_board, words, path, layout=board), force=True)
    print(f"{path}: squares {x:.4f} x {y:.4f} mm")
    return 0


def _board_toml(board: Board, comment: str, path: Path, *, layout: Board | None = None) -> str:
    """Return the board's file; with the `layout` that was printed where the squares are measured ones."""
    lines = [f"# {comment}", 'schema = "rigkit.board/1"', f"columns = {board.columns}", f"rows = {board.rows}"]
    if board.board_id != path.stem:
        lines.append(f"id = {json.dumps(board.board_id, ensure_ascii=False)}")
    lines += [f"square_x_mm = {board.square_x_mm:.6g}", f"square_y_mm = {board.square_y_mm:.6g}"]
    if layout is not None:
        lines += [f"printed_x_mm = {layout.square_x_mm:.6g}", f"printed_y_mm = {layout.square_y_mm:.6g}"]
    if board.square_sigma_mm is not None:
        lines.append(f"square_sigma_mm = {board.square_sigma_mm:.4g}")
    if board.markers is not None:
        lines += [f'dictionary = "{board.markers.dictionary}"', f"marker_mm = {board.markers.side_mm:.6g}"]
        lines.append(f"first_marker = {board.markers.first_id}")
        lines.append(f"legacy_pattern = {str(board.markers.legacy_pattern).lower()}")
    return "\n".join(lines) + "\n"
