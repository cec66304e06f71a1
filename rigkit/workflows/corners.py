"""The corners of a session's images: found twice, kept beside the session, and made into views."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from statistics import median

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.usable import other_size, views_of_image
from rigkit.cameras.base import Camera
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError, RigkitError
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.io.corner_cache import CornerCache, FoundCorners, image_hash
from rigkit.io.images import read_image
from rigkit.io.session import Session

__all__ = ["first_camera", "image_names", "session_corners", "session_views"]

ODD_SIZES = 3
"""A few images of another size are left out; where they are this part of all, which of the sizes is meant?"""
LOOSE = 1.5
"""A first calibration with a scatter of more than this many times the corners' own sigmas is not the lens."""

_log = logging.getLogger(__name__)


def session_views(
    session: Session, found: Mapping[str, FoundCorners]
) -> tuple[list[BoardView], tuple[int, int], list[tuple[str, str]]]:
    """Return the views that the corners found give, the images' size, and (image, reason) of those that give none.

    Raises InputError where there is no view, or the boards clearly have another size than stated.
    """
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
    counts = Counter(item.size_px for item in found.values()).most_common()
    if len(counts) > 1 and ODD_SIZES * counts[1][1] >= len(found):
        first = {item.size_px: name for name, item in reversed(list(found.items()))}
        sizes = " and ".join(f"{w}x{h} px ({n}, such as '{first[w, h]}')" for (w, h), n in counts[:2])
        raise InputError(
            f"{session.path}: images of {sizes}; a camera at one setting has one size: list only the images of one "
            "size in 'images'"
        )
    return counts[0][0]


def session_corners(session: Session, *, progress: Progress = silent) -> dict[str, FoundCorners]:
    """Return the corners of every image by name, from the images or from the cache.

    They are found twice: a first calibration, from the corners of the first time, says how lines bend at every corner,
    which few large squares through a wide lens do not, and what is covered.
    """
    cache = CornerCache(session.corners_path, session.boards)
    found: dict[str, FoundCorners] = {}
    if not session.images:
        found = {name: item for name in cache.images if (item := cache.get(name, None)) is not None}
        if not found:
            whose = "" if session.camera is None else f" of camera '{session.camera}'"
            raise InputError(f"{session.path}: no image matches 'images'{whose}, and no corners are kept beside it")
        _log.info(
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
        _log.info(f"{error}; the corners are used, but not kept")
    return found


def _found_in(path: Path, session: Session, camera: Camera | None) -> FoundCorners:

    image = read_image(path)
    detections = detect_boards(image, session.boards, camera=camera)
    return FoundCorners((image.shape[1], image.shape[0]), detections, camera is not None)


def first_camera(session: Session, found: Mapping[str, FoundCorners]) -> Camera | None:
    """Return a camera calibrated quickly from `found`; None where it cannot be: the calibration proper says why."""
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
