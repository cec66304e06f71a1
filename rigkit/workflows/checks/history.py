"""The register of checks over months, and its page."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

from rigkit.calibration.result import Calibration
from rigkit.cameras.compare import compare_cameras, grid_pixels
from rigkit.cameras.convert import refit_camera
from rigkit.core.arrays import scaled_pinv
from rigkit.core.errors import InputError
from rigkit.io.calibrations.calibration_file import load_calibration
from rigkit.io.calibrations.history_file import (
    HistoryEntry,
    add_entry,
    editions,
    ensure_register,
    load_history,
    path_from_register,
)
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import ensure_writable, write_atomic
from rigkit.planning.information import MIN_SIGMA_PX
from rigkit.report.pages.history_page import history_page, overwritten
from rigkit.validation.monitoring.evidence import FreshEvidence, Monitored
from rigkit.validation.monitoring.verdict import evaluate_evidence
from rigkit.validation.monitoring.watch import monitored_camera
from rigkit.workflows.inputs.camera_files import warn_if_bad
from rigkit.workflows.outputs.provenance import digest_line, digest_of, software_facts

RECALIBRATION_GRID = (40, 30)
MAX_CLOCK_DIFFERENCE = timedelta(days=1)
"""Clocks of one lab's machines may differ by less, by time zone or by bad setting."""
_log = logging.getLogger(__name__)


def show_history(
    register: Path, *, report: Path | None = None, force: bool = False
) -> tuple[tuple[HistoryEntry, ...], tuple[Path, ...]]:
    """Return the entries of a register by date and the files written: the page `report`, unless None.

    Raises InputError for another file, or a page that cannot be written.
    """
    ensure_writable(report, force=force, inputs=[register])
    kept = load_history(register)
    earlier = sum(one.moment - two.moment > MAX_CLOCK_DIFFERENCE for one, two in pairwise(kept))
    if earlier:
        _log.warning(
            "register '%s': %s one of a later day: a clock was wrong, or registers were joined; the entries are shown "
            "by their dates",
            register,
            "1 entry follows" if earlier == 1 else f"{earlier} entries follow",
        )
    to_come = [entry.date for entry in kept if entry.moment - datetime.now(UTC) > MAX_CLOCK_DIFFERENCE]
    if to_come:
        _log.warning(
            "register '%s': %s to come, '%s' the last: a clock was wrong; correct the dates in that file",
            register,
            "1 entry has a date" if len(to_come) == 1 else f"{len(to_come)} entries have dates",
            to_come[-1],
        )
    entries = tuple(sorted(kept, key=lambda entry: entry.moment))
    for message in (*overwritten(editions(entries)), *_since(register, entries)):
        _log.warning("register '%s': %s", register, message)
    if report is None:
        return entries, ()
    facts = software_facts() | {register.name: digest_line(register)}
    write_atomic(report, history_page(entries, f"History: {register.stem}", facts), force=force)
    return entries, (report,)


def _since(register: Path, entries: Sequence[HistoryEntry]) -> Iterator[str]:
    """Yield messages on calibrations that were overwritten since their last entry."""
    last = {entry.watched: entry for entry in entries if entry.digest}
    for watched, entry in last.items():
        file = register.parent / watched
        if file.is_file() and digest_of(file) != entry.digest:
            yield (
                f"{watched} was overwritten since its last entry of {entry.date[:10]}: its earlier entries refer "
                "to another calibration"
            )


def add_to_history(register: Path, new: Path, reference: Path, *, temperature_c: float | None = None) -> None:
    """Add a new calibration of the same camera to a register, as a change of the `reference`.

    Raises InputError for cameras of different models or sizes, and files that are not calibrations.
    """
    ensure_register(register, [new, reference], temperature_c)
    now, before = load_calibration(new), load_calibration(reference)
    warn_if_bad(new, now.verdicts)
    warn_if_bad(reference, before.verdicts)
    if (now.camera.model, now.camera.parameters.size) != (before.camera.model, before.camera.parameters.size):
        raise InputError(
            f"history: '{new}' is a {now.camera.model} camera, '{reference}' a {before.camera.model}; calibrate with "
            "the same model and degree to compare them number by number, or see `rigkit diff`"
        )
    with about(new, reference):
        # The model's inadequacy affects both calibrations alike, so it is left out.
        central = replace(before, pupil=None)
        watched = monitored_camera(central, reference.stem, beyond_model=False)
        check = evaluate_evidence(watched, lambda watched: _as_evidence(watched, now))
    places = path_from_register(register, new), path_from_register(register, reference)
    entry = HistoryEntry.of_check(
        check, places[0], reference=places[1], digest=digest_of(reference), temperature_c=temperature_c
    )
    add_entry(register, entry)


def _as_evidence(watched: Monitored, calibration: Calibration) -> FreshEvidence:
    """Return another calibration as evidence about the monitored camera: its information is the inverse of its
    covariance. Its undetermined rotation is removed first."""
    camera, new = watched.cameras[0], calibration.camera
    difference = compare_cameras(camera, new, grid=RECALIBRATION_GRID)
    # The same lens, with its axis rotated to that of the monitored one.
    pixels = grid_pixels(camera.size_px, RECALIBRATION_GRID).reshape(-1, 2)
    rays, valid = new.unproject(pixels)
    same = refit_camera(camera, rays[valid] @ difference.b_from_a, pixels[valid])
    share = (max(watched.sigma_px, MIN_SIGMA_PX) * watched.overdispersion) ** 2
    information = share * scaled_pinv(calibration.covariance)[None]
    score = information @ (same.parameters - camera.parameters)
    corners = calibration.corner_count
    return FreshEvidence(
        information=information,
        score=score,
        variance_px2=share,
        rms_px=difference.rms_px,
        expected_px=difference.rms_px,
        corners=corners,
        left_out=0,
        overdispersion=watched.overdispersion,
        freedom=watched.freedom,
    )
