"""`rigkit diff`: two calibrations over the image, against what their uncertainties predict."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "difference of two calibrations over the image: px map and numbers; same camera or not"

EXIT_DIFFERENT = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("a", type=Path, metavar="A.json", help="calibration")
    parser.add_argument("b", type=Path, metavar="B.json", help="calibration")
    parser.add_argument("-o", "--output", type=Path, metavar="MAP.png", help="map of the difference")
    parser.add_argument("--force", action="store_true", help="replace an existing map")
    parser.add_argument("--json", action="store_true", help="print the result for programs")


def run(args: argparse.Namespace) -> int:
    import json

    from rigkit.calibration.compare import compare_calibrations
    from rigkit.cameras.compare import compare_cameras
    from rigkit.cli.console import print_json
    from rigkit.io.calibration_file import load_calibration, load_camera
    from rigkit.io.files import ensure_writable, write_atomic
    from rigkit.report.figures import difference_png

    if args.output is not None:
        ensure_writable(args.output, force=args.force)
    cameras = load_camera(args.a), load_camera(args.b)
    # A camera from another tool comes without covariance: then there is a difference but no verdict.
    known = all("covariance" in json.loads(path.read_text(encoding="utf-8")) for path in (args.a, args.b))
    result = compare_calibrations(load_calibration(args.a), load_calibration(args.b)) if known else None
    difference = compare_cameras(*cameras) if result is None else result.difference
    if args.output is not None:
        write_atomic(args.output, difference_png(difference), force=args.force)
    figures = {
        "rms_px": difference.rms_px,
        "max_px": difference.max_px,
        "rotation_deg": difference.rotation_deg,
        "coverage": difference.coverage,
        "ratio": None if result is None else result.ratio,
        "chance": None if result is None else result.chance,
        "same": None if result is None else result.same,
    }
    if args.json:
        print_json(figures)
    else:
        print(
            f"difference {difference.rms_px:.4f} px rms, {difference.max_px:.4f} px at most, over "
            f"{100 * difference.coverage:.0f} % of the image, after a rotation of {difference.rotation_deg:.4f} deg"
        )
        if result is None:
            print("no verdict: a file has no covariance")
        else:
            verdict = "the same camera" if result.same else "NOT the same camera, or a moved lens"
            print(f"{result.ratio:.2f} times what the uncertainties predict (chance {result.chance:.3g}): {verdict}")
    return EXIT_DIFFERENT if result is not None and not result.same else 0
