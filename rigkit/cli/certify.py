"""`rigkit certify`: how wrong a length, depth, plane or angle may be that is measured with a calibration or a rig.

Exit code 1 above --limit, and with a calibration that was called bad.
"""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("calibration", type=Path, metavar="RIG_OR_CALIBRATION", help="rig.json or calibration.json")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--length", type=float, metavar="MM", help="a length across the line of sight")
    what.add_argument("--depth", type=float, metavar="MM", help="a length along the line of sight (rigs)")
    what.add_argument("--plane", type=float, metavar="MM", help="how flat a plane with such sides looks (rigs)")
    what.add_argument("--angle", type=float, metavar="MM", help="a right angle between edges so long (rigs)")
    parser.add_argument("--distance", type=float, required=True, metavar="MM", help="from the first camera")
    parser.add_argument(
        "--distance-sigma", type=float, default=0.0, metavar="MM", help="one camera: how well the distance is known"
    )
    parser.add_argument(
        "--limit", type=float, metavar="X", help="largest error allowed, mm (deg for angles); exit 1 above"
    )
    parser.add_argument("--confidence", type=float, default=95.0, metavar="PERCENT", help="default: 95")
    parser.add_argument("--sigma-px", type=float, metavar="PX", help="of the corners to be measured, per coordinate")
    parser.add_argument("--cameras", nargs=2, metavar="NAME", help="two cameras of the rig (default: the first two)")
    parser.add_argument("-r", "--report", type=Path, metavar="FILE.html", help="write a page to look at")
    parser.add_argument("--pdf", type=Path, metavar="FILE.pdf", help="write a sheet of A4 to sign")
    parser.add_argument("--force", action="store_true", help="replace existing files")
    parser.add_argument("--json", action="store_true", help="print the result for programs")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.console import note_written, options_of, print_json, print_statement
    from rigkit.core.errors import ExitCode, InputError
    from rigkit.report.pages.certificate_page import basis, causes_table
    from rigkit.report.tables import tables_to_text
    from rigkit.validation.certificate.contracts import Quantity, Task
    from rigkit.workflows.checks.certify import CertifyOptions, certify_file

    quantity = next(q for q in Quantity if getattr(args, q) is not None)
    if args.sigma_px is not None and not 0.0 < args.sigma_px < float("inf"):
        raise InputError(f"--sigma-px {args.sigma_px}: it must be positive")
    task = Task(
        quantity=quantity,
        size_mm=getattr(args, quantity),
        distance_mm=args.distance,
        distance_sigma_mm=args.distance_sigma,
        confidence=args.confidence / 100.0,
    )
    done = certify_file(args.calibration, task, options_of(CertifyOptions, args))
    certificate, words = done.certificate, done.words
    if args.json:
        verdict_fields = {"passed": words.passed, "statement": words.headline, "basis": basis(certificate)}
        print_json(certificate.to_dict() | verdict_fields | {"page": words.to_dict()})
    else:
        print_statement(words)
        print(tables_to_text([causes_table(certificate)]))
    note_written(done.written)
    return ExitCode.CHECK_FAILED if words.passed is False else ExitCode.WELL
