"""The part of `rigkit calibrate` for several cameras or boards on one mount: from their images to rig.json."""

from __future__ import annotations

import argparse
import time
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.core.progress import Progress, silent

if TYPE_CHECKING:
    from rigkit.calibration.result import Calibration
    from rigkit.calibration.rig.result import RigCalibration
    from rigkit.io.rig_session import RigSession
    from rigkit.validation.checks import Check

__all__ = ["calibrate_camera", "calibrate_rig_session", "measured_checks", "run_rig"]

EXIT_CHECK_FAILED = 1


def run_rig(args: argparse.Namespace) -> int:
    """Calibrate the rig of `args.session`; return 1 if something measured disagrees."""
    from rigkit.cli.calibrate import page_path
    from rigkit.cli.console import note, print_json, progress_on_stderr
    from rigkit.io.calibration_file import calibration_text
    from rigkit.io.files import ensure_writable, write_together
    from rigkit.io.rig_file import board_rigs_text, rig_text
    from rigkit.io.rig_session import load_rig_session

    session = load_rig_session(args.session)
    target: Path = args.output or session.rig_path
    several = len(session.cameras) > 1
    beside = {name: target.with_name(f"{target.stem}-{name}.json") if several else target for name in session.cameras}
    boards = [target.with_name(f"{target.stem}-boards.json")] if session.rigid_boards else []
    page = page_path(args.report, target)
    rig_file = [target] if several else []
    inputs = [session.path, *(image for own in session.cameras.values() for image in own.images)]
    ensure_writable([*rig_file, *beside.values(), *boards, *page], force=args.force, inputs=inputs)
    started = time.monotonic()
    rig = calibrate_rig_session(session, progress_on_stderr())
    checks = measured_checks(session, rig)
    files = {path: rig_text(rig) for path in rig_file}
    files |= {beside[camera.name]: calibration_text(judged(camera.calibration)) for camera in rig.cameras}
    files |= {path: board_rigs_text(rig.board_rigs) for path in boards}
    for path in page:
        from rigkit.cli.calibration_report import rig_report_page

        files |= {path: rig_report_page(session, rig, checks, files)}
    write_together(files, force=args.force)
    note(f"{', '.join(str(p) for p in files)} written, {time.monotonic() - started:.1f} s")
    if args.json:
        print_json(summary(rig, checks))
    else:
        print(describe(rig, checks))
    return 0 if all(c.passed for c in checks) else EXIT_CHECK_FAILED


def calibrate_camera(path: Path, progress: Progress = silent) -> Calibration:
    """Return the calibration of one camera from its session, with boards on one mount or without.

    Raises InputError for a session of several cameras, and as `calibrate_rig_session`.
    """
    from rigkit.cli.calibrate import calibrate_session
    from rigkit.io.rig_session import is_rig_session, load_rig_session
    from rigkit.io.session import load_session

    session = load_rig_session(path) if is_rig_session(path) else None
    if session is None or len(session.cameras) > 1:
        return calibrate_session(load_session(path), progress)
    return judged(calibrate_rig_session(session, progress).cameras[0].calibration)


def judged(calibration: Calibration) -> Calibration:
    """Return a camera's calibration with the verdicts on it as it is in the rig: there it has another held-out error
    than alone, and is surer."""
    from dataclasses import replace

    from rigkit.calibration.verdicts import judge

    return replace(calibration, verdicts=judge(calibration))


def calibrate_rig_session(session: RigSession, progress: Progress = silent) -> RigCalibration:
    """Return the calibration of a rig's session: images -> corners (kept beside the session) -> rig.

    Raises InputError where a camera's images show no board, nothing says which were taken together, or boards cannot be
    told apart; DegenerateError where the views do not determine a camera.
    """
    from dataclasses import replace

    from rigkit.calibration.rig.board_ties import suggest_ties
    from rigkit.calibration.rig.calibrate import calibrate_rig
    from rigkit.cli.calibrate import session_corners, session_views
    from rigkit.cli.rigid_boards import named_as_listed, named_by_rule, require_distinct
    from rigkit.io.rig_session import frames_of_images

    require_distinct(session)
    found = {name: named_as_listed(session, session_corners(own, progress)) for name, own in session.cameras.items()}
    frames = {name: {image: image for image in own} for name, own in found.items()}
    if len(found) > 1:
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
        rigid_boards=[group.boards for group in session.rigid_boards],
        progress=progress,
    )
    rig = named_by_rule(session, rig)
    if not session.rigid_boards:
        said = [
            s
            for (_, own), c in zip(views.items(), rig.single, strict=True)
            for s in suggest_ties([v for _, v in own], c)
        ]
        rig = replace(rig, verdicts=(*rig.verdicts, *dict.fromkeys(said)))
    single = [replace(c, dropped=(*dropped[n], *c.dropped)) for n, c in zip(session.cameras, rig.single, strict=True)]
    cameras = [
        replace(c, calibration=replace(c.calibration, dropped=alone.dropped))
        for c, alone in zip(rig.cameras, single, strict=True)
    ]
    return replace(rig, single=tuple(single), cameras=tuple(cameras))


def measured_checks(session: RigSession, rig: RigCalibration) -> list[Check]:
    """Return what a person measured beside what came out: baselines, angles and distances of boards on one mount."""
    from rigkit.validation.checks import COVERAGE, judge

    out = []
    for b in session.baselines:
        known = (b.length.value_mm, b.length.sigma_mm, b.length.how)
        ours = rig.baseline_mm(b.a, b.b)
        out.append(judge(f"baseline {b.a}-{b.b}", "baseline", "mm", known, ours, COVERAGE, rig.corner_count))
    for group, solved in zip(session.rigid_boards, rig.board_rigs, strict=True):
        count = sum(b.board.corner_count for b in solved.boards)
        for angle in group.truth.angles:
            known = (angle.value_deg, angle.sigma_deg, angle.how)
            ours = solved.angle_deg(angle.a, angle.b)
            out.append(judge(f"angle {angle.a}-{angle.b}", "angle", "deg", known, ours, COVERAGE, count))
        for distance in group.truth.distances:
            known = (distance.value_mm, distance.sigma_mm, distance.how)
            ours = solved.distance_mm(distance.a, distance.b)
            name = f"distance {distance.a} to {distance.b}"
            out.append(judge(name, "distance", "mm", known, ours, COVERAGE, count))
    return out


def summary(rig: RigCalibration, checks: list[Check]) -> dict[str, Any]:
    """Return the figures for programs."""
    from dataclasses import asdict

    from rigkit.cli.calibrate import summary as summary_of_one

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
                "parameters": dict(
                    zip(camera.camera.parameter_names(), camera.camera.parameters.tolist(), strict=True)
                ),
                "sigmas": dict(
                    zip(camera.camera.parameter_names(), camera.calibration.parameter_sigmas.tolist(), strict=True)
                ),
                "alone": summary_of_one(alone),
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
    """Return (from, to, mm, sigma mm) of every two cameras."""
    names = [c.name for c in rig.cameras]
    return [(a, b, *rig.baseline_mm(a, b)) for a, b in combinations(names, 2)]


def angles(rig: RigCalibration) -> list[tuple[str, str, float, float]]:
    """Return (board, board, deg, sigma deg) of every two boards on one mount."""
    return [(a, b, *t.angle_deg(a, b)) for t in rig.board_rigs for a, b in combinations(t.names, 2)]


def transfers(rig: RigCalibration) -> list[tuple[str, str, float, float]]:
    """Return (from, to, px at the middle corner, px at the worst) of every two cameras that see the same places."""
    from rigkit.calibration.rig.uncertainty import transfer_uncertainty

    found = [transfer_uncertainty(rig, a, b) for a, b in combinations([c.name for c in rig.cameras], 2)]
    return [(t.a, t.b, t.median_px, t.worst_px) for t in found if t is not None]


def describe(rig: RigCalibration, checks: list[Check]) -> str:
    """Return the result for a person: the headline first."""
    import numpy as np

    from rigkit.geometry.rotation import log_so3

    held = "held-out RMS not available" if rig.heldout_rms_px is None else f"held-out RMS {rig.heldout_rms_px:.4f} px"
    count = len(rig.cameras)
    lines = [
        f"{count} camera{'s' if count > 1 else ''}, {rig.shared_count} poses shared by several views: {held}, training "
        f"RMS {rig.rms_px:.4f} px; frames scatter {rig.overdispersion:.2f} times as independent corners would"
    ]
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        held = "not available" if alone.heldout_rms_px is None else f"{alone.heldout_rms_px:.4f} px"
        x, y, z = camera.cam_from_rig.inverse().translation_mm
        turned = np.degrees(np.linalg.norm(log_so3(camera.cam_from_rig.rotation)))
        lines.append(
            f"{camera.name}: {camera.camera.model}, alone held-out RMS {held}, training RMS {alone.rms_px:.4f}; in the "
            f"rig {camera.rms_px:.4f} px; at ({x:.2f}, {y:.2f}, {z:.2f}) mm, turned by {turned:.3f} deg"
        )
    lines += [f"baseline {a} to {b}: {value:.3f} +- {sigma:.3f} mm" for a, b, value, sigma in baselines(rig)]
    lines += [
        f"a point seen by {a} appears in {b} within {middle:.3f} px (one standard deviation; {worst:.3f} at worst)"
        for a, b, middle, worst in transfers(rig)
    ]
    lines += [f"angle {a} to {b}: {value:.3f} +- {sigma:.3f} deg" for a, b, value, sigma in angles(rig)]
    for c in checks:
        verdict = "as measured" if c.passed else "NOT as measured"
        lines.append(
            f"{c.name} {verdict}: {c.ours:.3f} {c.unit}, measured {c.measured:g} +- {c.measured_sigma:g} {c.unit} "
            f"({c.how}), off by {c.k:.1f} combined sigmas"
        )
    lines += [f"frame {frame}, board '{board}' left out: {reason}" for frame, board, reason in rig.left_out]
    for camera, alone in zip(rig.cameras, rig.single, strict=True):
        lines += [f"{camera.name}: dropped {image}: {reason}" for image, reason in alone.dropped]
        lines += [f"{camera.name} alone: {verdict}" for verdict in alone.verdicts]
    return "\n".join([*lines, *map(str, rig.verdicts)])
