"""`rigkit board identify`: which board is it that images show?"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.core.patterns.circles import Circles


def identify(args: argparse.Namespace) -> int:
    """Print which board the images show, write its file if requested, and return the exit code."""
    from rigkit.cli.console import note, note_left_out, progress_on_stderr
    from rigkit.detection.duplicate_marks import DUPLICATES_REMEDY
    from rigkit.io.boards.board_file import board_text
    from rigkit.io.disk.writing import ensure_writable, write_atomic
    from rigkit.io.media.video import is_video, videos_inside
    from rigkit.workflows.detect import images_in
    from rigkit.workflows.inputs.identify_board import identify_board

    if args.square_mm is not None and not 0.0 < args.square_mm < float("inf"):
        raise InputError(f"board: --square-mm {args.square_mm:g} must be positive")
    path = None if args.output is None else args.output.with_suffix(".toml")
    if path is not None and args.square_mm is None:
        raise InputError("board identify: images cannot tell the scale; give --square-mm, the side of a square or tag")
    places = [place for path in args.images for place in videos_inside(Path(path))]
    images = [one for place in places for one in ([place] if is_video(place) else images_in([place]))]
    ensure_writable(path, force=args.force, inputs=images)
    found = identify_board(images, progress=progress_on_stderr())
    board = found.board
    print(f"{board.pattern.type}: {without_scale(board.describe())}")
    looked_at = len(found.looked_at)
    print(
        f"seen in {len(found.seen)} of {looked_at} images" + (f" (of {len(images)})" if looked_at < len(images) else "")
    )
    print(f"--board {found.words}   (replace MM by {board.pattern.size_meaning}, measured with a ruler)")
    if found.beside:
        seen = "" if board.identified else "   (as far as it is seen)"
        print(f"beside it: {', '.join(f'--board {words}' for words in found.beside)}{seen}")
    if found.elsewhere:
        words, others = found.elsewhere
        print(f"{len(others)} other images, such as '{others[0]}', show another board: --board {words}")
    if path is not None:
        text = board_text(board.with_squares(args.square_mm, args.square_mm), "as seen in images", path)
        write_atomic(path, text, force=args.force)
        print(path)
    if found.alike:
        seen = f"{len(found.alike)} of {len(found.looked_at)} images, such as '{found.alike[0]}'"
        note(f"two boards alike in {seen}: detect and calibrate find only one of them; {DUPLICATES_REMEDY}")
    if found.either_pattern:
        note(
            "the pattern of OpenCV before 4.6 and the one of today differ in one column, which no image shows "
            "clearly: if OpenCV made the board, set legacy_pattern by its version"
        )
    if isinstance(board.pattern, Circles) and board.pattern.stagger == "left":
        note(
            'stagger = "left": every second row begins half a step further left, as BoofCV prints them; if the rows of '
            "the print begin further right, as OpenCV's do, the images are mirrored"
        )
    return note_left_out(found.unreadable)


def without_scale(words: str) -> str:
    """Return the description of a board with squares of 1 mm, with the unknown scale in words."""
    return re.sub(r"([\d.]+) mm\b", r"about \1 of that", words.replace(" 1 x 1 mm", " of unknown size"))
