"""The arguments of `rigkit calibrate`, and the options that they make."""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path

from rigkit.cli.console import add_options, options_of, page_path
from rigkit.core.errors import InputError
from rigkit.workflows.inputs.formats import FOREIGN_ENDINGS
from rigkit.workflows.options.cameras import Cache, CalibrateOptions, FolderOptions, Known


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="SESSION.toml|FOLDER|VIDEO",
        help="a session file; or one folder of images (or video, or camera:0) per camera",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=_output,
        help="file; .json is added to a name without ending (default: calibration.json, rig.json, beside the session)",
    )
    parser.add_argument(
        "-r",
        "--report",
        nargs="?",
        type=page_path,
        const=Path(),
        metavar="FILE.html",
        help="write an HTML report (default name: that of the output)",
    )
    parser.add_argument(
        "--export",
        dest="exports",
        nargs="+",
        default=[],
        choices=sorted(FOREIGN_ENDINGS),
        metavar="FORMAT",
        help=f"also write these formats, beside the output: {', '.join(sorted(FOREIGN_ENDINGS))}",
    )
    add_options(parser, CalibrateOptions, pupil="", corners="FILE")
    parser.add_argument(
        "--no-cache", action="store_true", help="detect all corners again, and keep none beside the session"
    )
    add_options(parser, CalibrateOptions, force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    rigs = parser.add_argument_group(
        "rigs", "cameras already known stay fixed; their covariance is propagated into all results"
    )
    add_options(rigs, Known, lenses="--only-extrinsics CALIB...", rig="--add-camera RIG")
    folders = parser.add_argument_group(
        "folders", "the calibration is repeated by the session file that results, session.toml"
    )
    add_options(folders, FolderOptions, boards="--board BOARD", square_mm="MM", cameras="N", timestamps="FILE.csv")
    add_options(folders, FolderOptions, model="")


def calibrate_options(args: argparse.Namespace) -> CalibrateOptions:
    """Return the options of outputs, cache and known parameters."""
    cache = Cache.OFF if args.no_cache else Cache.UPDATE
    exports = tuple(dict.fromkeys(args.exports))
    known = options_of(Known, args)
    return options_of(CalibrateOptions, args, cache=cache, exports=exports, known=known, plan=args.json)


def _output(text: str) -> Path:
    """Return the file to write, a new one without suffix with .json; raises InputError for a folder."""
    path = Path(text)
    if path.is_dir() or text.endswith(("/", os.sep)):
        what = "is" if path.is_dir() else "names"
        raise InputError(f"calibrate: -o '{text}' {what} a folder; give a file, such as '{path / 'calibration.json'}'")
    known = path.suffix or path.exists() or path.is_symlink()
    return path if known else path.with_name(f"{path.name}.json")


def folder_options(args: argparse.Namespace) -> FolderOptions:
    """Return the options for folders of images: boards, model, time stamps."""
    if args.square_mm is not None and not (math.isfinite(args.square_mm) and args.square_mm > 0.0):
        raise InputError(f"calibrate: --square-mm {args.square_mm}: a positive number of mm is needed")
    if args.cameras is not None and args.cameras < 1:
        raise InputError(f"calibrate: --cameras {args.cameras}: at least one camera is needed")
    return options_of(FolderOptions, args)
