"""Output of `rigkit calibrate` for one camera, as JSON and as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import most_severe_first

if TYPE_CHECKING:
    from rigkit.calibration.result import Calibration, Candidate
    from rigkit.core.boards import Board
    from rigkit.report.pages.page_facts import PageFacts

MAX_NAMED = 3


def page(calibration: Calibration, boards: Sequence[Board]) -> PageFacts:
    """Return the facts on the page of one camera, with the pictures of `boards` to take next if a plan exists."""
    from rigkit.report.pages.calibration_facts import camera_facts
    from rigkit.workflows.calibration.next_pictures import next_views

    try:
        return camera_facts(calibration, next_views(calibration, boards))
    except (InputError, DegenerateError):
        return camera_facts(calibration)


def summary(calibration: Calibration) -> dict[str, Any]:
    """Return the result as JSON values."""
    from rigkit.io.calibrations.calibration_file import camera_to_json

    camera = calibration.camera
    return {
        **camera_to_json(camera),
        "sigmas": camera.named(calibration.parameter_sigmas),
        "heldout_rms_px": calibration.heldout_rms_px,
        "rms_px": calibration.rms_px,
        "sigma_px": calibration.sigma_px,
        "views": [{"image": v.image, "board": v.board_id, "rms_px": v.rms_px} for v in calibration.views],
        "dropped": [{"image": image, "reason": reason} for image, reason in calibration.dropped],
        "outliers": len(calibration.outliers),
        "verdicts": [str(finding) for finding in calibration.verdicts],
    }


def describe(calibration: Calibration) -> str:
    """Return the result as text, the headline first."""
    from rigkit.rectification.targets import field_across
    from rigkit.report.pages.calibration_facts import focal_words, training_note
    from rigkit.report.tables import rounded_parameters

    camera = calibration.camera
    held = calibration.heldout_rms_px
    headline = "held-out RMS not available (too few images)" if held is None else f"held-out RMS {held:.4f} px"
    across_deg = math.degrees(field_across(camera))
    note = training_note(calibration.rms_px, held)
    lines = [
        f"{camera.model}, {camera.size_px[0]}x{camera.size_px[1]} px: {headline}",
        f"training RMS {calibration.rms_px:.4f} px (2-D per corner, {calibration.corner_count} corners in "
        f"{len(calibration.views)} views{note and f'; {note}'}), {len(calibration.outliers)} outliers, "
        f"{calibration.images_left_out} images left out",
        f"focal length on the axis {focal_words(calibration)} px, horizontal field of view {across_deg:.1f} degrees",
    ]
    words = rounded_parameters(camera, calibration.parameter_sigmas)
    lines += [f"  {name:>4} = {value}" for name, value in words.items()]
    lines += left_out(calibration)
    lines += _choices(calibration.candidates)
    return "\n".join([*lines, *map(str, most_severe_first(calibration.verdicts))])


def left_out(calibration: Calibration) -> list[str]:
    """Return one line for each reason why images, or parts of used images, are left out."""
    used = {view.image for view in calibration.views}
    images: dict[tuple[str, str], list[str]] = {}
    for image, reason in calibration.dropped:
        images.setdefault(("left out of" if image in used else "dropped", reason), []).append(image)
    return [
        f"{how} {_first_names(some)}: {reason}" for (how, reason), some in sorted(images.items(), key=lambda i: i[0][0])
    ]


def _first_names(images: Sequence[str]) -> str:
    """Return the first images by name, and the number of the others."""
    more = len(images) - MAX_NAMED
    return ", ".join(images[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


def _choices(candidates: Sequence[Candidate]) -> list[str]:
    """Return one line for each automatic choice."""
    lines = []
    for what in ("model", "board", "lens with"):
        tried = [c for c in candidates if _chosen_of(c) == what]
        taken = [c for c in tried if c.chosen and math.isfinite(c.rms_px)]
        if len(tried) > 1 and taken:
            lines.append(
                f"{what} {taken[-1].name.removeprefix('board ')}, of {len(tried)} compared: {taken[-1].reason}"
            )
    return lines


def _chosen_of(candidate: Candidate) -> str:
    """Return which choice a candidate belongs to: model, board shape, or entrance pupil ("lens with")."""
    from rigkit.calibration.with_pupil import CENTRAL, MOVING

    if candidate.name in (CENTRAL, MOVING):
        return "lens with"
    return "board" if candidate.name.startswith("board ") else "model"
