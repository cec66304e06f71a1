"""`rigkit init`: a manifest or a session from a folder of images, asking only for what images cannot tell."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.cli.console import note, progress_on_stderr
from rigkit.cli.manifest_words import (
    POSE_TYPES,
    angle_of,
    ask,
    cameras_of,
    pose_type_of,
    require_told,
    told_angles,
    told_baselines,
    told_calibrations,
    told_length,
    told_poses,
)
from rigkit.core.errors import ExitCode, InputError
from rigkit.io.reading import usable_path

if TYPE_CHECKING:
    from rigkit.io.manifest_writer import ToldBoard

HELP = "write a manifest of pairs to validate, or a session to calibrate, from a folder of images"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    repeatable: dict[str, Any] = {"action": "append", "default": []}
    parser.add_argument("folder", type=Path, help="folder with the images of the pairs, or of the cameras")
    parser.add_argument("--name", help="name of the data set (default: the folder's)")
    parser.add_argument("--square-mm", type=float, help="side of a square, as measured on the printed board")
    parser.add_argument(
        "--calibration",
        **repeatable,
        metavar="[CAMERA=]FILE",
        help="calibration of the camera; of two, give that of the first image, then that of the second; of more, name "
        "each (repeatable)",
    )
    parser.add_argument(
        "--cameras",
        **repeatable,
        metavar="PAIRS=ONE,TWO",
        help="cameras of the two images of pairs whose names match, such as 'fisheye-*=f,f' (repeatable)",
    )
    parser.add_argument(
        "--pose-type",
        **repeatable,
        metavar="[PAIRS=]TYPE",
        help=f"{', '.join(POSE_TYPES)}: of all pairs, or of those whose names match (repeatable; the first that "
        "matches counts)",
    )
    parser.add_argument(
        "--baseline-mm",
        **repeatable,
        metavar="PAIR=MM+-SIGMA",
        help="measured baseline of a pair, such as first=300+-2 (repeatable)",
    )
    parser.add_argument(
        "--angle-deg",
        **repeatable,
        metavar="[PAIRS=]DEG+-SIGMA",
        help="measured angle between every two boards, such as 90+-0.3, of all pairs or of those whose names match "
        "(repeatable; the first that matches counts)",
    )
    parser.add_argument("-o", "--output", type=Path, help="default: dataset.toml (session.toml) in the folder")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument(
        "--board",
        **repeatable,
        metavar="CxRxMM|BOARD.toml",
        help="such as 9x6x25 (repeatable; of a manifest instead of --square-mm)",
    )
    session = parser.add_argument_group("sessions")
    session.add_argument("--session", action="store_true", help="a session for rigkit calibrate instead")
    session.add_argument("--model", help="camera model (default: auto, the one that predicts best)")


def run(args: argparse.Namespace) -> int:
    return _session(args) if args.session else _manifest(args)


def _session(args: argparse.Namespace) -> int:
    from rigkit.io.files import write_together
    from rigkit.workflows.folder_session import session_of_folders

    if (
        args.square_mm is not None
        or args.calibration
        or args.cameras
        or args.pose_type
        or args.baseline_mm
        or args.angle_deg
    ):
        raise InputError("init --session: takes --board and --model; the other options are of manifests")
    path = args.output or args.folder / "session.toml"
    made = session_of_folders([args.folder], args.board, path, model=args.model or "auto")
    write_together(dict(made.files), force=args.force)
    for written in made.files:
        print(written)
    return ExitCode.WELL


def _told_boards(words: Sequence[str]) -> list[ToldBoard]:
    """Return the boards that are told: files keep their names, words are called plane1, plane2, ... in their order."""
    from rigkit.io.board_file import load_board
    from rigkit.io.board_words import board_in_words
    from rigkit.io.manifest_writer import ToldBoard

    out = []
    for number, text in enumerate(words, start=1):
        board = board_in_words(text)
        if board is None:
            out.append(ToldBoard(load_board(text), Path(text)))
        else:
            out.append(ToldBoard(replace(board, board_id=f"plane{number}")))
    return out


def _manifest(args: argparse.Namespace) -> int:
    from rigkit.io.files import ensure_writable
    from rigkit.io.manifest_writer import find_images
    from rigkit.workflows.new_manifest import NewManifest, find_pairs, write_manifest

    if args.model:
        raise InputError("init: --model is of --session")
    if args.board and args.square_mm is not None:
        raise InputError("init: --board says how large squares are; leave --square-mm out")
    told = _told_boards(args.board)
    if args.square_mm is not None:
        told_length("--square-mm", args.square_mm)
    poses_told, angles_told = told_poses(args.pose_type), told_angles(args.angle_deg)
    root = usable_path(args.folder).resolve()
    target = args.output or root / "dataset.toml"
    images = find_images(root)
    calibrations = told_calibrations(args.calibration, target.parent)
    read = [*images, *(target.parent / path for path in calibrations.values())]
    ensure_writable(target, force=args.force, inputs=read)
    require_told(args)
    found = find_pairs(root, images, [one.board for one in told], on_progress=progress_on_stderr())
    for error in found.unreadable:
        note(f"left out: {error}")
    names = [pair.name for pair in found.pairs]
    for pair in found.pairs:
        note(f"pair '{pair.name}': {pair.first.image.name}, {pair.second.image.name}")
    squares_mm = 0.0 if told else args.square_mm or told_length("--square-mm", ask("side of a square, mm"))
    if not calibrations:
        calibrations = told_calibrations([ask("path of calibration.json")], target.parent)
    cameras = cameras_of(names, calibrations, args.cameras)
    poses = {name: pose_type_of(poses_told, name) or ask(f"pose type of '{name}'", POSE_TYPES) for name in names}
    new = NewManifest(
        root=root,
        name=args.name,
        pairs=found.pairs,
        told=told or squares_mm,
        calibrations=calibrations,
        cameras=cameras,
        pose_types=poses,
        baselines=told_baselines(args.baseline_mm, names),
        angles={name: angle for name in names if (angle := angle_of(angles_told, name)) is not None},
    )
    incomplete = write_manifest(new, target, force=args.force)
    print(target)
    if incomplete is not None:
        note(f"to be completed: {incomplete}")
    return ExitCode.BAD_INPUT if found.unreadable else ExitCode.WELL
