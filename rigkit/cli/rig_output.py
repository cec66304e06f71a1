"""Output of `rigkit calibrate` for a rig, as JSON and as text."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

from rigkit.cli import calibration_output
from rigkit.core.findings import most_severe_first
from rigkit.core.printing import length_words

if TYPE_CHECKING:
    from rigkit.calibration.rig.result import RigCalibration
    from rigkit.io.manifests.rig_session import RigSession
    from rigkit.report.pages.page_facts import PageFacts
    from rigkit.validation.check import Check


def page(rig: RigCalibration, checks: Sequence[Check], session: RigSession) -> PageFacts:
    """Return the facts on the page of a rig and of its cameras."""
    from rigkit.report.pages.calibration_facts import rig_facts
    from rigkit.workflows.calibration.calibrate_rig import cameras_on_page

    shown = cameras_on_page(rig, session)
    cameras = {name: calibration_output.page(c, session.cameras[name].boards) for name, c in shown.items()}
    return rig_facts(rig, checks, cameras)


def summary(rig: RigCalibration, checks: Sequence[Check]) -> dict[str, Any]:
    """Return the result as JSON values."""
    from dataclasses import asdict

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
                "alone": calibration_output.summary(alone),
            }
            for camera, alone in zip(rig.cameras, rig.single, strict=True)
        ],
        "baselines": [
            {"from": a, "to": b, "value_mm": value, "sigma_mm": sigma} for a, b, value, sigma in baselines(rig)
        ],
        "transfers": [{"from": a, "to": b, "median_px": m, "worst_px": w} for a, b, m, w in transfers(rig)],
        "angles": [{"a": a, "b": b, "value_deg": value, "sigma_deg": sigma} for a, b, value, sigma in angles(rig)],
        "left_out": [{"frame": frame, "board": board, "reason": reason} for frame, board, reason in rig.left_out],
        "checks": [asdict(c) for c in checks],
    }


def baselines(rig: RigCalibration) -> list[tuple[str, str, float, float]]:
    """Return (from, to, mm, sigma mm) for every two cameras."""
    names = [c.name for c in rig.cameras]
    return [(a, b, *rig.baseline_mm(a, b)) for a, b in combinations(names, 2)]


def angles(rig: RigCalibration) -> list[tuple[str, str, float, float]]:
    """Return (board, board, deg, sigma deg) for every two boards on one mount."""
    return [(a, b, *t.angle_deg(a, b)) for t in rig.board_rigs for a, b in combinations(t.names, 2)]


def transfers(rig: RigCalibration) -> list[tuple[str, str, float, float]]:
    """Return (from, to, median px, worst px) of the transfer uncertainty for every two cameras with a common field."""
    from rigkit.calibration.rig.certainty.uncertainty import transfer_uncertainty

    found = [transfer_uncertainty(rig, a, b) for a, b in combinations([c.name for c in rig.cameras], 2)]
    return [(t.a, t.b, t.median_px, t.worst_px) for t in found if t is not None]


def describe(rig: RigCalibration, checks: Sequence[Check]) -> str:
    """Return the result as text, the headline first."""
    import numpy as np

    from rigkit.geometry.rotation import log_so3
    from rigkit.report.tables import measured_words

    held = "held-out RMS not available" if rig.heldout_rms_px is None else f"held-out RMS {rig.heldout_rms_px:.4f} px"
    count = len(rig.cameras)
    lines = [
        f"{count} camera{'s' if count > 1 else ''}, {rig.shared_count} poses shared by several views: {held}, training "
        f"RMS {rig.rms_px:.4f} px; overdispersion of frames {rig.overdispersion:.2f}"
    ]
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        held = "not available" if alone.heldout_rms_px is None else f"{alone.heldout_rms_px:.4f} px"
        where = length_words(*camera.cam_from_rig.inverse().translation_mm.tolist(), decimals=2)
        turned = np.degrees(np.linalg.norm(log_so3(camera.cam_from_rig.rotation)))
        lines.append(
            f"{camera.name}: {camera.camera.model}, calibrated alone held-out RMS {held}, training RMS "
            f"{alone.rms_px:.4f}; in the rig {camera.rms_px:.4f} px; centre ({where}) mm, rotation {turned:.3f} deg"
        )
    lines += [f"baseline {a} to {b}: {measured_words(value, sigma, 3)} mm" for a, b, value, sigma in baselines(rig)]
    lines += [
        f"points transferred from {a} to {b}: ±{middle:.3f} px (at worst ±{worst:.3f} px; one standard deviation)"
        for a, b, middle, worst in transfers(rig)
    ]
    lines += [f"angle {a} to {b}: {measured_words(value, sigma, 3)} deg" for a, b, value, sigma in angles(rig)]
    for c in checks:
        verdict = "as measured" if c.passed else "NOT as measured"
        lines.append(
            f"{c.name} {verdict}: {c.ours:.3f} {c.unit}, measured {c.measured:g} +- {c.measured_sigma:g} {c.unit} "
            f"({c.how}), off by {c.k:.1f} combined sigmas"
        )
    # The verdicts on the rig come before their consequences for its cameras.
    lines += map(str, most_severe_first(rig.verdicts))
    lines += [f"frame {frame}, board '{board}' left out: {reason}" for frame, board, reason in rig.left_out]
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        lines += [f"{camera.name}: {line}" for line in calibration_output.left_out(alone)]
        lines += [f"{camera.name} alone: {verdict}" for verdict in most_severe_first(alone.verdicts)]
    return "\n".join(lines)
