"""`rigkit coach FOLDER --board 9x6x25`: a local page that says what to shoot next, takes it, and says when to stop."""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.core.errors import ExitCode, InputError

__all__ = ["HELP", "add_arguments", "run"]

HELP = "a guided capture on a local page: says what to shoot next, takes it, stops when it is enough"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of the session: new, or one to go on with")
    parser.add_argument(
        "--board", action="append", required=True, metavar="CxRxMM|BOARD.toml", help="such as 9x6x25 (repeatable)"
    )
    parser.add_argument("--lens", type=float, default=70.0, metavar="DEG", help="rough field of view (default: 70)")
    parser.add_argument("--goal", type=float, default=0.1, metavar="PX", help="rms error to reach (default: 0.1)")
    parser.add_argument("--near", type=float, default=0.0, metavar="MM", help="the board is not sharp nearer than this")
    parser.add_argument("--far", type=float, default=float("inf"), metavar="MM", help="nor held farther than this")
    parser.add_argument("--field", type=float, metavar="DEG", help="the lens sees no more than this full angle")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--watch", type=Path, metavar="FOLDER", help="pictures appear in this folder")
    source.add_argument("--video", type=Path, metavar="FILE", help="frames of a video")
    source.add_argument("--device", type=int, metavar="N", help="camera N of this machine; default: the browser's")
    parser.add_argument("--port", type=int, default=8137, help="default: 8137")


def run(args: argparse.Namespace) -> int:
    from rigkit.coach.guide import GuideOptions
    from rigkit.planning.candidates import Reach
    from rigkit.workflows.coach import CoachOptions, run_coach
    from rigkit.workflows.folder_session import board_of_words

    if not 0.0 < args.goal < float("inf"):
        raise InputError(f"--goal {args.goal}: it must be positive")
    guide = GuideOptions(
        boards=tuple(board_of_words(words) for words in args.board),
        hfov_deg=args.lens,
        goal_px=args.goal,
        reach=Reach(nearest_mm=args.near, farthest_mm=args.far, field_deg=args.field),
    )
    options = CoachOptions(
        folder=args.folder,
        boards=tuple(args.board),
        guide=guide,
        watch=args.watch,
        video=args.video,
        device=args.device,
        port=args.port,
    )
    run_coach(options, lambda words: print(words, flush=True))
    return ExitCode.WELL
