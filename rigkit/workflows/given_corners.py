"""The corners of a session's images from a file, ours or another detector's, instead of from the images."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.io.corner_cache import FoundCorners
from rigkit.io.corners_file import read_corners
from rigkit.io.images import read_image
from rigkit.io.session import Session
from rigkit.workflows.corners import SessionCorners, named_images

_log = logging.getLogger(__name__)


def given_corners(session: Session, path: Path) -> SessionCorners:
    """Return the corners that a file has of the session's images, which are only read for their size.

    The file is any that `rigkit.io.corners_file.read_corners` reads. It names an image by its path, as seen from here
    or from the file, or by its own name where only one image of the file and one of the session are called so. Images
    that it does not name have no corners; those of the file that the session does not list are left out.

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
    """Return name of the image -> what the file calls it."""
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
