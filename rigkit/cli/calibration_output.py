"""Output of `rigkit calibrate`, for one camera and for a rig, as JSON and as text."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rigkit.core.findings import Finding, Severity, most_severe_first
from rigkit.core.printing import counted, length_words

if TYPE_CHECKING:
    from rigkit.calibration.result import Calibration, Candidate
    from rigkit.calibration.rig.result import RigCalibration
    from rigkit.validation.check import Check

MAX_NAMED = 3


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
        f"{len(calibration.views)} views{note and f'; {note}'}), {counted(len(calibration.outliers), 'outlier')}, "
        f"{counted(calibration.images_left_out, 'image')} left out",
        f"focal length on the axis {focal_words(calibration)} px, horizontal field of view {across_deg:.1f} degrees",
    ]
    words = rounded_parameters(camera, calibration.parameter_sigmas)
    lines += [f"  {name:>4} = {value}" for name, value in words.items()]
    lines += left_out(calibration)
    lines += _choices(calibration.candidates)
    return "\n".join([*lines, *map(str, most_severe_first(calibration.verdicts))])


def left_out(calibration: Calibration) -> list[str]:
    """Return one line for each reason, which no verdict states, why images, or parts of used images, are left out."""
    used = {view.image for view in calibration.views}
    images: dict[tuple[str, str], list[str]] = {}
    stated = {finding.reason for finding in calibration.verdicts}
    for image, reason in (entry for entry in calibration.dropped if entry[1] not in stated):
        images.setdefault(("left out of" if image in used else "dropped", reason), []).append(image)
    return [
        f"{how} {_first_names(some)}: {reason}" for (how, reason), some in sorted(images.items(), key=lambda i: i[0][0])
    ]


def frames_left_out(targets: Sequence[tuple[str, str, str]]) -> list[str]:
    """Return one line for each board and reason why (frame, board, reason) are left out, whatever its figures."""
    groups: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for frame, board, reason in targets:
        groups.setdefault((board, re.sub(r"[\d.]+", "", reason)), []).append((frame, reason))
    words = {True: ("frames", " (figures of the first)"), False: ("frame", "")}
    lines = []
    for (board, _), some in groups.items():
        what, note = words[len(some) > 1]
        names = _first_names([frame for frame, _ in some])
        lines.append(f"{what} {names}, board '{board}' left out: {some[0][1]}{note}")
    return lines


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


def rig_summary(rig: RigCalibration, checks: Sequence[Check]) -> dict[str, Any]:
    """Return the result as JSON values."""
    from rigkit.report.rig_tables import angles, baselines, transfers

    return {
        "heldout_rms_px": rig.heldout_rms_px,
        "rms_px": rig.rms_px,
        "sigma_px": rig.sigma_px,
        "overdispersion": rig.overdispersion,
        "verdicts": [str(finding) for finding in rig.verdicts],
        "cameras": [
            {
                "name": camera.name,
                "heldout_rms_px": camera.calibration.heldout_rms_px,
                "rms_px": camera.rms_px,
                "cam_from_rig": camera.cam_from_rig.matrix()[:3].tolist(),
                "parameters": camera.camera.named(camera.camera.parameters),
                "sigmas": camera.camera.named(camera.calibration.parameter_sigmas),
                "alone": summary(alone),
            }
            for camera, alone in zip(rig.cameras, rig.single, strict=True)
        ],
        "baselines": [
            {"from": own.a, "to": own.b, "value_mm": own.value, "sigma_mm": own.sigma} for own in baselines(rig)
        ],
        "transfers": [
            {"from": own.a, "to": own.b, "median_px": own.median_px, "worst_px": own.worst_px}
            for own in filter(None, transfers(rig))
        ],
        "angles": [
            {"a": own.a, "b": own.b, "value_deg": own.value, "sigma_deg": own.sigma}
            for target in rig.board_rigs
            for own in angles(target)
        ],
        "left_out": [{"frame": frame, "board": board, "reason": reason} for frame, board, reason in rig.left_out],
        "checks": [asdict(c) for c in checks],
    }


def describe_rig(rig: RigCalibration, checks: Sequence[Check]) -> str:
    """Return the result as text, the headline first."""
    from rigkit.report.rig_tables import angles, baselines, place, transfers
    from rigkit.report.tables import measured_words

    held = "held-out RMS not available" if rig.heldout_rms_px is None else f"held-out RMS {rig.heldout_rms_px:.4f} px"
    count = len(rig.cameras)
    lines = [
        f"{counted(count, 'camera')}, {rig.shared_count} poses shared by several views: {held}, training "
        f"RMS {rig.rms_px:.4f} px; overdispersion of frames {rig.overdispersion:.2f}"
    ]
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        held = "not available" if alone.heldout_rms_px is None else f"{alone.heldout_rms_px:.4f} px"
        centre, rotation_deg = place(camera)
        lines.append(
            f"{camera.name}: {camera.camera.model}, calibrated alone held-out RMS {held}, training RMS "
            f"{alone.rms_px:.4f}; in the rig {camera.rms_px:.4f} px; centre "
            f"({length_words(*centre, decimals=2)}) mm, rotation {rotation_deg:.3f} deg"
        )
    for b, t in zip(baselines(rig), transfers(rig), strict=True):
        line = f"baseline {b.a} to {b.b}: {measured_words(b.value, b.sigma, 3)} mm"
        moved = "" if t is None else f"; transferred points ±{t.median_px:.3f} px (at worst ±{t.worst_px:.3f} px)"
        lines.append(line + moved)
    for target in rig.board_rigs:
        lines += [f"angle {a.a} to {a.b}: {measured_words(a.value, a.sigma, 3)} deg" for a in angles(target)]
    for c in checks:
        verdict = "as measured" if c.passed else "NOT as measured"
        lines.append(
            f"{c.name} {verdict}: {c.ours:.3f} {c.unit}, measured {c.measured:g} ± {c.measured_sigma:g} {c.unit} "
            f"({c.how}), off by {c.k:.1f} combined sigmas"
        )
    # The verdicts on the rig come before their consequences for its cameras.
    lines += map(str, most_severe_first(rig.verdicts))
    lines += frames_left_out(rig.left_out)
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        lines += [f"{camera.name}: {line}" for line in left_out(alone)]
        lines += first_finding(camera.name, most_severe_first(alone.verdicts))
    return "\n".join(lines)


def first_finding(camera: str, found: Sequence[Finding]) -> list[str]:
    """Return the line of one camera of a rig, none without findings: of a rig only the first one counts, with the
    number of the others."""
    bad = sum(finding.severity is Severity.BAD for finding in found[1:])
    more = f"; {counted(len(found) - 1, 'more finding')}{f' ({bad} bad)' if bad else ''} on the page (-r)"
    return [f"'{camera}' by itself: {finding}{more if len(found) > 1 else ''}" for finding in found[:1]]
