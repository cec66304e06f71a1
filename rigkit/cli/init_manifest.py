"""`rigkit init` of a manifest: the pairs of a folder of images, and what images do not show, given or asked for."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rigkit.core.errors import InputError
from rigkit.core.identifiers import check_identifier
from rigkit.core.posetype import PoseType
from rigkit.io.disk.reading import usable_path

if TYPE_CHECKING:
    from rigkit.io.manifests.manifest_writer import DeclaredBoard

Value = TypeVar("Value")
POSE_TYPES = tuple(map(str, PoseType))
ONE_CAMERA, TWO_CAMERAS = ("camera",), ("camera1", "camera2")


def run_manifest(args: argparse.Namespace) -> int:
    from rigkit.cli.console import note, note_left_out, progress_on_stderr
    from rigkit.io.disk.writing import ensure_writable
    from rigkit.io.manifests.manifest_writer import NewManifest, find_images
    from rigkit.workflows.capture.new_manifest import find_pairs, name_of_folder, write_manifest

    if args.model:
        raise InputError("init: --model needs --session; add that, or leave it out")
    if args.board and args.square_mm is not None:
        raise InputError("init: --board states the square size already; leave --square-mm out")
    declared = _parse_boards(args.board)
    if args.square_mm is not None:
        parse_length("--square-mm", args.square_mm)
    given_poses, given_angles = _parse_pose_types(args.pose_type), _parse_angles(args.angle_deg)
    root = usable_path(args.folder)
    target = args.output or root / "dataset.toml"
    images = find_images(root)
    calibrations = _parse_calibrations(args.calibration, target.parent)
    read = [*images, *(target.parent / path for path in calibrations.values())]
    ensure_writable(target, force=args.force, inputs=read)
    _require_answers(args)
    found = find_pairs(root, images, [one.board for one in declared], progress=progress_on_stderr())
    code = note_left_out(found.unreadable)
    names = [pair.name for pair in found.pairs]
    for pair in found.pairs:
        note(f"pair '{pair.name}': {pair.first.image.name}, {pair.second.image.name}")
    for again, pair in found.repeated:
        note(
            f"left out: '{again.first.image}' and '{again.second.image}' show the boards where pair '{pair.name}' does"
        )
    squares_mm = 0.0 if declared else args.square_mm or parse_length("--square-mm", _ask("side of a square, mm"))
    if not calibrations:
        calibrations = _parse_calibrations([_ask("path of calibration.json")], target.parent)
    cameras = _cameras_of(names, calibrations, args.cameras)
    poses = {name: _value_of(given_poses, name) or _ask(f"pose type of '{name}'", POSE_TYPES) for name in names}
    new = NewManifest(
        name=args.name or name_of_folder(root.resolve()),
        pairs=found.pairs,
        declared=declared or squares_mm,
        calibrations=calibrations,
        cameras=cameras,
        pose_types=poses,
        baselines=_parse_baselines(args.baseline_mm, names),
        angles={name: angle for name in names if (angle := _value_of(given_angles, name)) is not None},
    )
    incomplete = write_manifest(new, target, force=args.force)
    print(target)
    if incomplete is not None:
        note(f"to be completed: {incomplete}")
    return code


def _require_answers(args: argparse.Namespace) -> None:
    """Raise InputError for missing options if there is no terminal to ask for them."""
    needed = {
        "--square-mm": ("side of a square, mm", args.square_mm or args.board or None),
        "--calibration": ("camera's calibration.json", args.calibration or None),
        "--pose-type": (f"pose type of the pairs ({', '.join(POSE_TYPES)})", args.pose_type or None),
    }
    missing = {option: question for option, (question, value) in needed.items() if value is None}
    if missing and (sys.stdin is None or not sys.stdin.isatty()):
        message = "; ".join(f"the {question}: {option}" for option, question in missing.items())
        raise InputError(f"init: images do not show everything; give {message}")


def _parse_calibrations(declared: Sequence[str], folder: Path) -> dict[str, str]:
    """Return camera -> path of its calibration for a manifest in `folder`; existing relative paths are rewritten to
    it. A rig's file is replaced by the files of its cameras, with their names."""
    declared = _of_rigs(declared)
    typical = TWO_CAMERAS if len(declared) == 2 else ONE_CAMERA
    out: dict[str, str] = {}
    for k, words in enumerate(declared):
        name, found, path = words.partition("=")
        if not found or usable_path(words).exists():
            if len(declared) > len(TWO_CAMERAS):
                raise InputError(f"--calibration {words}: of more than two cameras name each, such as wide={words}")
            name, path = typical[k], words
        if check_identifier(name, "camera") in out:
            raise InputError(f"--calibration: two are called '{name}'; name each differently")
        typed = usable_path(path)
        if not typed.is_absolute() and typed.exists():
            path = Path(os.path.relpath(typed, folder)).as_posix()
        out[name] = path
    return out


def _of_rigs(declared: Sequence[str]) -> list[str]:
    """Return `declared` with every rig's file replaced by NAME=FILE of its cameras."""
    from rigkit.io.calibrations.rig_file import is_rig_file
    from rigkit.workflows.inputs.camera_files import files_of_cameras

    out: list[str] = []
    for words in declared:
        path = usable_path(words)
        of_rig = files_of_cameras(path) if is_rig_file(path) else None
        out += [words] if of_rig is None else [f"{name}={own}" for name, own in of_rig.items()]
    return out


def _parse_boards(words: Sequence[str]) -> list[DeclaredBoard]:
    """Return the boards of --board: those of files keep their ids, those in words are plane1, plane2, ... by order."""
    from rigkit.io.boards.board_file import load_board
    from rigkit.io.boards.board_words import board_in_words
    from rigkit.io.manifests.manifest_writer import DeclaredBoard

    out = []
    for number, text in enumerate(words, start=1):
        board = board_in_words(text)
        if board is None:
            out.append(DeclaredBoard(load_board(text), Path(text)))
        else:
            out.append(DeclaredBoard(replace(board, board_id=f"plane{number}")))
    return out


def _cameras_of(
    pairs: Sequence[str], calibrations: dict[str, str], declared: Sequence[str]
) -> dict[str, tuple[str, str]]:
    """Return the two cameras of every pair; raises InputError for unknown cameras, and, with more than two cameras, for
    pairs without --cameras."""
    known = list(calibrations)
    patterns: list[tuple[str, tuple[str, str]]] = []
    for words in declared:
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
        typical = (known[0], known[-1]) if len(known) <= len(TWO_CAMERAS) else None
        found_cameras = _value_of(patterns, pair) or typical
        if found_cameras is None:
            raise InputError(f"init: unknown which cameras took pair '{pair}'; add --cameras {pair}=ONE,TWO")
        out[pair] = found_cameras
    return out


def _parse_pose_types(declared: Sequence[str]) -> list[tuple[str, str]]:
    """Return (pattern of pairs, pose type)."""
    out = []
    for words in declared:
        pattern, _, pose_type = words.rpartition("=")
        if pose_type not in POSE_TYPES:
            raise InputError(f"--pose-type {words}: '{pose_type}' is unknown; known: {', '.join(POSE_TYPES)}")
        out.append((pattern or "*", pose_type))
    return out


def _value_of(declared: Sequence[tuple[str, Value]], name: str) -> Value | None:
    """Return the first value whose pattern matches the pair `name`, or None."""
    return next((value for pattern, value in declared if fnmatch(name, pattern)), None)


def _parse_baselines(declared: Sequence[str], pairs: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return pair -> (mm, sigma mm) from PAIR=MM+-SIGMA, of a single pair MM+-SIGMA; raises InputError for unknown
    pairs and invalid lengths."""
    out = {}
    # Images without any pair are refused afterwards, with how to name them.
    for text in declared if pairs else ():
        name, of, value = text.rpartition("=")
        number, stated, sigma = value.partition("+-")
        if not of and len(pairs) > 1:
            example = f"{pairs[0]}={text}{'' if stated else '+-2'}"
            raise InputError(f"init: --baseline-mm '{text}' names no pair: write PAIR=MM+-SIGMA, such as {example}")
        name = name if of else pairs[0]
        if name not in pairs:
            raise InputError(f"init: --baseline-mm names '{name}'; pairs found: {', '.join(sorted(pairs))}")
        what = f"--baseline-mm '{text}': write PAIR=MM+-SIGMA, such as {name}=300+-2"
        out[name] = (parse_length(what, number), parse_length(what, sigma))
    return out


def _parse_angles(declared: Sequence[str]) -> list[tuple[str, tuple[float, float]]]:
    """Return (pattern of pairs, (degrees, sigma)) from [PAIRS=]DEG+-SIGMA; raises InputError for invalid angles."""
    out = []
    for text in declared:
        pattern, _, value = text.rpartition("=")
        number, _, sigma = value.partition("+-")
        try:
            degrees, sigma_deg = float(number), float(sigma)
        except ValueError:
            degrees = sigma_deg = math.nan
        if not (0.0 <= degrees <= 180.0 and 0.0 < sigma_deg <= 180.0):
            raise InputError(f"--angle-deg '{text}': write [PAIRS=]DEG+-SIGMA, such as 90+-0.3")
        out.append((pattern or "*", (degrees, sigma_deg)))
    return out


def parse_length(what: str, value: str | float) -> float:
    """Return a length in mm; raises InputError unless it is a positive number."""
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0.0):
        raise InputError(f"init: {what}: a positive number of mm is needed, got '{value}'")
    return number


def _ask(question: str, choices: tuple[str, ...] = ()) -> str:
    """Ask at the terminal until there is a valid answer."""
    hint = f" ({', '.join(choices)})" if choices else ""
    while True:
        print(f"{question}{hint}: ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            raise InputError(f"init: the {question} is missing; give it as an option, see rigkit init --help")
        answer = line.strip()
        if answer and (not choices or answer in choices):
            return answer
