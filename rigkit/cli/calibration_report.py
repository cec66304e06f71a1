"""What the page of a calibration needs from the disk: thumbnails of the images, versions and hashes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigkit.calibration.result import Calibration, ViewResult
    from rigkit.calibration.rig.result import RigCalibration
    from rigkit.core.boards import Board
    from rigkit.io.rig_session import RigSession
    from rigkit.io.session import Session
    from rigkit.validation.checks import Check

__all__ = ["report_page", "rig_report_page"]


def report_page(session: Session, calibration: Calibration, files: Mapping[Path, str]) -> str:
    """Return the page of a session's calibration, which is written to `files` (path -> content) beside it."""
    from rigkit.report.calibration_page import CalibrationSection, build_calibration_page

    name = session.path.resolve().parent.name
    section = CalibrationSection(name, calibration, _thumbnails(session, calibration))
    lead = f"{session.path.name} with {_boards_in_words(session.boards)}"
    facts = _provenance(session.path, files, {"images": session.images})
    return build_calibration_page(f"rigkit calibration: {name}", lead, [section], facts)


def rig_report_page(
    session: RigSession, rig: RigCalibration, checks: Sequence[Check], files: Mapping[Path, str]
) -> str:
    """Return the page of a rig, which is written to `files` (path -> content) beside it: what the cameras share, then
    each camera alone."""
    from rigkit.cli.calibrate_rig import judged
    from rigkit.report.calibration_page import CalibrationSection, build_calibration_page
    from rigkit.report.rig_tables import rig_tables

    name = session.path.resolve().parent.name
    # One camera is shown as its boards on one mount have it: that is what its file says.
    several = rig.single if len(rig.cameras) > 1 else ()
    sections = [
        CalibrationSection(own, shown, _thumbnails(session.cameras[own], shown))
        for own, shown in zip(session.cameras, several or [judged(rig.cameras[0].calibration)], strict=True)
    ]
    boards = _boards_in_words(next(iter(session.cameras.values())).boards)
    then = "then every camera as calibrated alone" if several else "then the camera"
    lead = f"{session.path.name} with {boards}: the rig first, {then}"
    facts = _provenance(session.path, files, {f"images of {own}": s.images for own, s in session.cameras.items()})
    return build_calibration_page(f"rigkit rig calibration: {name}", lead, sections, facts, rig_tables(rig, checks))


def _boards_in_words(boards: Sequence[Board]) -> str:
    return ("board " if len(boards) == 1 else "boards ") + ", ".join(
        f"'{b.board_id}' ({b.columns} x {b.rows} corners, {b.square_x_mm:g} x {b.square_y_mm:g} mm)" for b in boards
    )


def _thumbnails(session: Session, calibration: Calibration) -> dict[str, bytes]:
    """Return a small picture of every image that is there, used or left out, with the corners found in it."""
    from rigkit.cli.calibrate import image_names
    from rigkit.core.errors import InputError
    from rigkit.io.images import read_image
    from rigkit.report.calibration_page import thumbnail_jpeg

    views: dict[str, list[ViewResult]] = {image: [] for image, _ in calibration.dropped}
    for view in calibration.views:
        views.setdefault(view.image, []).append(view)
    out = {}
    for path, name in zip(session.images, image_names(session), strict=True):
        if name in views:
            try:
                out[name] = thumbnail_jpeg(read_image(path), views[name])
            except InputError:
                # Corners are kept beside the session: the image itself may have gone bad since.
                continue
    return out


def _provenance(session: Path, files: Mapping[Path, str], images: Mapping[str, Sequence[Path]]) -> dict[str, str]:
    """Return what somebody needs to know to get the same page again."""
    import hashlib
    import platform
    from datetime import UTC, datetime
    from importlib.metadata import version

    from rigkit.io.corner_cache import image_hash

    facts = {"rigkit": version("rigkit"), "Python": platform.python_version()}
    facts |= {name: version(name) for name in ("numpy", "opencv-contrib-python-headless")}
    facts["written"] = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    facts[session.name] = f"SHA-256 {image_hash(session)}"
    for path, text in files.items():
        facts[path.name] = f"SHA-256 {hashlib.sha256(text.encode()).hexdigest()}"
    for name, paths in images.items():
        if paths:
            digests = "".join(f"{image_hash(p)}  {p.name}\n" for p in paths)
            digest = hashlib.sha256(digests.encode()).hexdigest()
            facts[name] = f"{len(paths)} files; SHA-256 of what `sha256sum` prints of them: {digest}"
        else:
            facts[name] = "gone; the corners kept beside the session were used"
    return facts
