"""`rigkit check`: test a calibration or rig with one or a few new images: it still holds, or what changed by how much.

Exit code 1 if it does not hold, 2 if it holds, but an image could not be read.

examples:
  rigkit check calibration.json fresh/*.png                 one to three images of the board
  rigkit check rig.json fresh/left fresh/right --board 9x6x25 --fix rig-fixed.json
  rigkit check rig.json left1.png right1.png --scene         any textured scene instead of a board
  rigkit check rig.json left right --scene --before old/left old/right      changes since the old images only
  rigkit check calibration.json fresh -r check.html --register calib/history/cam.jsonl --temperature 21.5
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.aim_arguments import add_board_argument, length_of
from rigkit.cli.console import (
    add_options,
    note,
    note_left_out,
    note_written,
    options_of,
    print_json,
    print_statement,
    progress_on_stderr,
    require_existing,
)
from rigkit.core.errors import ExitCode, InputError
from rigkit.workflows.options.boards import CheckOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("calibration", type=Path, metavar="CALIBRATION|RIG.json")
    parser.add_argument(
        "images",
        nargs="+",
        type=Path,
        metavar="IMAGE|FOLDER",
        help="new images; of a rig one folder per camera, one folder with all, or images",
    )
    add_board_argument(parser, "board in the images (default: those of the calibration)")
    add_options(parser, CheckOptions, scene="", before="IMAGE|FOLDER...")
    parser.add_argument("--length", type=float, metavar="MM", help="also state the error of a length of MM")
    parser.add_argument("--distance", type=float, metavar="MM", help="at this distance (with --length)")
    add_options(parser, CheckOptions, fix="FILE.json", report="-r [check.html]", history="--register FILE.jsonl")
    add_options(parser, CheckOptions, temperature_c="--temperature C", frames="", force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    require_existing(args.calibration, *args.images)
    from rigkit.io.boards.board_words import board_files, board_of_words
    from rigkit.io.disk.writing import ensure_writable
    from rigkit.report.pages.check_page import check_table, check_to_dict
    from rigkit.report.tables import tables_to_text
    from rigkit.workflows.checks.check import check_pictures

    length = length_of(args, "check")
    if args.temperature_c is not None and args.history is None:
        raise InputError("check: --temperature is only kept in a register; add --register FILE.jsonl")
    ensure_writable((args.fix, args.report), force=args.force, inputs=board_files(args.board))
    boards = tuple(board_of_words(words) for words in args.board)
    options = options_of(CheckOptions, args, boards=boards, length=length)
    done = check_pictures(args.calibration, args.images, options, progress=progress_on_stderr())
    check = done.check
    if args.json:
        left_out = {"left_out": [list(entry) for entry in done.left_out], "unreadable": list(done.unreadable)}
        print_json(check_to_dict(check) | left_out)
    else:
        print_statement(done.facts)
        if not (check.holds or check.unexplained):
            print(tables_to_text([check_table(check)]))
    note_left_out([f"{image}: {reason}" for image, reason in done.left_out])
    code = note_left_out(done.unreadable)
    note_written(done.written)
    if args.fix is not None and args.fix not in done.written:
        why = "the images were flipped" if check.flipped else "no change of camera or rig explains the images"
        note(f"{args.fix} not written: {'nothing changed' if check.holds else why}")
    return code if check.holds else ExitCode.CHECK_FAILED
