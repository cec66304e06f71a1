"""`rigkit calibrate`: from a session, or folders of images, to calibration.json, or of several cameras to rig.json."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.core.errors import ExitCode, InputError, RigkitError
from rigkit.workflows.formats import FOREIGN_ENDINGS

if TYPE_CHECKING:
    from rigkit.workflows.calibrate import SessionCalibration
    from rigkit.workflows.calibrate_rig import RigSessionCalibration

__all__ = ["HELP", "add_arguments", "run"]

HELP = "calibrate a camera, or several on one mount, from images of chessboards"
SESSION_NAME = "session.toml"

EXAMPLES = """examples:
  rigkit calibrate photos --board 9x6x25 -r          one camera; 9x6 inner corners, squares of 25 mm; with a page
  rigkit calibrate left right --board board.toml     a rig, one folder a camera; so is a folder of left01, right01, ...
  rigkit calibrate photos --board 9x6x25 --export opencv ros
  rigkit calibrate left right --board 9x6x25 --only-extrinsics left.json right.json -o rig.json
  rigkit calibrate left right top --board 9x6x25 --add-camera rig.json -o rig3.json
  rigkit calibrate session.toml --force              again, from the session written the first time
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EXAMPLES
    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="SESSION.toml|FOLDER|VIDEO",
        help="a session, folders of images, videos, camera:0",
    )
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
        "--export", nargs="+", default=[], choices=sorted(FOREIGN_ENDINGS), help="also in these formats, beside it"
    )
    parser.add_argument("--corners", type=Path, metavar="FILE", help="use these: corners.csv, corners.json, .vnl")
    parser.add_argument(
        "--no-cache", action="store_true", help="find all corners anew, and keep none beside the session"
    )
    parser.add_argument("--force", action="store_true", help="replace existing results")
    parser.add_argument("--json", action="store_true", help="print the result for programs")
    rigs = parser.add_argument_group("rigs", "what is known stays; how unsure it is counts in all results")
    rigs.add_argument(
        "--only-extrinsics",
        nargs="+",
        type=Path,
        default=[],
        metavar="CALIB",
        help="lenses stay as these files have them (one a camera, or one rig): only the mounts are found",
    )
    rigs.add_argument(
        "--add-camera",
        type=Path,
        metavar="RIG",
        help="cameras of this rig stay, lens and mount: the others are added to it",
    )
    folders = parser.add_argument_group("folders", f"the session used is kept as {SESSION_NAME} for the next time")
    folders.add_argument(
        "--board", action="append", default=[], metavar="CxRxMM|BOARD.toml", help="such as 9x6x25 (repeatable)"
    )
    folders.add_argument("--timestamps", type=Path, metavar="FILE.csv", help="which frames of videos are of one moment")
    folders.add_argument("--model", help="camera model (default: auto, the one that predicts best)")


def run(args: argparse.Namespace) -> int:
    sessions = len(args.source) > 1 and all(path.suffix == ".toml" for path in args.source)
    return _many(args) if sessions else _one(args)


def _many(args: argparse.Namespace) -> int:
    """Calibrate several sessions, one after the other; one that fails does not end the rest."""
    from rigkit.cli.console import note

    if args.output is not None or args.report or args.corners is not None:
        raise InputError("calibrate: -o, --corners and a name for -r are of one session; results go beside each")
    codes = []
    for source in args.source:
        if not args.json:
            print(f"{source}:")
        try:
            codes.append(_one(argparse.Namespace(**{**vars(args), "source": [source]})))
        except RigkitError as error:
            note(f"{source}: {error}")
            codes.append(error.exit_code)
    failed = [str(source) for source, code in zip(args.source, codes, strict=True) if code]
    note(
        f"{len(codes) - len(failed)} of {len(codes)} sessions are well"
        + (f"; not: {', '.join(failed)}" if failed else "")
    )
    return max(codes)


def _one(args: argparse.Namespace) -> int:
    from rigkit.cli.console import note, print_json

    started = time.monotonic()
    done = _calibrated(args)
    summary, words, passed = _said(done)
    note(f"{', '.join(str(p) for p in done.written)} written, {time.monotonic() - started:.1f} s")
    print_json(summary) if args.json else print(words)
    for reason in done.unreadable.values():
        note(f"left out: {reason}")
    if done.unreadable:
        return ExitCode.BAD_INPUT
    return ExitCode.WELL if passed else ExitCode.CHECK_FAILED


def _calibrated(args: argparse.Namespace) -> SessionCalibration | RigSessionCalibration:
    from rigkit.cli.console import progress_on_stderr
    from rigkit.io.video import is_video
    from rigkit.workflows.calibrate import CalibrateOptions
    from rigkit.workflows.calibrate_any import FolderOptions, calibrate_folders, calibrate_session_file
    from rigkit.workflows.corners import Cache
    from rigkit.workflows.folder_session import Known

    options = CalibrateOptions(
        output=args.output,
        report=None if args.report is None else Path(args.report),
        force=args.force,
        cache=Cache.OFF if args.no_cache else Cache.UPDATE,
        corners=args.corners,
        exports=tuple(dict.fromkeys(args.export)),
        known=Known(tuple(args.only_extrinsics), args.add_camera),
    )
    progress = progress_on_stderr()
    first: Path = args.source[0]
    told = bool(args.board or args.model)
    if len(args.source) == 1 and first.is_dir() and not told and (first / SESSION_NAME).is_file():
        first = first / SESSION_NAME
    if len(args.source) > 1 or first.is_dir() or is_video(first):
        about = FolderOptions(boards=tuple(args.board), model=args.model or "auto", timestamps=args.timestamps)
        return calibrate_folders(args.source, about, options, progress=progress)
    if told:
        raise InputError(f"calibrate: '{first}' says itself what board and model it has; leave out --board and --model")
    return calibrate_session_file(first, options, progress=progress)


def _said(done: SessionCalibration | RigSessionCalibration) -> tuple[dict[str, Any], str, bool]:
    """Return the figures for programs, the words for a person, and whether everything measured agrees."""
    from rigkit.cli import calibration_words, rig_words
    from rigkit.workflows.calibrate import SessionCalibration

    if isinstance(done, SessionCalibration):
        return calibration_words.summary(done.calibration), calibration_words.describe(done.calibration), True
    return rig_words.summary(done.rig, done.checks), rig_words.describe(done.rig, done.checks), done.passed
