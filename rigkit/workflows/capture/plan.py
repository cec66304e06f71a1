"""Which pictures to take next, for a session or a calibration, or before there is a camera at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.calibration.views.usable import without_parts
from rigkit.core.arrays import Pixels
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.printing import brief
from rigkit.core.progress import Progress, silent
from rigkit.core.reach import Reach
from rigkit.core.tables import Table
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.io.calibrations.rig_file import is_rig_file
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, write_atomic
from rigkit.io.manifests.rig_session import is_rig_session
from rigkit.io.manifests.session import load_session
from rigkit.planning.information import CornerError, Knowledge, guessed_camera
from rigkit.planning.plan import Plan, plan_views
from rigkit.report.pages.check_page import power_table
from rigkit.report.pages.plan_page import plan_page
from rigkit.validation.monitoring.change_aim import informative_views
from rigkit.validation.monitoring.evidence import Monitored
from rigkit.validation.monitoring.watch import monitored_camera
from rigkit.workflows.calibration.calibrate import calibrate_session, session_inputs
from rigkit.workflows.calibration.next_pictures import NEXT_VIEWS, goal_of, next_frames, next_views
from rigkit.workflows.checks.check import load_monitored
from rigkit.workflows.inputs.camera_files import require_covariance, warn_if_bad, warn_of_pupil
from rigkit.workflows.options.boards import LensOptions, PlanOptions
from rigkit.workflows.options.cameras import Cache, CalibrateOptions
from rigkit.workflows.outputs.provenance import digest_line, software_facts

LENS_VIEWS = 12
"""Views of a lens to plan by default; of a calibration NEXT_VIEWS."""
TYPICAL_RHO = 0.05
"""What corners of real boards have in common in a view, as part of their variance: 50 corners count like 15."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PlannedSession:
    """The plan, tables of what its pictures would find, and the files that were written."""

    plan: Plan
    found: tuple[Table, ...]
    written: tuple[Path, ...]

    __repr__ = brief


def plan_session(
    path: str | Path, options: PlanOptions | None = None, *, progress: Progress = silent
) -> PlannedSession:
    """Return the views that would improve a calibration most, given its file or the session that it comes from, or a
    rig, given its file; or those to check it with.

    Raises InputError: the session of a rig, a file that is none of these, or a page that cannot be written;
    DegenerateError: the views so far do not determine the camera, or no board can be held
    in view.
    """
    options, source = options or PlanOptions(), Path(path)
    count = NEXT_VIEWS if options.count is None else options.count
    rig = is_rig_session(source) if source.suffix == ".toml" else is_rig_file(source)
    if rig and source.suffix == ".toml":
        raise InputError(f"plan: '{source}' is a session of a rig; give the rig that it was calibrated to, rig.json")
    ensure_writable(options.report, force=options.force, inputs=[source])
    title = f"Images to check {source.name} with" if options.check else f"Next images for {source.name}"
    bad: Finding | None = None
    found: tuple[Table, ...] = ()
    if source.suffix != ".toml":
        require_covariance(source)
        bad = warn_if_bad(source)
    if rig:
        monitored, boards = load_monitored(source)
        if not boards:
            raise InputError(f"plan: '{source}' does not say what boards there are; calibrate it with rigkit")
        with about(source):
            if options.check:
                plan, found = _to_check(monitored, boards, count, options.reach)
            else:
                plan = next_frames(monitored, boards, count, length=options.length, reach=options.reach)
        return _shown(plan, options, title, source=source, bad=bad, found=found)
    if source.suffix == ".toml":
        session = load_session(source)
        calibrating = CalibrateOptions(cache=Cache.UPDATE)
        ensure_writable(options.report, force=options.force, inputs=[source, *session_inputs(session, calibrating)])
        calibration = calibrate_session(session, calibrating, progress=progress).calibration
        bad = warn_if_bad(source, calibration.verdicts)
        boards = session.boards
    else:
        calibration = load_calibration(source)
        with about(source):
            boards = without_parts(shape.board for shape in calibration.boards)
        if not boards:
            raise InputError(f"plan: no whole board was seen for '{source}'; give the session that it was made from")
    if not options.check:
        warn_of_pupil(source, calibration)
    with about(source):
        if options.check:
            plan, found = _to_check(monitored_camera(calibration, source.stem), boards, count, options.reach)
        else:
            plan = next_views(calibration, boards, count, length=options.length, reach=options.reach)
    taken = calibration.corners.used[0]
    return _shown(plan, options, title, source=source, bad=bad, taken=taken, found=found)


def _to_check(
    monitored: Monitored, boards: Sequence[Board], count: int, reach: Reach
) -> tuple[Plan, tuple[Table, ...]]:
    """Return the pictures to check a camera or a rig with, and the table of the changes that they would reveal."""
    plan, powers = informative_views(monitored, boards, count, reach)
    return plan, (power_table(powers, "Changes that these images would reveal"),)


def plan_lens(lens: LensOptions, options: PlanOptions) -> PlannedSession:
    """Return what `options.count` well-chosen views (by default 12) of a lens that is only guessed will reach.

    Raises as `plan_session`.
    """
    ensure_writable(options.report, force=options.force)
    count = LENS_VIEWS if options.count is None else options.count
    camera = guessed_camera(lens.hfov_deg, lens.size_px, lens.model)
    knowledge = Knowledge.guessed(camera, CornerError(lens.sigma_px, TYPICAL_RHO))
    plan = plan_views(
        knowledge, lens.boards, goal_of(camera, options.reach, options.length), count, reach=options.reach
    )
    return _shown(plan, options, f"{count} images for a lens of {lens.hfov_deg:g} degrees")


def _shown(
    plan: Plan,
    options: PlanOptions,
    title: str,
    *,
    source: Path | None = None,
    bad: Finding | None = None,
    taken: Pixels | None = None,
    found: tuple[Table, ...] = (),
) -> PlannedSession:
    """Return the plan, and write its page where one is asked for."""
    if options.report is not None:
        facts = software_facts() | ({source.name: digest_line(source)} if source is not None else {})
        page = plan_page(plan, title, facts, taken, found, "" if bad is None else bad.text)
        write_atomic(options.report, page, force=options.force)
    written = () if options.report is None else (options.report,)
    return PlannedSession(plan=plan, found=found, written=written)
