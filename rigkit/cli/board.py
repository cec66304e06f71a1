"""`rigkit board`: print a calibration target true to scale (PDF, SVG), then record the measured size of the print.

examples:
  rigkit board 9x6 --square-mm 25 -o board                      a chessboard of 9 by 6 inner corners
  rigkit board 8x11 --square-mm 15 --charuco DICT_5X5_100 -o charuco
  rigkit board aprilgrid:6x6x22,spacing=0.3 -o grid
  rigkit board board.toml --ruler-x-mm 250.4 --ruler-y-mm 170.2 --sigma-mm 0.2      as measured on the print
  rigkit board identify photos                                  which board the images show
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from rigkit.cli.board_identify import identify
from rigkit.cli.console import add_options, file_path
from rigkit.core.errors import InputError
from rigkit.workflows.options.cameras import PrintOptions

if TYPE_CHECKING:
    from rigkit.core.patterns.base import Pattern

MARKER_SHARE = 0.75
"""Side of a marker in squares: large enough to be read, with white left around it for the corners."""

BOARD_SIZE = re.compile(r"^(\d+)[xX](\d+)$")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "size",
        metavar="BOARD",
        help="9x6 (inner corners), aprilgrid:6x6x88,spacing=0.3 (tags, mm, keys of board files), a board file, or "
        "identify",
    )
    parser.add_argument(
        "images",
        nargs="*",
        type=Path,
        metavar="IMAGE|FOLDER",
        help="only with BOARD = identify: images or folders that show the board",
    )
    parser.add_argument("--square-mm", type=float, metavar="MM", help="side of a square (with COLUMNSxROWS)")
    add_options(parser, PrintOptions, paper="")
    parser.add_argument("-o", "--output", type=file_path, metavar="NAME", help="write NAME.pdf, NAME.svg and NAME.toml")
    add_options(parser, PrintOptions, force="")
    charuco = parser.add_argument_group("ChArUco", "markers in the white squares (with COLUMNSxROWS)")
    charuco.add_argument("--charuco", metavar="DICTIONARY", help="name of an OpenCV dictionary, such as DICT_5X5_100")
    charuco.add_argument("--marker-mm", type=float, metavar="MM", help="side of a marker (default: 3/4 of a square)")
    charuco.add_argument("--first-marker", type=int, default=0, metavar="N", help="id of the first marker (default: 0)")
    charuco.add_argument("--legacy", action="store_true", help="ChArUco pattern of OpenCV before 4.6")
    measured = parser.add_argument_group(
        "measured print",
        "printers scale: measure the two rulers on the sheet, and BOARD.toml gets the true square size",
    )
    measured.add_argument("--ruler-x-mm", type=float, metavar="MM", help="measured length of the lower ruler")
    measured.add_argument("--ruler-y-mm", type=float, metavar="MM", help="measured length of the right ruler")
    measured.add_argument("--sigma-mm", type=float, metavar="MM", help="standard deviation of these two readings")


def run(args: argparse.Namespace) -> int:
    from rigkit.core.boards import Board
    from rigkit.io.boards.board_words import board_in_words
    from rigkit.workflows.capture.print_board import print_board

    if args.size == "identify":
        return identify(args)
    if args.images:
        raise InputError(f"board: unexpected '{args.images[0]}'; only `rigkit board identify` takes images")
    size = BOARD_SIZE.match(args.size)
    measured = args.ruler_x_mm is not None or args.ruler_y_mm is not None
    board: Board | Path = board_in_words(args.size) or Path(args.size)
    if size is not None:
        if args.square_mm is None:
            raise InputError("board: --square-mm is missing; give the side of a square, such as --square-mm 30")
        if measured:
            raise InputError(
                "board: --ruler-x-mm and --ruler-y-mm update a board file; give BOARD.toml instead of a size"
            )
        board = Board("board", int(size[1]), int(size[2]), args.square_mm, args.square_mm, pattern=_pattern(args))
    elif args.charuco or args.marker_mm is not None or args.first_marker or args.legacy:
        raise InputError("board: --charuco goes with a size such as 9x6; a board file already states its markers")
    elif measured:
        return _store_measured(args)
    if args.output is None:
        raise InputError("board: -o is missing; give a name for the files, such as -o boards/a9x6_30")
    for path in print_board(board, PrintOptions(output=args.output, paper=args.paper, force=args.force)):
        print(path)
    return 0


def _store_measured(args: argparse.Namespace) -> int:
    from rigkit.workflows.capture.print_board import MeasuredPrint, store_measured_print

    if args.ruler_x_mm is None or args.ruler_y_mm is None:
        raise InputError(
            "board: give both --ruler-x-mm and --ruler-y-mm; printers scale the two directions differently"
        )
    read = MeasuredPrint(
        ruler_x_mm=args.ruler_x_mm, ruler_y_mm=args.ruler_y_mm, sigma_mm=args.sigma_mm, paper=args.paper
    )
    board = store_measured_print(args.size, read)
    print(f"{args.size}: squares {board.square_x_mm:.4f} x {board.square_y_mm:.4f} mm")
    return 0


def _pattern(args: argparse.Namespace) -> Pattern:
    from rigkit.core.patterns.charuco import Charuco
    from rigkit.core.patterns.chessboard import Chessboard

    if args.charuco is None:
        if args.marker_mm is not None or args.first_marker or args.legacy:
            raise InputError("board: markers need a dictionary; give it, such as --charuco DICT_5X5_100")
        return Chessboard()
    side = args.marker_mm if args.marker_mm is not None else MARKER_SHARE * args.square_mm
    return Charuco(args.charuco, side, args.first_marker, args.legacy)
