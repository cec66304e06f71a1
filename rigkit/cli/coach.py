"""`rigkit coach`: guide a capture live on a local web page: what to take next, and when there is enough.

examples:
  rigkit coach capture --board 9x6x25                     a camera of the browser
  rigkit coach capture --board 9x6x25 --device 0 --goal 0.05
  rigkit coach capture --board 9x6x25 --watch incoming    images that another program writes
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.aim_arguments import add_board_argument, add_reach_arguments, length_of
from rigkit.cli.console import add_options, options_of, progress_on_stderr
from rigkit.coach.guide import GuideOptions
from rigkit.core.errors import ExitCode, InputError
from rigkit.core.reach import Reach
from rigkit.workflows.options.coach import CoachOptions

MAX_CAMERAS = 8
"""Of a browser: more streams than this no machine carries."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="folder of the session: a new one, or one to continue"
    )
    add_board_argument(parser, "such as 9x6x25 (repeatable)", required=True)
    add_options(parser, GuideOptions, hfov_deg="--lens DEG", goal_px="--goal PX")
    add_reach_arguments(parser)
    parser.add_argument("--length", type=float, metavar="MM", help="also reach --goal-mm for a length of MM")
    parser.add_argument("--distance", type=float, metavar="MM", help="at this distance")
    add_options(parser, GuideOptions, goal_mm="MM")
    source = parser.add_mutually_exclusive_group()
    add_options(source, CoachOptions, cameras="N", watch="FOLDER", video="FILE", device="N")
    add_options(parser, CoachOptions, lan="", port="")


def run(args: argparse.Namespace) -> int:
    from rigkit.io.boards.board_words import board_of_words
    from rigkit.workflows.capture.coach import run_coach

    if not 0.0 < args.goal_px < float("inf"):
        raise InputError(f"--goal {args.goal_px}: it must be positive")
    given = [args.length, args.distance, args.goal_mm]
    if any(value is not None for value in given) and None in given:
        raise InputError("coach: --length, --distance and --goal-mm belong together")
    if not 1 <= args.cameras <= MAX_CAMERAS:
        raise InputError(f"--cameras {args.cameras}: 1 to {MAX_CAMERAS}")
    if args.goal_mm is not None and not 0.0 < args.goal_mm < float("inf"):
        raise InputError(f"--goal-mm {args.goal_mm}: it must be positive")
    boards = tuple(board_of_words(words) for words in args.board)
    guide = options_of(GuideOptions, args, boards=boards, measured=None, reach=options_of(Reach, args))
    known = {"boards": tuple(args.board), "guide": guide, "length": length_of(args, "coach")}
    options = options_of(CoachOptions, args, **known)
    run_coach(options, lambda words: print(words, flush=True), progress_on_stderr())
    return ExitCode.WELL
