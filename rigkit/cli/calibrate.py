"""`rigkit calibrate`: calibrate one camera, or a rig, from a session file or folders of images of boards.

examples:
  rigkit calibrate photos --board 9x6x25 -r          one camera; 9x6 inner corners, 25 mm squares; with a report
  rigkit calibrate photos --square-mm 25 -r          the same; the board is identified from the images
  rigkit calibrate left right --board board.toml     a rig, one folder per camera (or one folder: left01, right01, ...)
  rigkit calibrate photos --board 9x6x25 --export opencv ros
  rigkit calibrate left right --board 9x6x25 --only-extrinsics left.json right.json -o rig.json
  rigkit calibrate left right top --board 9x6x25 --add-camera rig.json -o rig3.json
  rigkit calibrate session.toml --force              repeat it from the session file
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.cli.calibrate_arguments import add_arguments as add_arguments
from rigkit.cli.calibrate_arguments import calibrate_options, folder_options
from rigkit.cli.console import require_existing
from rigkit.core.errors import ExitCode, InputError, RigkitError

if TYPE_CHECKING:
    from rigkit.workflows.calibration.calibrate import RigSessionCalibration, SessionCalibration


def run(args: argparse.Namespace) -> int:
    require_existing(*args.source, remedy="give a folder of images, a video or a session's file")
    sessions = len(args.source) > 1 and all(path.suffix == ".toml" for path in args.source)
    return _many(args) if sessions else _one(args)


def _many(args: argparse.Namespace) -> int:
    """Calibrate several sessions, one after the other; one that fails does not end the rest."""
    from rigkit.cli.console import note

    if args.output is not None or args.report or args.corners is not None:
        raise InputError(
            "calibrate: -o, --corners and -r FILE.html take one session; with several, results go beside each session"
        )
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
        f"{len(codes) - len(failed)} of {len(codes)} sessions succeeded"
        + (f"; not: {', '.join(failed)}" if failed else "")
    )
    return max(codes)


def _one(args: argparse.Namespace) -> int:
    from rigkit.cli.console import note, note_left_out, print_json

    started = time.monotonic()
    done = _calibrated(args)
    summary, words, passed = _summary(done, json=args.json)
    note(f"{_listed(done.written)} written, {time.monotonic() - started:.1f} s")
    print_json(summary) if args.json else print(words)
    return note_left_out(done.unreadable.values()) or (ExitCode.WELL if passed else ExitCode.CHECK_FAILED)


def _listed(files: Sequence[Path]) -> str:
    """Return files in words: those of one folder behind its name."""
    folders = dict.fromkeys(path.parent for path in files)
    return "; ".join(
        ("" if folder == Path() else f"{folder}: ") + ", ".join(path.name for path in files if path.parent == folder)
        for folder in folders
    )


def _calibrated(args: argparse.Namespace) -> SessionCalibration | RigSessionCalibration:
    from rigkit.cli.console import progress_on_stderr
    from rigkit.workflows.calibration.calibrate_any import calibrate_sources

    return calibrate_sources(args.source, folder_options(args), calibrate_options(args), progress=progress_on_stderr())


def _summary(done: SessionCalibration | RigSessionCalibration, *, json: bool) -> tuple[dict[str, Any], str, bool]:
    """Return the figures for `json` programs, the words for a person, and whether everything measured agrees."""
    from rigkit.cli.calibration_output import describe, describe_rig, rig_summary, summary
    from rigkit.workflows.calibration.calibrate import SessionCalibration

    if isinstance(done, SessionCalibration):
        words, passed = describe(done.calibration), True
        figures = summary(done.calibration) if json else {}
    else:
        words, passed = describe_rig(done.rig, done.checks), done.passed
        figures = rig_summary(done.rig, done.checks) if json else {}
    return (figures | {"page": done.page.to_dict()} if json else {}), words, passed
