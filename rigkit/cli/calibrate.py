"""`rigkit calibrate`: one camera, or several on one mount, from a session or folders of images of boards."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.core.errors import ExitCode, InputError, RigkitError
from rigkit.workflows.inputs.formats import FOREIGN_ENDINGS

if TYPE_CHECKING:
    from rigkit.workflows.calibration.calibrate import CalibrateOptions, SessionCalibration
    from rigkit.workflows.calibration.calibrate_any import FolderOptions
    from rigkit.workflows.calibration.calibrate_rig import RigSessionCalibration


MODEL_NAMES = ("pinhole", "brown", "kannala_brandt", "scaramuzza", "ucm", "eucm", "double_sphere")
"""Names of `rigkit.cameras.registry`, which takes too long to import for a help text."""

PUPILS = ("auto", "central", "moving")
"""Choices of `rigkit.calibration.with_pupil`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
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
        "--export",
        nargs="+",
        default=[],
        choices=sorted(FOREIGN_ENDINGS),
        metavar="FORMAT",
        help=f"also for other tools, beside it: {', '.join(sorted(FOREIGN_ENDINGS))}",
    )
    parser.add_argument(
        "--pupil",
        choices=PUPILS,
        default="auto",
        help="whether lenses look from one point (central), or their entrance pupils move; default: auto, moving where "
        "images show it",
    )
    parser.add_argument("--corners", type=Path, metavar="FILE", help="use these: corners.csv, corners.json, .vnl")
    parser.add_argument(
        "--no-cache", action="store_true", help="find all corners anew, and keep none beside the session"
    )
    parser.add_argument("--force", action="store_true", help="replace existing results")
    parser.add_argument("--json", action="store_true", help="print the result for programs")
    _add_known(parser)
    _add_of_folders(parser)


def _add_known(parser: argparse.ArgumentParser) -> None:
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


def _add_of_folders(parser: argparse.ArgumentParser) -> None:
    folders = parser.add_argument_group("folders", "the session used is kept as session.toml for the next time")
    folders.add_argument(
        "--board",
        action="append",
        default=[],
        metavar="BOARD",
        help="9x6x25 (inner corners, mm a square), circles:10x8x25,diameter_mm=15, a board file, ... (repeatable)",
    )
    folders.add_argument(
        "--square-mm",
        type=float,
        metavar="MM",
        help="instead: the board is what the images show, with squares (tags, distances of circles) of so many mm",
    )
    folders.add_argument("--timestamps", type=Path, metavar="FILE.csv", help="which frames of videos are of one moment")
    folders.add_argument("--model", help=f"{', '.join(MODEL_NAMES)} (default: auto, the one that predicts best)")


def run(args: argparse.Namespace) -> int:
    sessions = len(args.source) > 1 and all(path.suffix == ".toml" for path in args.source)
    return _calibrate_several(args) if sessions else _calibrate_one(args)


def _calibrate_several(args: argparse.Namespace) -> int:
    """Calibrate several sessions in turn; one that fails does not stop the others."""
    from rigkit.cli.console import note

    if args.output is not None or args.report or args.corners is not None:
        raise InputError("calibrate: -o, --corners and a name for -r are of one session; results go beside each")
    codes = []
    for source in args.source:
        if not args.json:
            print(f"{source}:")
        try:
            codes.append(_calibrate_one(argparse.Namespace(**{**vars(args), "source": [source]})))
        except RigkitError as error:
            note(f"{source}: {error}")
            codes.append(error.exit_code)
    failed = [str(source) for source, code in zip(args.source, codes, strict=True) if code]
    note(
        f"{len(codes) - len(failed)} of {len(codes)} sessions are well"
        + (f"; not: {', '.join(failed)}" if failed else "")
    )
    return max(codes)


def _calibrate_one(args: argparse.Namespace) -> int:
    from rigkit.cli.console import note, print_json, progress_on_stderr
    from rigkit.workflows.calibration.calibrate_any import calibrate_sources

    started = time.monotonic()
    done = calibrate_sources(
        args.source, _folder_options(args), _calibrate_options(args), progress=progress_on_stderr()
    )
    summary, words, passed = _summary(done, json=args.json)
    note(f"{_listed(done.written)} written, {time.monotonic() - started:.1f} s")
    print_json(summary) if args.json else print(words)
    for reason in done.unreadable.values():
        note(f"left out: {reason}")
    if done.unreadable:
        return ExitCode.BAD_INPUT
    return ExitCode.WELL if passed else ExitCode.CHECK_FAILED


def _listed(files: Sequence[Path]) -> str:
    """Return the files in words, grouped by folder."""
    folders = dict.fromkeys(path.parent for path in files)
    return "; ".join(
        ("" if folder == Path() else f"{folder}: ") + ", ".join(path.name for path in files if path.parent == folder)
        for folder in folders
    )


def _summary(done: SessionCalibration | RigSessionCalibration, *, json: bool) -> tuple[dict[str, Any], str, bool]:
    """Return the result as JSON values if `json`, the result as text, and whether all measurements agree."""
    from rigkit.cli import calibration_words, rig_words
    from rigkit.workflows.calibration.calibrate import SessionCalibration

    if isinstance(done, SessionCalibration):
        words = calibration_words.describe(done.calibration)
        if not json:
            return {}, words, True
        page = calibration_words.page(done.calibration, done.session.boards)
        return calibration_words.summary(done.calibration) | {"page": page.to_dict()}, words, True
    words = rig_words.describe(done.rig, done.checks)
    if not json:
        return {}, words, done.passed
    page = rig_words.page(done.rig, done.checks, done.session)
    return rig_words.summary(done.rig, done.checks) | {"page": page.to_dict()}, words, done.passed


def _calibrate_options(args: argparse.Namespace) -> CalibrateOptions:
    """Return the options for outputs and known cameras."""
    from rigkit.workflows.calibration.calibrate import CalibrateOptions
    from rigkit.workflows.inputs.corners import Cache
    from rigkit.workflows.inputs.folder_session import Known

    return CalibrateOptions(
        output=args.output,
        report=None if args.report is None else Path(args.report),
        force=args.force,
        cache=Cache.OFF if args.no_cache else Cache.UPDATE,
        corners=args.corners,
        pupil=args.pupil,
        exports=tuple(dict.fromkeys(args.export)),
        known=Known(tuple(args.only_extrinsics), args.add_camera),
    )


def _folder_options(args: argparse.Namespace) -> FolderOptions:
    """Return the options for folders of images."""
    from rigkit.workflows.calibration.calibrate_any import FolderOptions

    if args.square_mm is not None and not (math.isfinite(args.square_mm) and args.square_mm > 0.0):
        raise InputError(f"calibrate: --square-mm {args.square_mm}: a positive number of mm is needed")
    return FolderOptions(
        boards=tuple(args.board), square_mm=args.square_mm, model=args.model, timestamps=args.timestamps
    )
