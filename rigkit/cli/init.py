r"""`rigkit init`: write a data set manifest or a session for a folder of images, asking for what images cannot show.

examples:
  rigkit init lab --square-mm 50 --calibration camera.json --pose-type general --baseline-mm 300+-2 \
      --angle-deg 90+-0.3                            as measured by ruler and set square
  rigkit init lab --square-mm 50 --calibration left.json --calibration right.json --pose-type standard
  rigkit init lab --square-mm 50 --calibration wide=w.json --calibration tele=t.json \
      --cameras 'w-*=wide,wide' --cameras 't-*=tele,tele' --pose-type 'w-*=forward' --pose-type general
  rigkit init lab --board aprilgrid:6x6x88,spacing=0.3 --calibration camera.json --pose-type general
  rigkit init photos --session --board 9x6x25        a session for rigkit calibrate
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rigkit.cli.aim_arguments import add_board_argument
from rigkit.cli.console import file_path
from rigkit.cli.init_manifest import POSE_TYPES, parse_length, run_manifest
from rigkit.core.errors import ExitCode, InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    repeatable: dict[str, Any] = {"action": "append", "default": []}
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="folder with the images of the pairs, or of the cameras"
    )
    parser.add_argument("--name", help="name of the data set (default: the folder's)")
    parser.add_argument(
        "--square-mm", type=float, metavar="MM", help="side of a square, as measured on the printed board"
    )
    parser.add_argument(
        "--calibration",
        **repeatable,
        metavar="[CAMERA=]FILE",
        help="calibration of the camera (repeatable: two are those of the first and of the second image of each pair; "
        "name three and more); a rig.json stands for the calibrations beside it",
    )
    parser.add_argument(
        "--cameras",
        **repeatable,
        metavar="PAIRS=ONE,TWO|N",
        help="cameras of the two images of pairs whose names match, such as 'fisheye-*=f,f' (repeatable); with "
        "--session, the number of cameras whose images the folder holds",
    )
    parser.add_argument(
        "--pose-type",
        **repeatable,
        metavar="[PAIRS=]TYPE",
        help=f"{', '.join(POSE_TYPES)}: of all pairs, or of those whose names match (repeatable; the first "
        "match counts)",
    )
    parser.add_argument(
        "--baseline-mm",
        **repeatable,
        metavar="[PAIR=]MM+-SIGMA",
        help="measured baseline of a pair, such as first=300+-2, or 300+-2 of the only one (repeatable)",
    )
    parser.add_argument(
        "--angle-deg",
        **repeatable,
        metavar="[PAIRS=]DEG+-SIGMA",
        help="measured angle between every two boards, such as 90+-0.3, of all pairs or of those whose names match "
        "(repeatable; the first match counts)",
    )
    parser.add_argument("-o", "--output", type=file_path, help="default: dataset.toml (session.toml) in the folder")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    add_board_argument(parser, "board in the images, such as 9x6x25 (repeatable; instead of --square-mm)")
    session = parser.add_argument_group("sessions")
    session.add_argument(
        "--session", action="store_true", help="write a session for rigkit calibrate instead of a manifest"
    )
    session.add_argument("--model", help="camera model (default: auto, the lowest held-out error)")


def run(args: argparse.Namespace) -> int:
    return _session(args) if args.session else run_manifest(args)


def _session(args: argparse.Namespace) -> int:
    from rigkit.cli.console import progress_on_stderr
    from rigkit.io.boards.board_words import board_files
    from rigkit.io.disk.writing import ensure_writable, write_together
    from rigkit.io.media.images import images_below, require_folder
    from rigkit.workflows.calibration.calibrate_any import new_session
    from rigkit.workflows.options.cameras import FolderOptions

    of_manifests = ("calibration", "pose_type", "baseline_mm", "angle_deg")
    if any(getattr(args, name) for name in of_manifests):
        raise InputError(
            "init --session: only --board, --square-mm, --cameras and --model apply; leave the other options out"
        )
    if args.square_mm is not None:
        parse_length("--square-mm", args.square_mm)
    require_folder(args.folder)
    path = args.output or args.folder / "session.toml"
    ensure_writable([path], force=args.force, inputs=[*board_files(args.board), *images_below(args.folder)])
    options = FolderOptions(
        boards=tuple(args.board), square_mm=args.square_mm, model=args.model, cameras=_number_of_cameras(args.cameras)
    )
    made = new_session(args.folder, options, path, progress=progress_on_stderr())
    write_together(made, force=args.force)
    for written in made:
        print(written)
    return ExitCode.WELL


def _number_of_cameras(given: Sequence[str]) -> int | None:
    """Return N of `--cameras N`; None without the option."""
    if not given:
        return None
    if len(given) > 1 or not given[0].isdecimal() or int(given[0]) < 1:
        raise InputError(f"init --session: --cameras {' '.join(given)}: give the number of cameras, such as 2")
    return int(given[0])
