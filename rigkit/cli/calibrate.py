"""`rigkit calibrate SESSION.toml`: from a folder of images to calibration.json, or from several to rig.json."""

from __future__ import annotations

import argparse
import math
import os
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from rigkit.core.progress import Progress, silent

if TYPE_CHECKING:
    from rigkit.calibration.result import Calibration
    from rigkit.cameras.base import Camera
    from rigkit.core.detections import BoardView
    from rigkit.io.corner_cache import FoundCorners
    from rigkit.io.session import Session

__all__ = [
    "HELP",
    "add_arguments",
    "calibrate_session",
    "first_camera",
    "page_path",
    "run",
    "session_corners",
    "session_views",
]

ODD_SIZES = 3
"""A few images of another size are left out; where they are this part of all, which of the sizes is meant?"""
LOOSE = 1.5
"""A first calibration with a scatter of more than this many times the corners' own sigmas is not the lens."""
HELP = "calibrate a camera, or several on one mount, from images of chessboards"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("session", type=Path, metavar="SESSION.toml", help="what to calibrate (rigkit.session/1)")
    parser.add_argument("-o", "--output", type=Path, help="default: calibration.json (rig.json) beside the session")
    parser.add_argument(
        "-r",
        "--report",
        nargs="?",
        const="",
        metavar="FILE.html",
        help="write a page to look at; without a name beside the output",
    )
    parser.add_argument("--force", action="store_true", help="replace existing results")
    parser.add_argument("--json", action="store_true", help="print the result for programs")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.console import note, print_json, progress_on_stderr
    from rigkit.io.calibration_file import calibration_text
    from rigkit.io.files import ensure_writable, write_together
    from rigkit.io.rig_session import is_rig_session
    from rigkit.io.session import load_session

    if is_rig_session(args.session):
        from rigkit.cli.calibrate_rig import run_rig

        return run_rig(args)
    session = load_session(args.session)
    target = args.output or session.calibration_path
    page = page_path(args.report, target)
    ensure_writable([target, *page], force=args.force, inputs=[session.path, *session.images])
    started = time.monotonic()
    calibration = calibrate_session(session, progress_on_stderr())
    files = {target: calibration_text(calibration)}
    for path in page:
        from rigkit.cli.calibration_report import report_page

        files |= {path: report_page(session, calibration, files)}
    write_together(files, force=args.force)
    note(f"{', '.join(str(p) for p in (target, *page))} written, {time.monotonic() - started:.1f} s")
    if args.json:
        print_json(summary(calibration))
    else:
        print(describe(calibration))
    return 0


def page_path(asked: str | None, target: Path) -> list[Path]:
    """Return where the page goes, or nothing where none is asked for."""
    if asked is None:
        return []
    return [Path(asked) if asked else target.with_suffix(".html")]


def calibrate_session(session: Session, progress: Progress = silent) -> Calibration:
    """Return the calibration of a session: images -> corners (kept beside the session) -> calibration.

    Raises InputError where no image shows a board of the session, DegenerateError where the views do not determine the
    camera.
    """
    from dataclasses import replace

    from rigkit.calibration.calibrate import calibrate
    from rigkit.calibration.rig.board_ties import suggest_ties
    from rigkit.calibration.verdicts import judge_session

    views, size_px, dropped = session_views(session, session_corners(session, progress))
    result = calibrate(
        views,
        size_px,
        model=session.model,
        degree=session.degree,
        board=session.board_shape,
        progress=progress,
    )
    verdicts = judge_session(result, dropped, suggest_ties(views, result))
    return replace(result, dropped=(*dropped, *result.dropped), verdicts=verdicts)


def session_views(
    session: Session, found: Mapping[str, FoundCorners]
) -> tuple[list[BoardView], tuple[int, int], list[tuple[str, str]]]:
    """Return the views that the corners found give, the images' size, and (image, reason) of those that give none.

    Raises InputError where there is no view, or the boards clearly have another size than stated.
    """
    from rigkit.calibration.usable import other_size, views_of_image
    from rigkit.core.errors import InputError

    size_px = _common_size(session, found)
    views, dropped = [], []
    for name, item in found.items():
        if item.size_px != size_px:
            width, height = item.size_px
            dropped.append((name, f"{width}x{height} px, most images have {size_px[0]}x{size_px[1]}"))
            continue
        own, reason = views_of_image(name, item.detections, session.boards)
        views += own
        if reason is not None:
            dropped.append((name, reason))
    if not views:
        reasons = Counter(reason for _, reason in dropped).most_common(1)[0]
        camera = "" if session.camera is None else f" of camera '{session.camera}'"
        raise InputError(
            f"{session.path}: no board can be used in {len(found)} images{camera}; {reasons[1]} times: {reasons[0]}; "
            "check columns and rows in the board file"
        )
    wrong = other_size([d for item in found.values() for d in item.detections], session.boards)
    if wrong is not None:
        raise InputError(f"{session.path}: {wrong}; correct columns and rows in the board file")
    return views, size_px, dropped


def _common_size(session: Session, found: Mapping[str, FoundCorners]) -> tuple[int, int]:
    """Return the size that most images have; raises InputError where as many as a third have another."""
    from rigkit.core.errors import InputError

    counts = Counter(item.size_px for item in found.values()).most_common()
    if len(counts) > 1 and ODD_SIZES * counts[1][1] >= len(found):
        first = {item.size_px: name for name, item in reversed(list(found.items()))}
        sizes = " and ".join(f"{w}x{h} px ({n}, such as '{first[w, h]}')" for (w, h), n in counts[:2])
        raise InputError(
            f"{session.path}: images of {sizes}; a camera at one setting has one size: list only the images of one "
            "size in 'images'"
        )
    return counts[0][0]


def session_corners(session: Session, progress: Progress) -> dict[str, FoundCorners]:
    """Return the corners of every image by name, from the images or from the cache.

    They are found twice: a first calibration, from the corners of the first time, says how lines bend at every corner,
    which few large squares through a wide lens do not, and what is covered.
    """
    from rigkit.cli.console import note
    from rigkit.core.errors import InputError
    from rigkit.io.corner_cache import CornerCache, image_hash

    cache = CornerCache(session.corners_path, session.boards)
    found: dict[str, FoundCorners] = {}
    if not session.images:
        found = {name: item for name in cache.images if (item := cache.get(name, None)) is not None}
        if not found:
            whose = "" if session.camera is None else f" of camera '{session.camera}'"
            raise InputError(f"{session.path}: no image matches 'images'{whose}, and no corners are kept beside it")
        note(
            f"{session.path}: no image matches 'images'; the corners of {len(found)} images kept in "
            f"{session.corners_path.name} are used" + ("" if cache.current else ", found by another version of rigkit")
        )
    hashes = {name: image_hash(path) for path, name in zip(session.images, image_names(session), strict=True)}
    paths = dict(zip(hashes, session.images, strict=True))
    for name, digest in hashes.items():
        item = cache.get(name, digest)
        if item is not None:
            found[name] = item

    def look(names: list[str], camera: Camera | None) -> None:
        """Find the corners in the images of these names and remember them."""
        words = ("corners", "through the lens")[: 1 if camera is None else 2]
        what = " ".join(words if session.camera is None else (*words, "of", session.camera))
        for i, name in enumerate(names):
            progress(what, i, len(names))
            found[name] = _found_in(paths[name], session, camera)
            cache.put(name, hashes[name], found[name])
        progress(what, len(names), len(names))

    look([name for name in paths if name not in found], None)
    # An image of another size is of no use: it must not count as new time and again.
    size_px = Counter(item.size_px for item in found.values()).most_common(1)[0][0]
    usable = [name for name in paths if found[name].size_px == size_px]
    # All of them, or the corners would depend on which images were added when.
    new = not all(found[name].through_camera for name in usable)
    camera = first_camera(session, found) if new else None
    if camera is not None:
        look(usable, camera)
    found = {name: found[name] for name in paths or found}
    if paths:
        cache.keep(paths)
    try:
        cache.save()
    except InputError as error:
        note(f"{error}; the corners are used, but not kept")
    return found


def _found_in(path: Path, session: Session, camera: Camera | None) -> FoundCorners:
    from rigkit.detection.detect import detect_boards
    from rigkit.io.corner_cache import FoundCorners
    from rigkit.io.images import read_image

    image = read_image(path)
    detections = detect_boards(image, session.boards, camera=camera)
    return FoundCorners((image.shape[1], image.shape[0]), detections, camera is not None)


def first_camera(session: Session, found: Mapping[str, FoundCorners]) -> Camera | None:
    """Return a camera calibrated quickly from `found`; None where it cannot be: the calibration proper says why."""
    from rigkit.calibration.calibrate import calibrate
    from rigkit.core.errors import RigkitError

    try:
        views, size_px, _ = session_views(session, found)
        # Scaramuzza's model takes any lens; what it does not follow closely, another may.
        model = "scaramuzza" if session.model == "auto" else session.model
        first = calibrate(views, size_px, model=model, degree=session.degree, board="flat")
        if session.model == "auto" and first.sigma_px > LOOSE * median(s for v in views for s in v.sigma_px.tolist()):
            first = calibrate(views, size_px, model="auto", board="flat")
        return first.camera
    except RigkitError:
        return None


def image_names(session: Session) -> list[str]:
    """Return a name for each image: of two that are called alike in several folders, with the folder."""
    common = Counter(path.name for path in session.images)
    home = session.path.resolve().parent
    return [
        path.name if common[path.name] == 1 else Path(os.path.relpath(path, home)).as_posix() for path in session.images
    ]


def summary(calibration: Calibration) -> dict[str, Any]:
    """Return the figures for programs."""
    camera = calibration.camera
    return {
        "model": camera.model,
        "size_px": list(camera.size_px),
        "parameters": dict(zip(camera.parameter_names(), camera.parameters.tolist(), strict=True)),
        "heldout_rms_px": calibration.heldout_rms_px,
        "rms_px": calibration.rms_px,
        "sigma_px": calibration.sigma_px,
        "views": [{"image": v.image, "board": v.board_id, "rms_px": v.rms_px} for v in calibration.views],
        "dropped": [{"image": image, "reason": reason} for image, reason in calibration.dropped],
        "outliers": len(calibration.outliers),
        "verdicts": [str(finding) for finding in calibration.verdicts],
    }


def describe(calibration: Calibration) -> str:
    """Return the result for a person: the headline first."""
    camera = calibration.camera
    held = calibration.heldout_rms_px
    headline = "held-out RMS not available (too few images)" if held is None else f"held-out RMS {held:.4f} px"
    lines = [
        f"{camera.model}, {camera.size_px[0]}x{camera.size_px[1]} px: {headline}",
        f"training RMS {calibration.rms_px:.4f} px (2-D per corner, {calibration.corner_count} corners in "
        f"{len(calibration.views)} views), {len(calibration.outliers)} outliers, {len(calibration.dropped)} images "
        "dropped",
    ]
    sigmas = calibration.parameter_sigmas
    for name, value, sigma in zip(camera.parameter_names(), camera.parameters, sigmas, strict=True):
        lines.append(f"  {name:>4} = {value:.9g} +- {sigma:.2g}")
    lines += [f"dropped {image}: {reason}" for image, reason in calibration.dropped]
    lines += [
        f"tried {c.name}: held-out {'-' if c.heldout_rms_px is None else format(c.heldout_rms_px, '.4f')} px, "
        f"training {c.rms_px:.4f} px{f' (chosen: {c.reason})' if c.chosen else ''}"
        for c in calibration.candidates
        if math.isfinite(c.rms_px)
    ]
    lines += [f"{c.name}: {c.reason}" for c in calibration.candidates if not math.isfinite(c.rms_px)]
    return "\n".join([*lines, *map(str, calibration.verdicts)])
