"""`rigkit init`: a manifest or a session from a folder of images, asking only for what images cannot tell."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from rigkit.cli.console import note, progress_on_stderr
from rigkit.cli.lengths import told_baselines, told_length
from rigkit.core.errors import ExitCode, InputError
from rigkit.core.identifiers import MAX_IDENTIFIER, check_identifier
from rigkit.io.reading import usable_path

HELP = "write a manifest of pairs to validate, or a session to calibrate, from a folder of images"

POSE_TYPES = ("general", "planar", "standard", "forward", "auto")
ONE_CAMERA, TWO_CAMERAS = ("camera",), ("camera1", "camera2")

_EXAMPLES = """examples:
  rigkit init lab --square-mm 50 --calibration camera.json --pose-type general --baseline-mm first=300+-2
  rigkit init lab --square-mm 50 --calibration left.json --calibration right.json --pose-type standard
  rigkit init lab --square-mm 50 --calibration wide=w.json --calibration tele=t.json \\
      --cameras 'w-*=wide,wide' --cameras 't-*=tele,tele' --pose-type 'w-*=forward' --pose-type general
  rigkit init photos --session --board 9x6x25        a session for rigkit calibrate, of one camera or several
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EXAMPLES
    parser.add_argument("folder", type=Path, help="folder with the images of the pairs, or of the cameras")
    parser.add_argument("--name", help="name of the data set (default: the folder's)")
    parser.add_argument("--square-mm", type=float, help="side of a square, as measured on the printed board")
    parser.add_argument(
        "--calibration",
        action="append",
        default=[],
        metavar="[CAMERA=]FILE",
        help="calibration of the camera; of two, give that of the first image, then that of the second; of more, name "
        "each (repeatable)",
    )
    parser.add_argument(
        "--cameras",
        action="append",
        default=[],
        metavar="PAIRS=ONE,TWO",
        help="cameras of the two images of pairs whose names match, such as 'fisheye-*=f,f' (repeatable)",
    )
    parser.add_argument(
        "--pose-type",
        action="append",
        default=[],
        metavar="[PAIRS=]TYPE",
        help=f"{', '.join(POSE_TYPES)}: of all pairs, or of those whose names match (repeatable; the first that "
        "matches counts)",
    )
    parser.add_argument(
        "--baseline-mm",
        action="append",
        default=[],
        metavar="PAIR=MM+-SIGMA",
        help="measured baseline of a pair, such as first=300+-2 (repeatable)",
    )
    parser.add_argument("-o", "--output", type=Path, help="default: dataset.toml (session.toml) in the folder")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    session = parser.add_argument_group("sessions")
    session.add_argument("--session", action="store_true", help="a session for rigkit calibrate instead")
    session.add_argument(
        "--board", action="append", default=[], metavar="CxRxMM|BOARD.toml", help="such as 9x6x25 (repeatable)"
    )
    session.add_argument("--model", help="camera model (default: auto, the one that predicts best)")


def run(args: argparse.Namespace) -> int:
    return _session(args) if args.session else _manifest(args)


def _session(args: argparse.Namespace) -> int:
    from rigkit.io.files import write_together
    from rigkit.workflows.folder_session import session_of_folders

    if args.square_mm is not None or args.calibration or args.cameras or args.pose_type or args.baseline_mm:
        raise InputError("init --session: takes --board and --model; the other options are of manifests")
    path = args.output or args.folder / "session.toml"
    made = session_of_folders([args.folder], args.board, path, model=args.model or "auto")
    write_together(dict(made.files), force=args.force)
    for written in made.files:
        print(written)
    return ExitCode.WELL


def _manifest(args: argparse.Namespace) -> int:
    from rigkit.io.files import ensure_writable, write_atomic
    from rigkit.io.manifest import load_dataset
    from rigkit.io.manifest_writer import find_images, group_pairs, manifest_text
    from rigkit.workflows.sightings import sight_boards

    if args.board or args.model:
        raise InputError("init: --board and --model are of --session; a manifest takes --square-mm")
    if args.square_mm is not None:
        told_length("--square-mm", args.square_mm)
    poses_told = _told_poses(args.pose_type)
    root = usable_path(args.folder).resolve()
    target = args.output or root / "dataset.toml"
    images = find_images(root)
    calibrations = _told_calibrations(args.calibration, target.parent)
    read = [*images, *(target.parent / path for path in calibrations.values())]
    ensure_writable(target, force=args.force, inputs=read)
    _require_told(args)
    sightings, unreadable = sight_boards(images, progress_on_stderr())
    for error in unreadable:
        note(f"left out: {error}")
    pairs = group_pairs(sightings, root)
    names = [pair.name for pair in pairs]
    for pair in pairs:
        note(f"pair '{pair.name}': {pair.first.image.name}, {pair.second.image.name}")
    square_mm = args.square_mm or told_length("--square-mm", _ask("side of a square, mm"))
    if not calibrations:
        calibrations = _told_calibrations([_ask("path of calibration.json")], target.parent)
    cameras = _cameras_of(names, calibrations, args.cameras)
    poses = {name: _matching(poses_told, name) or _ask(f"pose type of '{name}'", POSE_TYPES) for name in names}
    text = manifest_text(
        args.name or _name_of(root),
        target.parent.resolve(),
        pairs,
        square_mm,
        calibrations,
        cameras,
        poses,
        told_baselines(args.baseline_mm, names),
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
        "--calibration": ("camera's calibration.json", args.calibration or None),
        "--pose-type": (f"pose type of the pairs ({', '.join(POSE_TYPES)})", args.pose_type or None),
    }
    missing = {option: question for option, (question, value) in needed.items() if value is None}
    if missing and (sys.stdin is None or not sys.stdin.isatty()):
        said = "; ".join(f"the {question}: {option}" for option, question in missing.items())
        raise InputError(f"init: images cannot tell everything; say {said}")


def _told_calibrations(told: Sequence[str], folder: Path) -> dict[str, str]:
    """Return camera -> path of its calibration, as it stands in a manifest in `folder`; paths are as typed, or from
    that folder."""
    usual = TWO_CAMERAS if len(told) == 2 else ONE_CAMERA
    out: dict[str, str] = {}
    for k, words in enumerate(told):
        name, found, path = words.partition("=")
        if not found or Path(words).exists():
            if len(told) > len(TWO_CAMERAS):
                raise InputError(f"--calibration {words}: of more than two cameras name each, such as wide={words}")
            name, path = usual[k], words
        if check_identifier(name, "camera") in out:
            raise InputError(f"--calibration: two are called '{name}'; name each differently")
        typed = Path(path)
        if not typed.is_absolute() and typed.exists():
            path = Path(os.path.relpath(typed, folder)).as_posix()
        out[name] = path
    return out


def _cameras_of(pairs: Sequence[str], calibrations: dict[str, str], told: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the cameras of every pair; raises InputError for cameras that are not there, or pairs of more than two
    that nobody gives cameras to."""
    known = list(calibrations)
    patterns: list[tuple[str, tuple[str, str]]] = []
    for words in told:
        pattern, found, both = words.rpartition("=")
        first, comma, second = both.partition(",")
        if not found or not comma:
            raise InputError(f"--cameras {words}: write PAIRS=ONE,TWO, such as 'fisheye-*={known[0]},{known[-1]}'")
        for name in (first, second):
            if name not in known:
                raise InputError(f"--cameras {words}: no camera is called '{name}'; known: {', '.join(known)}")
        patterns.append((pattern, (first, second)))
    out = {}
    for pair in pairs:
        usual = (known[0], known[-1]) if len(known) <= len(TWO_CAMERAS) else None
        found_cameras = next((cameras for pattern, cameras in patterns if fnmatch(pair, pattern)), usual)
        if found_cameras is None:
            raise InputError(f"init: nothing says which cameras took pair '{pair}'; add --cameras {pair}=ONE,TWO")
        out[pair] = found_cameras
    return out


def _told_poses(told: Sequence[str]) -> list[tuple[str, str]]:
    """Return (pattern of pairs, pose type)."""
    out = []
    for words in told:
        pattern, _, pose_type = words.rpartition("=")
        if pose_type not in POSE_TYPES:
            raise InputError(f"--pose-type {words}: '{pose_type}' is unknown; known: {', '.join(POSE_TYPES)}")
        out.append((pattern or "*", pose_type))
    return out


def _matching(told: Sequence[tuple[str, str]], name: str) -> str | None:
    return next((value for pattern, value in told if fnmatch(name, pattern)), None)


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
