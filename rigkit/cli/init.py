"""`rigkit init`: a manifest from a folder of images, asking only for what images cannot tell."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rigkit.cli.console import note, progress_on_stderr
from rigkit.cli.lengths import told_baselines, told_length
from rigkit.core.errors import ExitCode, InputError
from rigkit.core.identifiers import MAX_IDENTIFIER
from rigkit.io.reading import usable_path

if TYPE_CHECKING:
    pass

HELP = "write a manifest from a folder of images"

POSE_TYPES = ("general", "planar", "standard", "forward", "auto")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="folder with the images of the pairs")
    parser.add_argument("--name", help="name of the data set (default: the folder's)")
    parser.add_argument("--square-mm", type=float, help="side of a square, as measured on the printed board")
    parser.add_argument("--calibration", metavar="FILE", help="calibration.json of the camera")
    parser.add_argument("--pose-type", choices=POSE_TYPES, help="pose type of all pairs")
    parser.add_argument(
        "--baseline-mm",
        action="append",
        default=[],
        metavar="PAIR=MM+-SIGMA",
        help="measured baseline of a pair, such as first=300+-2 (repeatable)",
    )
    parser.add_argument("-o", "--output", type=Path, help="default: dataset.toml in the folder")
    parser.add_argument("--force", action="store_true", help="replace an existing manifest")


def run(args: argparse.Namespace) -> int:
    from rigkit.io.files import ensure_writable, write_atomic
    from rigkit.io.manifest import load_dataset
    from rigkit.io.manifest_writer import find_images, group_pairs, manifest_text
    from rigkit.workflows.sightings import sight_boards

    if args.square_mm is not None:
        told_length("--square-mm", args.square_mm)
    root = usable_path(args.folder).resolve()
    target = args.output or root / "dataset.toml"
    images = find_images(root)
    read = [*images, *([target.parent / args.calibration] if args.calibration else [])]
    ensure_writable(target, force=args.force, inputs=read)
    _require_told(args)
    sightings, unreadable = sight_boards(images, progress_on_stderr())
    for error in unreadable:
        note(f"left out: {error}")
    pairs = group_pairs(sightings, root)
    for pair in pairs:
        note(f"pair '{pair.name}': {pair.first.image.name}, {pair.second.image.name}")
    square_mm = args.square_mm or told_length("--square-mm", _ask("side of a square, mm"))
    calibration = args.calibration or _ask("path of calibration.json (relative to the manifest)")
    poses = {p.name: args.pose_type or _ask(f"pose type of '{p.name}'", POSE_TYPES) for p in pairs}
    text = manifest_text(
        args.name or _name_of(root),
        target.parent.resolve(),
        pairs,
        square_mm,
        calibration,
        poses,
        told_baselines(args.baseline_mm, [pair.name for pair in pairs]),
    )
    write_atomic(target, text, force=args.force)
    print(target)
    try:
        load_dataset(target)
    except InputError as error:
        note(f"to be completed: {error}")
    return ExitCode.BAD_INPUT if unreadable else ExitCode.WELL


def _require_told(args: argparse.Namespace) -> None:
    """Raise InputError that names everything that nobody has said and that, without a terminal, nobody can be asked."""
    needed = {
        "--square-mm": ("side of a square, mm", args.square_mm),
        "--calibration": ("camera's calibration.json", args.calibration),
        "--pose-type": (f"pose type of the pairs ({', '.join(POSE_TYPES)})", args.pose_type),
    }
    missing = {option: question for option, (question, value) in needed.items() if value is None}
    if missing and (sys.stdin is None or not sys.stdin.isatty()):
        said = "; ".join(f"the {question}: {option}" for option, question in missing.items())
        raise InputError(f"init: images cannot tell everything; say {said}")


def _name_of(folder: Path) -> str:
    """Return the folder's name without the letters that no data set's name has."""
    return re.sub(r"[^\w .+()-]|^\W+|\.(?=\.)", "", folder.name)[:MAX_IDENTIFIER].strip() or "data"


def _ask(question: str, choices: tuple[str, ...] = ()) -> str:
    """Ask at the terminal until there is an answer."""
    hint = f" ({', '.join(choices)})" if choices else ""
    while True:
        print(f"{question}{hint}: ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            raise InputError(f"init: nobody says the {question}; give it as an option, see rigkit init --help")
        answer = line.strip()
        if answer and (not choices or answer in choices):
            return answer
