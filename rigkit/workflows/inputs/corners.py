"""The corners of a session's images, detected (and cached beside the session) or read from a file, and their views."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from rigkit.calibration.calibrate import calibrate_together
from rigkit.calibration.choosing.models_tried import Request
from rigkit.calibration.result import Calibration
from rigkit.calibration.views.usable import OTHER_GRIDS, other_size, views_of_image, without_lookalikes
from rigkit.cameras.base import Camera
from rigkit.core.detections import BoardDetection, BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.printing import counted
from rigkit.core.processes import in_threads
from rigkit.core.progress import Progress, silent
from rigkit.detection.detect import detect_boards
from rigkit.io.corners.corner_cache import CornerCache, FoundCorners, image_hash, lens_key
from rigkit.io.corners.corners_file import read_corners
from rigkit.io.manifests.session import Session
from rigkit.io.media.images import read_image
from rigkit.workflows.inputs.identify_board import why_not_detected
from rigkit.workflows.inputs.side_by_side import side_by_side_pictures
from rigkit.workflows.options.cameras import Cache

ODD_SIZES = 3
"""A few images of another size are left out; if they are one in three or more, the session is ambiguous."""
LOOSE = 1.5
"""A first calibration whose residuals exceed the corners' own sigmas by this factor does not fit the lens."""

FirstCheck = Callable[[Session, Mapping[str, FoundCorners], Calibration], None]
"""Called with a camera's session, corners and first calibration."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class SessionCorners:
    """The corners of a session's images.

    Attributes
    ----------
    found : corners by image name, from the last detection.
    unreadable : errors by image name.
    source : where the corners come from, in words.
    """

    found: Mapping[str, FoundCorners]
    unreadable: Mapping[str, str]
    source: str


def session_views(
    session: Session, corners: SessionCorners
) -> tuple[list[BoardView], tuple[int, int], list[tuple[str, str]]]:
    """Return the views of the detected boards, the image size, and (image, reason) for what is left out.

    Raises InputError if there is no view, if the boards clearly have another size than declared, or if images hold the
    pictures of two cameras.
    """
    found = corners.found
    size_px = _common_size(session, found)
    if (halves := side_by_side_pictures(found, session.boards)) is not None:
        raise InputError(f"{session.path}: {halves}")
    paths = named_images(session)
    # The image is named by who reports it.
    dropped = [(n, why.replace(f"image '{paths.get(n)}'", "it", 1)) for n, why in corners.unreadable.items()]
    views: list[BoardView] = []
    boards = without_lookalikes({name: item.detections for name, item in found.items()}, session.boards)
    for name, item in found.items():
        if item.size_px != size_px:
            width, height = item.size_px
            turned = ", turned by some program" if item.size_px == size_px[::-1] else ""
            dropped.append(
                (name, f"{width}x{height} px{turned}, most images with boards have {size_px[0]}x{size_px[1]}")
            )
            continue
        own, reason = views_of_image(name, boards[name], session.boards, session.camera)
        views += own
        if reason is None and len(boards[name]) < len(item.detections):
            reason = OTHER_GRIDS
        if reason is not None:
            dropped.append((name, reason))
    wrong = other_size({name: item.detections for name, item in found.items()}, session.boards)
    if wrong is not None:
        # Nobody reads why the first calibration fails.
        wrong = (_other_size_undeclared(session) if corners.source else None) or wrong
        raise InputError(f"{session.path}: {wrong}; correct columns and rows in --board or the board file")
    if not views:
        reasons = Counter(reason for _, reason in dropped).most_common(1)[0]
        shown = why_not_detected(session.images, session.boards) if corners.source else None
        alone = "look whether that camera saw the boards, else leave it out; or " if session.whose else ""
        raise InputError(
            f"{session.path}: no board can be used in {counted(len(found), 'image')}{session.whose}; "
            + (shown or f"{reasons[1]} times: {reasons[0]}; {alone}check columns and rows in the board file")
        )
    return views, size_px, dropped


def _other_size_undeclared(session: Session) -> str | None:
    """Return `other_size` of corners detected as of no declared board: in some images a larger board passes for one."""
    paths = named_images(session)
    unknown = replace(session, boards=())
    found = in_threads(lambda path: _found_or_error(path, unknown, None), list(paths.values()))
    seen = {name: one.detections for name, one in zip(paths, found, strict=True) if not isinstance(one, InputError)}
    return other_size(seen, session.boards)


def _common_size(session: Session, found: Mapping[str, FoundCorners]) -> tuple[int, int]:
    """Return the most frequent size of the images with boards, or of all images if none shows a board.

    Raises InputError if a third or more have another size.
    """
    counted_ones = [item for item in found.values() if item.detections] or list(found.values())
    counts = Counter(item.size_px for item in counted_ones).most_common()
    if len(counts) > 1 and ODD_SIZES * counts[1][1] >= len(counted_ones):
        first = {item.size_px: name for name, item in reversed(list(found.items()))}
        sizes = " and ".join(f"{w}x{h} px ({n}, such as '{first[w, h]}')" for (w, h), n in counts[:2])
        turned = counts[0][0] == counts[1][0][::-1]
        remedy = (
            "some program turned part of them by a quarter: turn their pixels back to how the camera wrote them, or "
            if turned
            else "a camera at one setting has one size: "
        )
        raise InputError(
            f"{session.path}: images of {sizes}; {remedy}take the images of one size alone, in a folder of their own "
            "or listed in 'images' of a session"
        )
    return counts[0][0]


def session_corners(
    session: Session,
    *,
    cache: Cache = Cache.READ,
    check: FirstCheck | None = None,
    progress: Progress = silent,
) -> SessionCorners:
    """Return the corners of every image by name, detected or from the cache beside the session.

    Corners are detected twice. A first calibration gives the distortion at every corner, which few large squares
    through a wide lens do not show, and where the board is occluded; the second detection uses it, after `check` was
    called with the corners so far and this calibration. An image that cannot
    be read goes into `unreadable`; its error is raised if no image can be read.
    """
    kept = CornerCache(None if cache is Cache.OFF else session.corners_path, session.boards)
    if not session.images:
        return _cached_without_images(session, kept)
    paths = named_images(session)
    hashes = {name: _hash(path) for name, path in paths.items()}
    first = {name: item for name, digest in hashes.items() if (item := kept.get(name, digest)) is not None}
    fresh = [name for name in paths if name not in first]
    unreadable: dict[str, str] = {}

    def look(names: list[str], camera: Camera | None, lens: str | None) -> dict[str, FoundCorners]:
        """Detect the corners of the images of these names and cache them."""
        words = ("corners", "through the lens")[: 1 if camera is None else 2]
        what = " ".join(words if session.camera is None else (*words, "of", session.camera))
        out = {}
        progress(what, 0, len(names))
        each = in_threads(lambda name: _found_or_error(paths[name], session, camera), names)
        for i, (name, found) in enumerate(zip(names, each, strict=True), start=1):
            progress(what, i, len(names))
            if not isinstance(found, InputError):
                kept.put(name, hashes[name], found, lens)
                out[name] = found
                continue
            unreadable[name] = str(found)
            if len(unreadable) == len(paths):
                raise found
        return out

    first |= look(fresh, None, None)
    first = {name: first[name] for name in paths if name in first}
    # An image of another size is of no use: it must not count as new time and again.
    size_px = Counter(item.size_px for item in first.values()).most_common(1)[0][0]
    usable = [name for name in first if first[name].size_px == size_px]
    lens = _lens_of(session, {name: hashes[name] for name in first})
    # All of them, or the corners would depend on which images were added when.
    through = {name: item for name in usable if (item := kept.get(name, hashes[name], lens)) is not None}
    if len(through) < len(usable):
        calibration = first_calibration(session, first)
        if check is not None and calibration is not None:
            check(session, first, calibration)
        through = {} if calibration is None else look(usable, calibration.camera, lens)
    if cache is Cache.UPDATE:
        kept.keep(first)
        _save(kept)
    old = len(first) - len([name for name in fresh if name in first])
    source = f"found in {len(first) - old} images" + (f", kept in {session.corners_path.name} of {old}" if old else "")
    return SessionCorners(found=first | through, unreadable=unreadable, source=source)


def keep_corners(session: Session, found: Mapping[Path, FoundCorners]) -> None:
    """Write corners that `found_in` found in images of a session to its cache, where that has none of them."""
    kept = CornerCache(session.corners_path, session.boards)
    known = {path.resolve(): corners for path, corners in found.items()}
    for name, path in named_images(session).items():
        corners = known.get(path.resolve())
        if corners is not None and kept.get(name, digest := image_hash(path)) is None:
            kept.put(name, digest, corners)
    _save(kept)


def _save(kept: CornerCache) -> None:
    try:
        kept.save()
    except InputError as error:
        _log.info(f"{error}; the corners are used, but not kept")


def _hash(path: Path) -> str:
    """Return the hash of an image, "" if it cannot be opened: the detection reports that."""
    try:
        return image_hash(path)
    except InputError:
        return ""


def _lens_of(session: Session, hashes: Mapping[str, str]) -> str:
    """Return the key of the first calibration of these images."""
    return lens_key(hashes, session.boards, session.model, session.degree)


def _cached_without_images(session: Session, kept: CornerCache) -> SessionCorners:
    """Return the cached corners of a session without images."""
    first = {name: item for name in kept.images if (item := kept.get(name, None)) is not None}
    if not first:
        raise InputError(
            f"{session.path}: no image matches 'images'{session.whose}, and no corners are kept beside it; "
            "correct the pattern"
        )
    lens = _lens_of(session, {name: kept.digest(name) for name in first})
    through = {name: item for name in first if (item := kept.get(name, None, lens)) is not None}
    source = f"the corners of {len(first)} images kept in {session.corners_path.name} are used"
    source += "" if kept.current else ", found by another version of rigkit"
    _log.info(f"{session.path}: no image matches 'images'; {source}")
    return SessionCorners(found=first | through, unreadable={}, source=source)


def found_in(path: Path, session: Session, camera: Camera | None = None) -> FoundCorners:
    """Return the boards in an image, detected with a known `camera`; raises InputError for one that cannot be read."""
    image = read_image(path)
    return FoundCorners((image.shape[1], image.shape[0]), detect_boards(image, session.boards, camera=camera))


def _found_or_error(path: Path, session: Session, camera: Camera | None) -> FoundCorners | InputError:
    try:
        return found_in(path, session, camera)
    except InputError as error:
        return error


def first_calibration(session: Session, found: Mapping[str, FoundCorners]) -> Calibration | None:
    """Return a quick calibration from `found`, without verdicts; None if that fails, which the final one explains."""
    try:
        corners = SessionCorners(found=found, unreadable={}, source="")
        views, size_px, _ = session_views(session, corners)
        # Scaramuzza's model fits any lens roughly; where it fits badly, another may fit better.
        model = "scaramuzza" if session.model == "auto" else session.model
        request = Request(size_px=size_px, model=model, degree=session.degree, board="flat", folds=0, diagnosed=False)
        (first,) = calibrate_together([("", views, request)])
        if session.model == "auto" and first.sigma_px > LOOSE * median(s for v in views for s in v.sigma_px.tolist()):
            (first,) = calibrate_together([("", views, replace(request, model="auto", degree=None))])
        return first
    except (InputError, DegenerateError):
        return None


def named_images(session: Session) -> dict[str, Path]:
    """Return the image paths by file name; with the folder where images of several folders share a name."""
    common = Counter(path.name for path in session.images)
    home = session.path.resolve().parent
    return {p.name if common[p.name] == 1 else Path(os.path.relpath(p, home)).as_posix(): p for p in session.images}


def given_corners(session: Session, path: Path) -> SessionCorners:
    """Return the corners that a file states for the session's images; the images are only read for their size.

    The file is any that `io.corners.corners_file` reads. It names an image by its path, relative to the current folder
    or to the file, or by its file name if that is unique in the file and in the session. Images that it does not name
    have no corners; images that the session does not list are ignored.

    Raises InputError for a damaged file, or one that names no image of the session.
    """
    listed = read_corners(path, session.boards)
    named = named_images(session)
    entries = _entries_of(named, listed, path.parent)
    if not entries:
        first = next(iter(listed), None)
        ours = next(iter(named), None)
        raise InputError(
            f"corners file '{path}' names none of the {len(named)} images{session.whose} of '{session.path}' "
            f"(there '{ours}', here '{first}'); give the corners of these images"
        )
    found, unreadable = {}, {}
    for name, image in named.items():
        try:
            height, width = read_image(image).shape[:2]
        except InputError as error:
            unreadable[name] = str(error)
            continue
        found[name] = FoundCorners((width, height), listed[entries[name]] if name in entries else ())
    if not found:
        raise InputError(next(iter(unreadable.values())))
    others = len(listed) - len(set(entries.values()))
    if others and session.camera is None:
        _log.info(f"{path}: {others} of its {len(listed)} images are not in '{session.path}' and left out")
    return SessionCorners(found=found, unreadable=unreadable, source=f"read from {path.name}")


def _entries_of(
    named: Mapping[str, Path], listed: Mapping[str, tuple[BoardDetection, ...]], folder: Path
) -> dict[str, str]:
    """Return image name -> its name in the file."""
    by_path = {place.resolve(): entry for entry in listed for place in (folder / entry, Path(entry))}
    common = Counter(Path(entry).name for entry in listed)
    by_name = {Path(entry).name: entry for entry in listed if common[Path(entry).name] == 1}
    ours = Counter(image.name for image in named.values())
    out = {}
    for name, image in named.items():
        entry = by_path.get(image.resolve())
        if entry is None and ours[image.name] == 1:
            entry = by_name.get(image.name)
        if entry is not None:
            out[name] = entry
    return out
