"""The page of a session's calibration: what it needs from the disk is thumbnails of the images, and hashes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.io.manifests.rig_session import RigSession
from rigkit.io.manifests.session import Session
from rigkit.io.media.images import read_image
from rigkit.report.pages.calibration_page import CalibrationSection, build_calibration_page, thumbnail_jpeg
from rigkit.validation.check import Check
from rigkit.workflows.calibration.next_pictures import next_views
from rigkit.workflows.inputs.corners import SessionCorners, named_images
from rigkit.workflows.outputs.provenance import digest_line, digest_of_images, software_facts

MAX_PICTURES = 240
"""Each is 20 kB on the page: with those of 3000 images it had 64 MB."""


def session_page(session: Session, calibration: Calibration, corners: SessionCorners, files: Mapping[Path, str]) -> str:
    """Return the page of a session's calibration, which is written to `files` (path -> content) beside it."""
    name = session.path.resolve().parent.name
    section = _section(name, session, calibration)
    lead = f"{session.path.name} with {_boards_in_words(session.boards)}"
    facts = _facts(session.path, files, {"images": session.images}, {"corners": corners.source})
    return build_calibration_page(f"rigkit calibration: {name}", lead, [section], facts)


def rig_page(
    session: RigSession,
    rig: RigCalibration,
    shown: Mapping[str, Calibration],
    checks: Sequence[Check],
    corners: Mapping[str, SessionCorners],
    files: Mapping[Path, str],
) -> str:
    """Return the page of a rig, which is written to `files` (path -> content) beside it: what the cameras share, then
    each camera as `shown`."""
    name = session.path.resolve().parent.name
    sections = [_section(own, session.cameras[own], c) for own, c in shown.items()]
    boards = _boards_in_words(next(iter(session.cameras.values())).boards)
    then = "then every camera as calibrated alone" if len(rig.cameras) > 1 else "then the camera"
    lead = f"{session.path.name} with {boards}: the rig first, {then}"
    images = {f"images of {own}": s.images for own, s in session.cameras.items()}
    sources = {f"corners of {own}": found.source for own, found in corners.items()}
    facts = _facts(session.path, files, images, sources)
    return build_calibration_page(f"rigkit rig calibration: {name}", lead, sections, facts, rig, checks)


def _section(name: str, session: Session, calibration: Calibration) -> CalibrationSection:
    """Return one camera with thumbnails, and with the pictures to take next where there are any to be found."""
    try:
        plan = next_views(calibration, session.boards)
    except (InputError, DegenerateError):
        plan = None
    return CalibrationSection(name, calibration, _thumbnails(session, calibration), plan)


def _boards_in_words(boards: Sequence[Board]) -> str:
    return ("board " if len(boards) == 1 else "boards ") + ", ".join(
        f"'{b.board_id}' ({b.columns} x {b.rows} corners, {b.square_x_mm:g} x {b.square_y_mm:g} mm)" for b in boards
    )


def _thumbnails(session: Session, calibration: Calibration) -> dict[str, bytes]:
    """Return a small picture of every image that is there, used or left out, with the corners found in it; of many
    images those that are left out, and those with the largest errors."""
    views: dict[str, list[ViewResult]] = {image: [] for image, _ in calibration.dropped}
    worst = dict.fromkeys(views, np.inf)
    for view in calibration.views:
        views.setdefault(view.image, []).append(view)
        error = float((view.residuals_px[view.kept] ** 2).sum(axis=-1).mean()) if view.kept.any() else np.inf
        worst[view.image] = max(worst.get(view.image, 0.0), error)
    shown = set(sorted(worst, key=lambda name: worst[name])[-MAX_PICTURES:])
    out = {}
    for name, path in named_images(session).items():
        if name in shown:
            try:
                out[name] = thumbnail_jpeg(read_image(path), views[name], count=len(session.images))
            except InputError:
                # Corners are kept beside the session: the image itself may have gone bad since.
                continue
    return out


def _facts(
    session: Path, files: Mapping[Path, str], images: Mapping[str, Sequence[Path]], corners: Mapping[str, str]
) -> dict[str, str]:
    """Return what somebody needs to know to get the same page again."""
    facts = software_facts() | {session.name: digest_line(session)}
    facts |= {path.name: digest_line(text) for path, text in files.items()}
    for name, paths in images.items():
        facts[name] = digest_of_images(paths) or "gone; the corners kept beside the session were used"
    return facts | dict(corners)
