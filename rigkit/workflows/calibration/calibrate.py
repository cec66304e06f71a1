"""Calibration from a session: of one camera, or of a rig (several cameras, or one camera and boards on one mount)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import outline_of_corners
from rigkit.calibration.diagnosis.verdicts import diagnose, diagnose_session
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.board_ties import suggest_rigid_boards
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Finding, Severity
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.io.calibrations.calibration_file import calibration_text
from rigkit.io.calibrations.rig_file import board_rigs_text, rig_text
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, write_together
from rigkit.io.manifests.rig_session import RigSession, frames_of_images, load_any_session, load_rig_session
from rigkit.io.manifests.session import Session, files_of_session, load_session
from rigkit.planning.plan import Plan
from rigkit.report.pages.calibration_facts import camera_facts, rig_facts
from rigkit.report.pages.page_facts import PageFacts
from rigkit.validation.check import Check, compare_angle, compare_baseline, compare_distance
from rigkit.validation.checks import COVERAGE
from rigkit.workflows.calibration.rigid_boards import named_as_listed, named_by_rule, require_distinct
from rigkit.workflows.calibration.session_page import plans_of, rig_page, session_page
from rigkit.workflows.inputs.corners import (
    FirstCheck,
    SessionCorners,
    given_corners,
    named_images,
    session_corners,
    session_views,
)
from rigkit.workflows.inputs.identify_board import why_misplaced
from rigkit.workflows.inputs.image_faults import black_borders, interlaced, wrong_print
from rigkit.workflows.inputs.known_cameras import known_cameras, known_cameras_first, with_known
from rigkit.workflows.inputs.layout_evidence import check_of_moments
from rigkit.workflows.options.cameras import CalibrateOptions
from rigkit.workflows.outputs.calibration_paths import boards_path, calibration_paths, camera_exports, camera_path
from rigkit.workflows.outputs.export_camera import foreign_files, foreign_rig_files
from rigkit.workflows.outputs.provenance import provenance_of

MIN_SHARE_SHOWN = 0.8
"""Share of a board's corners that some image of a session nearly always shows. With the first mark numbered wrongly,
each image lacks those whose marks are not on the declared board; then the board is identified once more. Not measured:
a smaller share only identifies less often."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class SessionCalibration:
    """The calibration of a session.

    Attributes
    ----------
    session : the session.
    calibration : camera, covariance and verdicts.
    unreadable : errors by name of images that cannot be read.
    written : files written: the calibration, exports and the page; of folders then those of the new session.
    plan : images to take next, if the options ask for them and there is a plan.
    """

    session: Session
    calibration: Calibration
    unreadable: Mapping[str, str]
    written: tuple[Path, ...]
    plan: Plan | None = None

    __repr__ = brief

    def _repr_html_(self) -> str:
        return self.calibration._repr_html_()

    @property
    def page(self) -> PageFacts:
        """The facts on the page."""
        return camera_facts(self.calibration, self.plan)


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
        files[options.output] = calibration_text(calibration, provenance_of(session))
        files |= foreign_files(calibration, options.output, options.exports)
    plan = plans_of({"": session}, {"": calibration}).get("") if options.report or options.plan else None
    if options.report is not None:
        files[options.report] = session_page(session, calibration, plan, corners, files)
    write_together(files, force=options.force)
    return SessionCalibration(
        session=session, calibration=calibration, unreadable=corners.unreadable, written=tuple(files), plan=plan
    )


def corners_of(
    session: Session, options: CalibrateOptions, *, check: FirstCheck | None = None, progress: Progress = silent
) -> SessionCorners:
    """Return the corners of a camera's images, from the file `options.corners` or detected; `check` as for
    `session_corners`."""
    if options.corners is not None:
        return given_corners(session, options.corners)
    return session_corners(session, cache=options.cache, check=check, progress=progress)


def session_inputs(session: Session | RigSession, options: CalibrateOptions) -> list[Path]:
    """Return all files that a calibration reads; results never replace them."""
    out = [path for own in session.cameras.values() for path in (*own.images, own.corners_path)]
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
    elif _mostly_hidden(session.boards, views):
        shown = why_misplaced(session.images, session.boards, progress)
        verdicts = (*verdicts, *(() if shown is None else (Finding.look(shown),)))
    return replace(result, dropped=(*dropped, *result.dropped), verdicts=verdicts)


def _mostly_hidden(boards: Iterable[Board], views: Sequence[BoardView]) -> bool:
    """Return whether no view of some board with marks shows most of its corners, as if these were numbered
    otherwise."""
    most: dict[str, int] = {}
    for view in views:
        name = view.board.board_id
        most[name] = max(most.get(name, 0), len(view.grid))
    marked = [board for board in boards if board.identified and board.board_id in most]
    return any(most[board.board_id] < MIN_SHARE_SHOWN * board.corner_count for board in marked)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class RigSessionCalibration:
    """The calibration of a rig's session.

    Attributes
    ----------
    session : the session.
    rig : cameras, their poses, covariance and verdicts.
    checks : comparison with the distances and angles that a person measured.
    unreadable : errors by name of images that cannot be read.
    written : files written.
    plans : images to take next, by camera, as in `SessionCalibration`.
    """

    session: RigSession
    rig: RigCalibration
    checks: tuple[Check, ...]
    unreadable: Mapping[str, str]
    written: tuple[Path, ...]
    plans: Mapping[str, Plan] = field(default_factory=dict)

    __repr__ = brief

    def _repr_html_(self) -> str:
        return self.rig._repr_html_()

    @property
    def passed(self) -> bool:
        """Whether all measurements agree."""
        return all(check.passed for check in self.checks)

    @property
    def page(self) -> PageFacts:
        """The facts on the page, of the rig and of its cameras."""
        shown = cameras_on_page(self.rig, self.session).items()
        return rig_facts(self.rig, self.checks, {name: camera_facts(c, self.plans.get(name)) for name, c in shown})


def calibrate_rig_session(
    session: RigSession | str | Path, options: CalibrateOptions | None = None, *, progress: Progress = silent
) -> RigSessionCalibration:
    """Calibrate the rig of a session (loaded, or its file) and write the files of `options`.

    Raises InputError: a camera's images show no board, the images cannot be assigned to moments, boards cannot be told
    apart, or a file cannot be written (checked first); DegenerateError: the views do not determine a camera.
    """
    options = options or CalibrateOptions()
    if not isinstance(session, RigSession):
        session = load_rig_session(session)
    with about(session.path):
        session = known_cameras_first(with_known(session, options.known))
        known_cameras(session)  # complaints before the work
        images = {name: [str(image) for image in own.images] for name, own in session.cameras.items()}
        # Without images, the corners that were kept are used.
        named = len(images) > 1 and all(images.values()) and session.frames != "order"
        if named:
            frames_of_images(images, session.frames)
        require_distinct(session)
    names = list(session.cameras)
    targets = calibration_paths(names, options, rigid_boards=bool(session.rigid_boards))
    ensure_writable(targets, force=options.force, inputs=session_inputs(session, options))
    with about(session.path):
        # Boards on one mount are known apart by the joint solution only.
        check = check_of_moments(session) if named and not session.rigid_boards else None
        corners = {
            name: corners_of(own, options, check=check, progress=progress) for name, own in session.cameras.items()
        }
        rig = rig_from(session, corners, pupil=options.pupil, progress=progress)
        checks = measured_checks(session, rig)
    files: dict[Path, str] = {}
    if options.output is not None:
        origin = provenance_of(session)
        if len(session.cameras) > 1:
            files[options.output] = rig_text(rig, origin)
            outlines = {c.name: outline_of_corners(c.calibration) for c in rig.cameras}
            files |= foreign_rig_files(rig.mounted.cameras, options.output, options.exports, outlines)
        for camera in rig.cameras:
            own = camera_path(names, options.output, camera.name)
            files[own] = calibration_text(with_new_verdicts(camera.calibration, session.cameras[camera.name]), origin)
            files |= foreign_files(camera.calibration, own, camera_exports(names, options))
        if session.rigid_boards:
            files[boards_path(options.output)] = board_rigs_text(rig.board_rigs)
    shown = cameras_on_page(rig, session)
    plans = plans_of(session.cameras, shown) if options.report or options.plan else {}
    if options.report is not None:
        files[options.report] = rig_page(session, rig, shown, plans, checks, corners, files)
    write_together(files, force=options.force)
    unreadable = {image: reason for one in corners.values() for image, reason in one.unreadable.items()}
    return RigSessionCalibration(
        session=session, rig=rig, checks=tuple(checks), unreadable=unreadable, written=tuple(files), plans=plans
    )


def calibrate_camera(path: Path, *, progress: Progress = silent) -> Calibration:
    """Return the calibration of one camera from its session file; nothing is written.

    Raises InputError for a session of several cameras, and as `calibrate_rig_session`.
    """
    session = load_any_session(path)
    if isinstance(session, Session) or len(session.cameras) > 1:
        own = load_session(path)
        return calibration_from(own, session_corners(own, progress=progress), progress=progress)
    require_distinct(session)
    corners = {name: session_corners(own, progress=progress) for name, own in session.cameras.items()}
    (camera,) = rig_from(session, corners, progress=progress).cameras
    return with_new_verdicts(camera.calibration, session.cameras[camera.name])


def cameras_on_page(rig: RigCalibration, session: RigSession) -> dict[str, Calibration]:
    """Return the calibrations that the page shows: each camera calibrated alone; a single camera as solved jointly with
    its boards on one mount, which is what its file has."""
    if len(rig.cameras) == 1:
        (camera,) = rig.cameras
        return {camera.name: with_new_verdicts(camera.calibration, session.cameras[camera.name])}
    return {camera.name: alone for camera, alone in zip(rig.cameras, rig.single, strict=True)}


def with_new_verdicts(calibration: Calibration, session: Session) -> Calibration:
    """Return a rig camera's calibration with new verdicts, for its held-out error and covariance in the rig.

    Choices that the `session` leaves automatic are not proposed as remedies.
    """
    chosen = [name for name in ("model", "board_shape") if getattr(session, name) == "auto"]
    return replace(calibration, verdicts=diagnose(calibration, in_force=chosen))


def rig_from(
    session: RigSession,
    corners: Mapping[str, SessionCorners],
    *,
    pupil: str = "auto",
    progress: Progress = silent,
) -> RigCalibration:
    """Return the calibration of a rig's session from the corners of its cameras; `pupil` as for `calibrate_rig`.

    Raises InputError if a camera's images show no board or the images cannot be assigned to moments, DegenerateError if
    the views do not determine a camera.
    """
    corners = {name: replace(own, found=named_as_listed(session, own.found)) for name, own in corners.items()}
    found = {name: own.found for name, own in corners.items()}
    frames = {name: {image: image for image in own} for name, own in found.items()}
    if len(found) > 1:
        frames = frames_of_images({name: list(own) for name, own in found.items()}, session.frames)
    views, sizes, dropped = {}, {}, {}
    for name, own in session.cameras.items():
        seen, sizes[name], dropped[name] = session_views(own, corners[name])
        views[name] = [(frames[name][view.image], view) for view in seen]
    try:
        rig = calibrate_rig(
            views,
            sizes,
            model={name: own.model for name, own in session.cameras.items()},
            degree={name: own.degree for name, own in session.cameras.items()},
            board=next(iter(session.cameras.values())).board_shape,
            rigid_boards=[group.boards for group in session.rigid_boards],
            known=known_cameras(session),
            pupil=pupil,
            progress=progress,
        )
    except DegenerateError as error:
        causes = _misread(session, progress)
        if not causes:
            raise
        raise InputError(f"{session.path}: {causes[0]} ({error})") from error
    rig = named_by_rule(session, rig)
    also = list[Finding]()
    for (name, framed), calibration in zip(views.items(), rig.single, strict=True):
        seen = [view for _, view in framed]
        also += [] if session.rigid_boards else suggest_rigid_boards(seen, calibration)
        also += wrong_print(seen, named_images(session.cameras[name]))
    rig = replace(rig, verdicts=(*rig.verdicts, *dict.fromkeys(also)))
    rig = _with_misread(rig, session, [view for framed in views.values() for _, view in framed], progress)
    single = [replace(c, dropped=(*dropped[n], *c.dropped)) for n, c in zip(session.cameras, rig.single, strict=True)]
    cameras = [
        replace(c, calibration=replace(c.calibration, dropped=alone.dropped, disagreeing=alone.disagreeing))
        for c, alone in zip(rig.cameras, single, strict=True)
    ]
    return replace(rig, single=tuple(single), cameras=tuple(cameras))


def _with_misread(
    rig: RigCalibration, session: RigSession, views: Sequence[BoardView], progress: Progress
) -> RigCalibration:
    """Return the rig with verdicts on boards that are declared with other marks than printed, looked for where it is
    bad or no camera's view shows most of a board's corners."""
    bad = rig.verdicts[0].severity is Severity.BAD
    if not bad and not _mostly_hidden([b for own in session.cameras.values() for b in own.boards], views):
        return rig
    wrong = [Finding.bad(words) if bad else Finding.look(words) for words in _misread(session, progress)]
    return replace(rig, verdicts=(rig.verdicts[0], *wrong, *rig.verdicts[1:]))


def _misread(session: RigSession, progress: Progress) -> list[str]:
    """Return in words why corners of boards with marks are misplaced, each reason once."""
    shown = (why_misplaced(own.images, own.boards, progress) for own in session.cameras.values())
    return list(dict.fromkeys(words for words in shown if words is not None))


def measured_checks(session: RigSession, rig: RigCalibration) -> list[Check]:
    """Return the comparison with measured baselines, and with angles and distances of boards on one mount."""
    out = []
    for b in session.baselines:
        ours = rig.baseline_mm(b.a, b.b)
        out.append(compare_baseline(f"baseline {b.a}-{b.b}", b.length, ours, COVERAGE, rig.corner_count))
    for group, solved in zip(session.rigid_boards, rig.board_rigs, strict=True):
        count = sum(b.board.corner_count for b in solved.boards)
        for angle in group.truth.angles:
            out.append(compare_angle(angle, solved.angle_deg(angle.a, angle.b), COVERAGE, count))
        for distance in group.truth.distances:
            out.append(compare_distance(distance, solved.distance_mm(distance.a, distance.b), COVERAGE, count))
    return out
