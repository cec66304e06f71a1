"""The arguments of `rigkit calibrate`, and the options that they make."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from rigkit.core.errors import InputError
from rigkit.workflows.inputs.formats import FOREIGN_ENDINGS

if TYPE_CHECKING:
    from rigkit.workflows.calibration.calibrate import CalibrateOptions
    from rigkit.workflows.calibration.calibrate_any import FolderOptions

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
        help="a session file; or one folder of images (or video, or camera:0) per camera",
    )
    parser.add_argument("-o", "--output", type=Path, help="default: calibration.json (rig.json) beside the session")
    parser.add_argument(
        "-r",
        "--report",
        nargs="?",
        const="",
        metavar="FILE.html",
        help="write an HTML report (default name: that of the output)",
    )
    parser.add_argument(
        "--export",
        nargs="+",
        default=[],
        choices=sorted(FOREIGN_ENDINGS),
        metavar="FORMAT",
        help=f"also write these formats, beside the output: {', '.join(sorted(FOREIGN_ENDINGS))}",
    )
    parser.add_argument(
        "--pupil",
        choices=PUPILS,
        default="auto",
        help="entrance pupil fixed (a central camera), or moving with the angle of view (default: auto, moving where "
        "images show it)",
    )
    parser.add_argument(
        "--corners",
        type=Path,
        metavar="FILE",
        help="use these corners instead of detecting them: corners.csv, corners.json, .vnl (mrcal)",
    )
    parser.add_argument(
        "--no-cache", action="store_true", help="detect all corners again, and keep none beside the session"
    )
    parser.add_argument("--force", action="store_true", help="replace existing results")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    _add_known(parser)
    _add_of_folders(parser)


def _add_known(parser: argparse.ArgumentParser) -> None:
    rigs = parser.add_argument_group(
        "rigs", "cameras already known stay fixed; their covariance is propagated into all results"
    )
    rigs.add_argument(
        "--only-extrinsics",
        nargs="+",
        type=Path,
        default=[],
        metavar="CALIB",
        help="keep the intrinsics of these files (one per camera, or one rig); solve for the extrinsics only",
    )
    rigs.add_argument(
        "--add-camera",
        type=Path,
        metavar="RIG",
        help="keep intrinsics and extrinsics of this rig; add the other cameras to it",
    )


def _add_of_folders(parser: argparse.ArgumentParser) -> None:
    folders = parser.add_argument_group(
        "folders", "the calibration is repeated by the session file that results, session.toml"
    )
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
        help="instead of --board: side of a square (tag; distance of circles); the images say which board it is",
    )
    folders.add_argument(
        "--cameras",
        type=int,
        metavar="N",
        help="number of cameras whose images the folders hold (default: by the names of images and folders, and by the "
        "boards in them); 1: all are of one camera",
    )
    folders.add_argument(
        "--timestamps", type=Path, metavar="FILE.csv", help="which frames of the videos were taken together"
    )
    folders.add_argument("--model", help=f"{', '.join(MODEL_NAMES)} (default: auto, the lowest held-out error)")


def calibrate_options(args: argparse.Namespace) -> CalibrateOptions:
    """Return the options of outputs, cache and known parameters."""
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


def folder_options(args: argparse.Namespace) -> FolderOptions:
    """Return the options for folders of images: boards, model, time stamps."""
    from rigkit.workflows.calibration.calibrate_any import FolderOptions

    if args.square_mm is not None and not (math.isfinite(args.square_mm) and args.square_mm > 0.0):
        raise InputError(f"calibrate: --square-mm {args.square_mm}: a positive number of mm is needed")
    if args.cameras is not None and args.cameras < 1:
        raise InputError(f"calibrate: --cameras {args.cameras}: at least one camera is needed")
    return FolderOptions(
        boards=tuple(args.board),
        square_mm=args.square_mm,
        model=args.model,
        cameras=args.cameras,
        timestamps=args.timestamps,
    )
