"""`rigkit init`: a manifest or a session from a folder of images, asking only for what images cannot tell."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rigkit.cli.console import note, progress_on_stderr
from rigkit.cli.manifest_words import (
    POSE_TYPES,
    angle_of,
    ask,
    cameras_of,
    parse_angles,
    parse_baselines,
    parse_boards,
    parse_calibrations,
    parse_length,
    parse_pose_types,
    pose_type_of,
    require_answers,
)
from rigkit.core.errors import ExitCode, InputError
from rigkit.io.disk.reading import usable_path


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
        help="calibration of the camera; of two, give that of the first image, then that of the second; of more, name "
        "each; a rig.json stands for those beside it (repeatable)",
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
    from rigkit.io.disk.writing import write_together
    from rigkit.workflows.inputs.folder_session import session_of_folders

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


def _manifest(args: argparse.Namespace) -> int:
    from rigkit.io.disk.writing import ensure_writable
    from rigkit.io.manifests.manifest_writer import NewManifest, find_images
    from rigkit.workflows.capture.new_manifest import find_pairs, name_of_folder, write_manifest

    if args.model:
        raise InputError("init: --model goes with --session only; leave it out")
    if args.board and args.square_mm is not None:
        raise InputError("init: --board says how large squares are; leave --square-mm out")
    declared = parse_boards(args.board)
    if args.square_mm is not None:
        parse_length("--square-mm", args.square_mm)
    given_poses, given_angles = parse_pose_types(args.pose_type), parse_angles(args.angle_deg)
    root = usable_path(args.folder).resolve()
    target = args.output or root / "dataset.toml"
    images = find_images(root)
    calibrations = parse_calibrations(args.calibration, target.parent)
    read = [*images, *(target.parent / path for path in calibrations.values())]
    ensure_writable(target, force=args.force, inputs=read)
    require_answers(args)
    found = find_pairs(root, images, [one.board for one in declared], progress=progress_on_stderr())
    for error in found.unreadable:
        note(f"left out: {error}")
    names = [pair.name for pair in found.pairs]
    for pair in found.pairs:
        note(f"pair '{pair.name}': {pair.first.image.name}, {pair.second.image.name}")
    squares_mm = 0.0 if declared else args.square_mm or parse_length("--square-mm", ask("side of a square, mm"))
    if not calibrations:
        calibrations = parse_calibrations([ask("path of calibration.json")], target.parent)
    cameras = cameras_of(names, calibrations, args.cameras)
    poses = {name: pose_type_of(given_poses, name) or ask(f"pose type of '{name}'", POSE_TYPES) for name in names}
    new = NewManifest(
        name=args.name or name_of_folder(root),
        pairs=found.pairs,
        declared=declared or squares_mm,
        calibrations=calibrations,
        cameras=cameras,
        pose_types=poses,
        baselines=parse_baselines(args.baseline_mm, names),
        angles={name: angle for name in names if (angle := angle_of(given_angles, name)) is not None},
    )
    incomplete = write_manifest(new, target, force=args.force)
    print(target)
    if incomplete is not None:
        note(f"to be completed: {incomplete}")
    return ExitCode.BAD_INPUT if found.unreadable else ExitCode.WELL
