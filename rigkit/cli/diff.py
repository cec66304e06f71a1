"""`rigkit diff`: two calibrations over the image, or two rigs, against what their uncertainties predict."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

HELP = "difference of two calibrations over the image: px map and numbers; same camera or not; or of two rigs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("a", type=Path, metavar="A.json", help="calibration, or a rig")
    parser.add_argument("b", type=Path, metavar="B.json", help="calibration, or a rig")
    parser.add_argument("-o", "--output", type=Path, metavar="MAP.png", help="map of the difference")
    parser.add_argument("--force", action="store_true", help="replace an existing map")
    parser.add_argument("--json", action="store_true", help="print the result for programs")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.console import print_json
    from rigkit.core.errors import ExitCode, InputError
    from rigkit.io.files import ensure_writable
    from rigkit.io.rig_file import is_rig_file

    rigs = [is_rig_file(path) for path in (args.a, args.b)]
    if all(rigs):
        if args.output is not None:
            raise InputError("diff: a map is of two cameras; give the calibrations beside the rigs, rig-CAMERA.json")
        figures = _rigs(args.a, args.b)
        print_json(figures) if args.json else print(_rigs_in_words(figures))
        return ExitCode.CHECK_FAILED if figures["same"] is False else 0
    if any(rigs):
        other = args.b if rigs[0] else args.a
        raise InputError(f"diff: a rig and a camera; compare '{other}' with the calibration beside the rig")
    if args.output is not None:
        ensure_writable(args.output, force=args.force, inputs=(args.a, args.b))
    figures = _cameras(args.a, args.b, args.output, force=args.force)
    print_json(figures) if args.json else print(_camera_in_words(figures))
    return ExitCode.CHECK_FAILED if figures["same"] is False else 0


def _cameras(a: Path, b: Path, output: Path | None = None, *, force: bool = False) -> dict[str, Any]:
    """Return the difference of two cameras; `same` is None where a file has no covariance."""
    from rigkit.calibration.compare import compare_calibrations
    from rigkit.cameras.compare import compare_cameras
    from rigkit.io.calibration_file import is_calibration, load_calibration, load_camera
    from rigkit.io.files import write_atomic
    from rigkit.report.figures import difference_png

    cameras = load_camera(a), load_camera(b)
    # A camera from another tool comes without covariance: then there is a difference but no verdict.
    known = all(is_calibration(path) for path in (a, b))
    result = compare_calibrations(load_calibration(a), load_calibration(b)) if known else None
    difference = compare_cameras(*cameras) if result is None else result.difference
    if output is not None:
        write_atomic(output, difference_png(difference), force=force)
    return {
        "rms_px": difference.rms_px,
        "max_px": difference.max_px,
        "rotation_deg": difference.rotation_deg,
        "coverage": difference.coverage,
        "ratio": None if result is None else result.ratio,
        "chance": None if result is None else result.chance,
        "same": None if result is None else result.same,
        "same_model": None if result is None else result.same_model,
    }


def _camera_in_words(figures: dict[str, Any]) -> str:
    line = (
        f"difference {figures['rms_px']:.4f} px rms, {figures['max_px']:.4f} px at most, over "
        f"{100 * figures['coverage']:.0f} % of the image, after a rotation of {figures['rotation_deg']:.4f} deg\n"
    )
    if figures["same"] is None:
        return line + "no verdict: a file has no covariance"
    verdict = "the same camera" if figures["same"] else "NOT the same camera, or a moved lens"
    return line + (
        f"{figures['ratio']:.2f} times what the uncertainties predict (chance {figures['chance']:.3g}): {verdict}"
        + ("" if figures["same_model"] else "; the chance allows for what their different models make of one lens")
    )


def _rigs(a: Path, b: Path) -> dict[str, Any]:
    """Return the differences of the mounts, and of the cameras where their calibrations lie beside the rigs."""
    from dataclasses import asdict

    from rigkit.calibration.rig.compare import compare_mounts
    from rigkit.core.errors import InputError
    from rigkit.io.rig_file import load_saved_rig

    first, second = load_saved_rig(a), load_saved_rig(b)
    names = list(first.cameras)
    if names != list(second.cameras):
        raise InputError(f"diff: '{a}' has the cameras {', '.join(names)}, '{b}' {', '.join(second.cameras)}")
    mounts = compare_mounts(
        names,
        [first.cameras[name][1] for name in names],
        [second.cameras[name][1] for name in names],
        first.mount_covariance,
        second.mount_covariance,
    )
    cameras = {}
    for name in names:
        beside = [path.with_name(f"{path.stem}-{name}.json") for path in (a, b)]
        if all(path.is_file() for path in beside):
            cameras[name] = _cameras(*beside)
    known = [s for s in (mounts.same, *(c["same"] for c in cameras.values())) if s is not None]
    return {
        "mounts": [asdict(m) for m in mounts.mounts],
        "chance": mounts.chance,
        "cameras": cameras,
        "same": all(known) if known else None,
    }


def _rigs_in_words(figures: dict[str, Any]) -> str:
    lines = [
        f"{m['name']}: sits {m['shift_mm']:.3f} mm and {m['rotation_deg']:.4f} deg from where it sat"
        + ("" if m["chance"] is None else f" (chance {m['chance']:.3g})")
        for m in figures["mounts"]
    ]
    lines += [f"{name}: {_camera_in_words(own)}".replace("\n", "; ") for name, own in figures["cameras"].items()]
    if figures["same"] is None:
        return "\n".join([*lines, "no verdict: a file has no covariance"])
    chance = "" if figures["chance"] is None else f"mounts together: chance {figures['chance']:.3g}; "
    verdict = "the same rig" if figures["same"] else "NOT the same rig: a camera or a lens moved"
    return "\n".join([*lines, f"{chance}{verdict}"])
