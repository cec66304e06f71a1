"""Calibration of one camera from its session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.judging.verdicts import diagnose_session
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.board_ties import suggest_rigid_boards
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Finding, Severity
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.io.calibrations.calibration_file import calibration_text
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, write_together
from rigkit.io.manifests.rig_session import RigSession
from rigkit.io.manifests.session import Session, files_of_session, load_session
from rigkit.workflows.calibration.session_page import session_page
from rigkit.workflows.inputs.corners import SessionCorners, given_corners, named_images, session_corners, session_views
from rigkit.workflows.inputs.identify_board import why_misplaced
from rigkit.workflows.inputs.image_faults import black_borders, interlaced, wrong_print
from rigkit.workflows.options.cameras import CalibrateOptions
from rigkit.workflows.outputs.calibration_paths import calibration_paths
from rigkit.workflows.outputs.export_camera import foreign_files
from rigkit.workflows.outputs.provenance import provenance_of


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class SessionCalibration:
    """The calibration of a session.

    Attributes
    ----------
    session : the session.
    calibration : camera, covariance and verdicts.
    unreadable : errors by name of images that cannot be read.
    written : files written: the calibration, then exports and the page.
    """

    session: Session
    calibration: Calibration
    unreadable: Mapping[str, str]
    written: tuple[Path, ...]

    __repr__ = brief

    def _repr_html_(self) -> str:
        return self.calibration._repr_html_()


def calibrate_session(
    session: Session | str | Path, options: CalibrateOptions | None = None, *, progress: Progress = silent
) -> SessionCalibration:
    """Calibrate the camera of a session (loaded, or its file) and write the files of `options`.

    Raises InputError: no image shows a board of the session, or a file cannot be written (checked first);
    DegenerateError: the views do not determine the camera.
    """
    options = options or CalibrateOptions()
    if not isinstance(session, Session):
        session = load_session(session)
    ensure_writable(calibration_paths([""], options), force=options.force, inputs=session_inputs(session, options))
    with about(session.path):
        corners = corners_of(session, options, progress=progress)
    calibration = calibration_from(session, corners, pupil=options.pupil, progress=progress)
    files: dict[Path, str] = {}
    if options.output is not None:
        files[options.output] = calibration_text(calibration, provenance_of(session.path, {"": session.images}))
        files |= foreign_files(calibration, options.output, options.exports)
    if options.report is not None:
        files[options.report] = session_page(session, calibration, corners, files)
    write_together(files, force=options.force)
    return SessionCalibration(
        session=session, calibration=calibration, unreadable=corners.unreadable, written=tuple(files)
    )


def corners_of(session: Session, options: CalibrateOptions, *, progress: Progress = silent) -> SessionCorners:
    """Return the corners of a camera's images, from the file `options.corners` or detected."""
    if options.corners is not None:
        return given_corners(session, options.corners)
    return session_corners(session, cache=options.cache, progress=progress)


def session_inputs(session: Session | RigSession, options: CalibrateOptions) -> list[Path]:
    """Return all files that a calibration reads; results never replace them."""
    cameras = session.cameras.values() if isinstance(session, RigSession) else [session]
    out = [path for own in cameras for path in (*own.images, own.corners_path)]
    # A session made in Python need not have a file.
    out += files_of_session(session.path) if session.path.is_file() else [session.path]
    out += options.known.files
    return out if options.corners is None else [*out, options.corners]


def calibration_from(
    session: Session, corners: SessionCorners, *, pupil: str = "auto", progress: Progress = silent
) -> Calibration:
    """Return the calibration of a session from its corners.

    Raises InputError if no image shows a board of the session, DegenerateError if the views do not determine the
    camera.
    """
    views, size_px, dropped = session_views(session, corners)
    with about(session.path):
        try:
            result = calibrate(
                views,
                size_px,
                model=session.model,
                degree=session.degree,
                board=session.board_shape,
                pupil=pupil,
                progress=progress,
            )
        except DegenerateError as error:
            shown = why_misplaced(session.images, session.boards, progress)
            if shown is None:
                raise
            raise InputError(f"{shown} ({error})") from error
    images = named_images(session)
    prints = wrong_print(views, images)
    also = [*suggest_rigid_boards(views, result), *interlaced(result, images), *black_borders(result, images), *prints]
    verdicts = diagnose_session(result, dropped, also)
    if verdicts[0].severity is Severity.BAD:
        shown = why_misplaced(session.images, session.boards, progress)
        if shown is not None and 2 * len(views) < len(session.images):
            # The few views of the declared board are misread.
            raise InputError(f"{session.path}: {shown}")
        if shown is not None:
            # It names the print, too.
            verdicts = (verdicts[0], Finding.bad(shown), *(one for one in verdicts[1:] if one not in prints))
    return replace(result, dropped=(*dropped, *result.dropped), verdicts=verdicts)
