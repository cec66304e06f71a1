"""The page of a session's calibration, with what it reads from files: thumbnails of the images, and hashes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.io.manifests.rig_session import RigSession
from rigkit.io.manifests.session import Session
from rigkit.io.media.images import read_image
from rigkit.planning.plan import Plan
from rigkit.report.pages.calibration_page import CalibrationSection, build_calibration_page, thumbnail_jpeg
from rigkit.validation.check import Check
from rigkit.workflows.calibration.next_pictures import next_views
from rigkit.workflows.inputs.corners import SessionCorners, named_images
from rigkit.workflows.outputs.provenance import digest_line, digest_of_images, software_facts

MAX_PICTURES = 240
"""A thumbnail has 20 kB: with 3000 of them the page had 64 MB."""


def plans_of(sessions: Mapping[str, Session], shown: Mapping[str, Calibration]) -> dict[str, Plan]:
    """Return the images to take next of each camera for which there is a plan."""
    plans = {}
    for name, calibration in shown.items():
        with suppress(InputError, DegenerateError):
            plans[name] = next_views(calibration, sessions[name].boards)
    return plans


def session_page(
    session: Session, calibration: Calibration, plan: Plan | None, corners: SessionCorners, files: Mapping[Path, str]
) -> str:
    """Return the page of a session's calibration; `files` (path -> content) are the results written with it."""
    name = session.path.resolve().parent.name
    section = CalibrationSection(name, calibration, _thumbnails(session, calibration), plan)
    lead = f"{session.path.name} with {_boards_in_words(session.boards)}"
    facts = _facts(session.path, files, {"images": session.images}, {"corners": corners.source})
    return build_calibration_page(f"rigkit calibration: {name}", lead, [section], facts)


def rig_page(
    session: RigSession,
    rig: RigCalibration,
    shown: Mapping[str, Calibration],
    plans: Mapping[str, Plan],
    checks: Sequence[Check],
    corners: Mapping[str, SessionCorners],
    files: Mapping[Path, str],
) -> str:
    """Return the page of a rig, with the calibration `shown` of each camera and its plan; `files` as for
    `session_page`."""
    name = session.path.resolve().parent.name
    sections = [
        CalibrationSection(camera, calibration, _thumbnails(session.cameras[camera], calibration), plans.get(camera))
        for camera, calibration in shown.items()
    ]
    boards = _boards_in_words(next(iter(session.cameras.values())).boards)
    cameras = "every camera as calibrated alone" if len(rig.cameras) > 1 else "the camera"
    lead = f"{session.path.name} with {boards}: the rig first, then {cameras}"
    images = {f"images of {camera}": own.images for camera, own in session.cameras.items()}
    sources = {f"corners of {camera}": found.source for camera, found in corners.items()}
    facts = _facts(session.path, files, images, sources)
    return build_calibration_page(f"rigkit rig calibration: {name}", lead, sections, facts, rig, checks)


def _boards_in_words(boards: Sequence[Board]) -> str:
    return ("board " if len(boards) == 1 else "boards ") + ", ".join(
        f"'{b.board_id}' ({b.columns} x {b.rows} corners, {b.square_x_mm:g} x {b.square_y_mm:g} mm)" for b in boards
    )


def _thumbnails(session: Session, calibration: Calibration) -> dict[str, bytes]:
    """Return thumbnails (JPEG) by image, with the corners found in it: of all images, or, if they are more than
    MAX_PICTURES, of those left out and those with the largest errors."""
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
                # The corners may be cached, and the image itself damaged since.
                continue
    return out


def _facts(
    session: Path, files: Mapping[Path, str], images: Mapping[str, Sequence[Path]], corners: Mapping[str, str]
) -> dict[str, str]:
    """Return versions, hashes and sources that the page states for reproducibility."""
    facts = software_facts() | {session.name: digest_line(session)}
    facts |= {path.name: digest_line(text) for path, text in files.items()}
    for name, paths in images.items():
        facts[name] = digest_of_images(paths) or "gone; the corners kept beside the session were used"
    return facts | dict(corners)
