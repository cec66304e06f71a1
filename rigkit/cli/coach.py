"""`rigkit coach`: guide a capture live on a local web page: what to take next, and when there is enough.

examples:
  rigkit coach capture --board 9x6x25                     a camera of the browser
  rigkit coach capture --board 9x6x25 --device 0 --goal 0.05
  rigkit coach capture --board 9x6x25 --watch incoming    images that another program writes
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.aim_arguments import add_board_argument, add_reach_arguments, length_of, reach_of
from rigkit.cli.console import add_options, options_of, progress_on_stderr
from rigkit.core.errors import ExitCode, InputError
from rigkit.workflows.options.coach import CoachOptions

MAX_CAMERAS = 8
"""Of a browser: more streams than this no machine carries."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="folder of the session: a new one, or one to continue"
    )
    add_board_argument(parser, "such as 9x6x25 (repeatable)", required=True)
    parser.add_argument(
        "--lens", type=float, default=70.0, metavar="DEG", help="approximate horizontal field of view (default: 70)"
    )
    parser.add_argument(
        "--goal", type=float, default=0.1, metavar="PX", help="projection uncertainty to reach, rms (default: 0.1)"
    )
    add_reach_arguments(parser)
    parser.add_argument("--length", type=float, metavar="MM", help="also reach --goal-mm for a length of MM")
    parser.add_argument("--distance", type=float, metavar="MM", help="at this distance")
    parser.add_argument("--goal-mm", type=float, metavar="MM", help="standard deviation to reach for that length")
    source = parser.add_mutually_exclusive_group()
    add_options(source, CoachOptions, cameras="N", watch="FOLDER", video="FILE", device="N")
    add_options(parser, CoachOptions, lan="", port="")


def run(args: argparse.Namespace) -> int:
    from rigkit.coach.guide import GuideOptions
    from rigkit.io.boards.board_words import board_of_words
    from rigkit.workflows.capture.coach import run_coach

    if not 0.0 < args.goal < float("inf"):
        raise InputError(f"--goal {args.goal}: it must be positive")
    given = [args.length, args.distance, args.goal_mm]
    if any(value is not None for value in given) and None in given:
        raise InputError("coach: --length, --distance and --goal-mm belong together")
    if not 1 <= args.cameras <= MAX_CAMERAS:
        raise InputError(f"--cameras {args.cameras}: 1 to {MAX_CAMERAS}")
    if args.goal_mm is not None and not 0.0 < args.goal_mm < float("inf"):
        raise InputError(f"--goal-mm {args.goal_mm}: it must be positive")
    guide = GuideOptions(
        boards=tuple(board_of_words(words) for words in args.board),
        hfov_deg=args.lens,
        goal_px=args.goal,
        goal_mm=args.goal_mm,
        reach=reach_of(args),
    )
    known = {"boards": tuple(args.board), "guide": guide, "length": length_of(args, "coach")}
    options = options_of(CoachOptions, args, **known)
    run_coach(options, lambda words: print(words, flush=True), progress_on_stderr())
    return ExitCode.WELL
