"""`rigkit init` of a manifest: the pairs of a folder of images, and what images do not show, given or asked for."""

from __future__ import annotations

import argparse

from rigkit.cli.console import note, progress_on_stderr
from rigkit.cli.manifest_answers import (
    POSE_TYPES,
    ask,
    cameras_of,
    parse_angles,
    parse_baselines,
    parse_boards,
    parse_calibrations,
    parse_length,
    parse_pose_types,
    require_answers,
    value_of,
)
from rigkit.core.errors import ExitCode, InputError
from rigkit.io.disk.reading import usable_path


def run_manifest(args: argparse.Namespace) -> int:
    from rigkit.io.disk.writing import ensure_writable
    from rigkit.io.manifests.manifest_writer import NewManifest, find_images
    from rigkit.workflows.capture.new_manifest import find_pairs, name_of_folder, write_manifest

    if args.model:
        raise InputError("init: --model needs --session; add that, or leave it out")
    if args.board and args.square_mm is not None:
        raise InputError("init: --board states the square size already; leave --square-mm out")
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
    poses = {name: value_of(given_poses, name) or ask(f"pose type of '{name}'", POSE_TYPES) for name in names}
    new = NewManifest(
        name=args.name or name_of_folder(root),
        pairs=found.pairs,
        declared=declared or squares_mm,
        calibrations=calibrations,
        cameras=cameras,
        pose_types=poses,
        baselines=parse_baselines(args.baseline_mm, names),
        angles={name: angle for name in names if (angle := value_of(given_angles, name)) is not None},
    )
    incomplete = write_manifest(new, target, force=args.force)
    print(target)
    if incomplete is not None:
        note(f"to be completed: {incomplete}")
    return ExitCode.BAD_INPUT if found.unreadable else ExitCode.WELL
