"""`rigkit calibrate SESSION.toml`: from a folder of images to calibration.json, or from several to rig.json."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

__all__ = ["HELP", "add_arguments", "run"]

HELP = "calibrate a camera, or several on one mount, from images of chessboards"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("session", type=Path, metavar="SESSION.toml", help="what to calibrate (rigkit.session/1)")
    parser.add_argument("-o", "--output", type=Path, help="default: calibration.json (rig.json) beside the session")
    parser.add_argument(
        "-r",
        "--report",
        nargs="?",
        const="",
        metavar="FILE.html",
        help="write a page to look at; without a name beside the output",
    )
    parser.add_argument(
        "--no-cache", action="store_true", help="find all corners anew, and keep none beside the session"
    )
    parser.add_argument("--force", action="store_true", help="replace existing results")
    parser.add_argument("--json", action="store_true", help="print the result for programs")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli import calibration_words, rig_words
    from rigkit.cli.console import note, print_json, progress_on_stderr
    from rigkit.core.errors import ExitCode
    from rigkit.io.rig_session import is_rig_session, load_rig_session
    from rigkit.io.session import load_session
    from rigkit.workflows.calibrate import CalibrateOptions, calibrate_session
    from rigkit.workflows.calibrate_rig import calibrate_rig_session
    from rigkit.workflows.corners import Cache

    def options(default: Path) -> CalibrateOptions:
        target = args.output or default
        page = None if args.report is None else Path(args.report) if args.report else target.with_suffix(".html")
        cache = Cache.OFF if args.no_cache else Cache.UPDATE
        return CalibrateOptions(output=target, report=page, force=args.force, cache=cache)

    started = time.monotonic()
    progress = progress_on_stderr()
    passed = True
    if is_rig_session(args.session):
        mount = load_rig_session(args.session)
        done = calibrate_rig_session(mount, options(mount.rig_path), progress=progress)
        written, unreadable, passed = done.written, done.unreadable, done.passed
        result = rig_words.summary(done.rig, done.checks) if args.json else rig_words.describe(done.rig, done.checks)
    else:
        session = load_session(args.session)
        one = calibrate_session(session, options(session.calibration_path), progress=progress)
        written, unreadable, words = one.written, one.unreadable, calibration_words
        result = words.summary(one.calibration) if args.json else words.describe(one.calibration)
    note(f"{', '.join(str(p) for p in written)} written, {time.monotonic() - started:.1f} s")
    print_json(result) if args.json else print(result)
    for reason in unreadable.values():
        note(f"left out: {reason}")
    if unreadable:
        return ExitCode.BAD_INPUT
    return ExitCode.WELL if passed else ExitCode.CHECK_FAILED
