"""The camera half of `rigkit export`: calibrations to and from the formats of other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.errors import InputError

__all__ = ["FORMATS", "OWN", "add_camera_arguments", "run_camera"]

OWN = "rigkit"
FORMATS = (OWN, "opencv", "kalibr", "ros", "colmap", "ocamcalib", "mrcal")


def add_camera_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what `run_camera` needs: the files are `args.camera` and `args.output`."""
    parser.add_argument("--camera", metavar="FILE", help="a camera: calibration.json, or another program's file")
    parser.add_argument("--from", dest="source", choices=FORMATS, default=OWN, help="format of FILE (default: rigkit)")
    parser.add_argument("--to", dest="target", choices=FORMATS, default=OWN, help="format to write (default: rigkit)")


def run_camera(args: argparse.Namespace) -> int:
    """Convert the camera file; prints what was written, and what was lost."""
    from rigkit.cli.console import note, print_json
    from rigkit.interop.formats import camera_format
    from rigkit.io.calibration_file import load_camera, save_camera
    from rigkit.io.files import ensure_writable, write_atomic

    ensure_writable(args.output, force=args.force)
    camera = (
        load_camera(args.camera)
        if args.source == OWN
        else camera_format(args.source).read(_text(args.camera), args.camera)
    )
    if args.target == OWN:
        save_camera(args.output, camera, force=args.force)
        lost, max_error_px, model = "", 0.0, camera.model
    else:
        written = camera_format(args.target).write(camera)
        write_atomic(args.output, written.text, force=args.force)
        lost, max_error_px, model = written.note, written.max_error_px, written.camera.model
    if args.json:
        print_json(
            {"file": args.output, "format": args.target, "model": model, "max_error_px": max_error_px, "note": lost}
        )
    else:
        print(f"{args.output}: {model}, largest error {max_error_px:.3g} px")
        if lost:
            note(lost)
    return 0


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"'{path}' cannot be read as text ({error.__class__.__name__}); check the path") from error
