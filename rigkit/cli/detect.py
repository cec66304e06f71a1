"""`rigkit detect`: detect the corners of all boards in images.

examples:
  rigkit detect photos                                        chessboards of any size
  rigkit detect photos --board 9x6x25 -o corners.csv --overlay seen     to a file, with pictures of the corners
  rigkit detect film.mp4 --board board.toml --camera calibration.json -o corners.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.cli.aim_arguments import add_board_argument
from rigkit.cli.console import add_options, note_left_out, options_of, print_json, progress_on_stderr, require_existing
from rigkit.core.errors import printable
from rigkit.core.printing import counted
from rigkit.workflows.options.cameras import DetectOptions

if TYPE_CHECKING:
    from rigkit.core.detections import BoardDetection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", nargs="+", metavar="IMAGE|FOLDER|VIDEO", help="images, folders, videos, camera:0")
    add_board_argument(parser, "a board to look for, such as 9x6x25 (repeatable; default: chessboards of any size)")
    add_options(parser, DetectOptions, camera="CALIBRATION.json", output="-o CORNERS.csv", overlay="DIR")
    add_options(parser, DetectOptions, min_corners="N", jobs="-j N", force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    require_existing(*args.images, args.camera)
    from rigkit.workflows.detect import detect_in_images

    options = options_of(DetectOptions, args, boards=tuple(map(Path, args.board)))
    done = detect_in_images(args.images, options, progress=progress_on_stderr())
    code = note_left_out(done.failures.values())
    if args.json:
        print_json({image: [_summary(item) for item in items] for image, items in done.found.items()})
    else:
        for image, items in done.found.items():
            beside = f" ({done.doubtful[image]})" if image in done.doubtful else ""
            print(f"{printable(image)}: {', '.join(_words(item) for item in items) or 'no board'}{beside}")
        missing = sum(not items for items in done.found.values())
        shown = len(done.found) - missing
        total = len(done.found) + len(done.failures)
        left_out = f"; {len(done.failures)} cannot be used" if done.failures else ""
        print(f"{counted(sum(map(len, done.found.values())), 'board')} in {shown} of {total} images{left_out}")
    return code


def _words(found: BoardDetection) -> str:
    import numpy as np

    name = f"{found.board_id} " if found.board_id else ""
    sigma = float(np.median(found.sigma_px))
    return f"{name}{found.columns}x{found.rows} {len(found.grid)} corners ±{sigma:.3f} px"


def _summary(found: BoardDetection) -> dict[str, Any]:
    from rigkit.io.corners.corner_cache import detection_to_json

    known = detection_to_json(found)
    return {"board": known.pop("board_id"), **known}
