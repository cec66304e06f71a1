"""`rigkit certify`: bound the error of a length, depth, plane or angle measured with a calibration or rig.

Exit code 1 where the bound exceeds --limit or none is certified, or the calibration's verdict is bad.

examples:
  rigkit certify rig.json --length 800 --distance 1500 -r certificate.html
  rigkit certify rig.json --depth 100 --distance 2000 --limit 5 --pdf certificate.pdf      exit 1 above 5 mm
  rigkit certify calibration.json --length 50 --distance 400 --distance-sigma 1
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import add_options, note_written, options_of, print_json, print_statement, require_existing
from rigkit.workflows.options.cameras import CertifyOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("calibration", type=Path, metavar="RIG_OR_CALIBRATION", help="rig.json or calibration.json")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--length", type=float, metavar="MM", help="a length across the line of sight")
    what.add_argument("--depth", type=float, metavar="MM", help="a length along the line of sight (rigs)")
    what.add_argument("--plane", type=float, metavar="MM", help="flatness of a square plane with such a side (rigs)")
    what.add_argument("--angle", type=float, metavar="MM", help="a right angle between edges of this length (rigs)")
    parser.add_argument(
        "--distance", type=float, required=True, metavar="MM", help="distance of the object from the first camera"
    )
    parser.add_argument(
        "--distance-sigma", type=float, default=0.0, metavar="MM", help="one camera: standard deviation of the distance"
    )
    parser.add_argument(
        "--confidence", type=float, default=95.0, metavar="PERCENT", help="confidence level of the bound (default: 95)"
    )
    add_options(parser, CertifyOptions, limit="X", sigma_px="PX", cameras="--names NAME")
    add_options(parser, CertifyOptions, report="-r [certificate.html]", pdf="FILE.pdf", force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    require_existing(args.calibration)
    from rigkit.core.errors import ExitCode, InputError
    from rigkit.core.measurement_task import Quantity, Task
    from rigkit.report.pages.certificate_page import basis, causes_table
    from rigkit.report.tables import tables_to_text
    from rigkit.workflows.checks.certify import certify_file

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
