"""The part of `rigkit calibrate` for several cameras on one mount: from their images to rig.json."""

from __future__ import annotations

import argparse
import time
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.progress import Progress, silent

if TYPE_CHECKING:
    from rigkit.calibration.rig import RigCalibration
    from rigkit.io.rig_session import RigSession
    from rigkit.validation.checks import Check

__all__ = ["calibrate_rig_session", "run_rig"]

EXIT_CHECK_FAILED = 1


def run_rig(args: argparse.Namespace) -> int:
    """Calibrate the rig of `args.session`; return 1 if a measured baseline disagrees."""
    from rigkit.cli.calibrate import page_path
    from rigkit.cli.console import note, print_json, progress_on_stderr
    from rigkit.io.calibration_file import save_camera
    from rigkit.io.files import ensure_writable
    from rigkit.io.rig_file import save_rig
    from rigkit.io.rig_session import load_rig_session

    session = load_rig_session(args.session)
    target: Path = args.output or session.rig_path
    cameras = {name: target.with_name(f"{target.stem}-{name}.json") for name in session.cameras}
    page = page_path(args.report, target)
    ensure_writable([target, *cameras.values(), *page], force=args.force)
    started = time.monotonic()
    rig = calibrate_rig_session(session, progress_on_stderr())
    checks = baseline_checks(session, rig)
    save_rig(target, rig, force=args.force)
    for camera in rig.cameras:
        save_camera(cameras[camera.name], camera.camera, force=args.force)
    for path in page:
        from rigkit.cli.calibration_report import write_rig_report

        write_rig_report(path, session, rig, checks, target, force=args.force)
    written = (target, *cameras.values(), *page)
    note(f"{', '.join(str(p) for p in written)} written, {time.monotonic() - started:.1f} s")
    if args.json:
        print_json(summary(rig, checks))
    else:
        print(describe(rig, checks))
    return 0 if all(c.passed for c in checks) else EXIT_CHECK_FAILED


def calibrate_rig_session(session: RigSession, progress: Progress = silent) -> RigCalibration:
    """Return the calibration of a rig's session: images -> corners (kept beside the session) -> rig.

    Raises InputError where a camera's images show no board or nothing says which were taken together, DegenerateError
    where the views do not determine a camera.
    """
    from dataclasses import replace

    from rigkit.calibration.rig import calibrate_rig
    from rigkit.cli.calibrate import session_corners, session_views
    from rigkit.io.rig_session import frames_of_images

    found = {name: session_corners(own, progress) for name, own in session.cameras.items()}
    frames = frames_of_images({name: list(own) for name, own in found.items()}, session.frames)
    views, sizes, dropped = {}, {}, {}
    for name, own in session.cameras.items():
        seen, sizes[name], dropped[name] = session_views(own, found[name])
        views[name] = [(frames[name][view.image], view) for view in seen]
    rig = calibrate_rig(
        views,
        sizes,
        model={name: own.model for name, own in session.cameras.items()},
        degree={name: own.degree for name, own in session.cameras.items()},
        board=next(iter(session.cameras.values())).board_shape,
        progress=progress,
    )
    single = [replace(c, dropped=(*dropped[n], *c.dropped)) for n, c in zip(session.cameras, rig.single, strict=True)]
    return replace(rig, single=tuple(single))


def baseline_checks(session: RigSession, rig: RigCalibration) -> list[Check]:
    """Return what a person measured beside what came out."""
    from rigkit.validation.checks import COVERAGE, judge

    out = []
    for b in session.baselines:
        known = (b.length.value_mm, b.length.sigma_mm, b.length.how)
        ours = rig.baseline_mm(b.a, b.b)
        out.append(judge(f"baseline {b.a}-{b.b}", "baseline", "mm", known, ours, COVERAGE, rig.corner_count))
    return out


def summary(rig: RigCalibration, checks: list[Check]) -> dict[str, Any]:
    """Return the figures for programs."""
    from dataclasses import asdict

    from rigkit.cli.calibrate import summary as summary_of_one

    return {
        "rms_px": rig.rms_px,
        "sigma_px": rig.sigma_px,
        "cameras": [
            {
                "name": camera.name,
                "rms_px": camera.rms_px,
                "cam_from_rig": camera.cam_from_rig.matrix()[:3].tolist(),
                "parameters": dict(
                    zip(camera.camera.parameter_names(), camera.camera.parameters.tolist(), strict=True)
                ),
                "alone": summary_of_one(alone),
            }
            for camera, alone in zip(rig.cameras, rig.single, strict=True)
        ],
        "baselines": [
            {"from": a, "to": b, "value_mm": value, "sigma_mm": sigma} for a, b, value, sigma in baselines(rig)
        ],
        "left_out": [{"frame": frame, "board": board, "reason": reason} for frame, board, reason in rig.left_out],
        "checks": [asdict(c) for c in checks],
    }


def baselines(rig: RigCalibration) -> list[tuple[str, str, float, float]]:
    """Return (from, to, mm, sigma mm) of every two cameras."""
    names = [c.name for c in rig.cameras]
    return [(a, b, *rig.baseline_mm(a, b)) for a, b in combinations(names, 2)]


def describe(rig: RigCalibration, checks: list[Check]) -> str:
    """Return the result for a person."""
    import numpy as np

    from rigkit.geometry.rotation import log_so3

    lines = [f"{len(rig.cameras)} cameras, {rig.shared_count} boards seen by several of them: RMS {rig.rms_px:.4f} px"]
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        held = "not available" if alone.heldout_rms_px is None else f"{alone.heldout_rms_px:.4f} px"
        x, y, z = camera.cam_from_rig.inverse().translation_mm
        turned = np.degrees(np.linalg.norm(log_so3(camera.cam_from_rig.rotation)))
        lines.append(
            f"{camera.name}: {camera.camera.model}, alone held-out RMS {held}, training RMS {alone.rms_px:.4f}; in the "
            f"rig {camera.rms_px:.4f} px; at ({x:.2f}, {y:.2f}, {z:.2f}) mm, turned by {turned:.3f} deg"
        )
    lines += [f"baseline {a} to {b}: {value:.3f} +- {sigma:.3f} mm" for a, b, value, sigma in baselines(rig)]
    for c in checks:
        verdict = "as measured" if c.passed else "NOT as measured"
        lines.append(
            f"{c.name} {verdict}: {c.ours:.3f} mm, measured {c.measured:g} +- {c.measured_sigma:g} mm ({c.how}), off "
            f"by {c.k:.1f} combined sigmas"
        )
    lines += [f"frame {frame}, board '{board}' left out: {reason}" for frame, board, reason in rig.left_out]
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        lines += [f"{camera.name}: dropped {image}: {reason}" for image, reason in alone.dropped]
        lines += [f"{camera.name}: {verdict}" for verdict in alone.verdicts]
    return "\n".join(lines)
