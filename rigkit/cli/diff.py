"""`rigkit diff`: compare two calibrations, two rigs, or two mounts of boards, within their uncertainties.

examples:
  rigkit diff monday.json friday.json -r diff.html      a report with the map of the difference
  rigkit diff rig.json rig-new.json                     intrinsics and extrinsics
  rigkit diff calibration.json camchain.yaml            a file of another tool: no covariance, so no verdict
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import add_options, note_written, options_of, print_json, require_existing
from rigkit.core.errors import ExitCode
from rigkit.workflows.options.cameras import DiffOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("a", type=Path, metavar="A.json", help="a calibration, a rig, or rigidly mounted boards")
    parser.add_argument("b", type=Path, metavar="B.json", help="the other one, of the same camera, rig or boards")
    add_options(parser, DiffOptions, output="-o MAP.png", report="-r [diff.html]", force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    require_existing(args.a, args.b)
    from rigkit.workflows.checks.diff import diff
    from rigkit.workflows.checks.diff_output import facts_of, figures_of, words_of, write_diff_page

    options = options_of(DiffOptions, args)
    done = diff(args.a, args.b, options)
    if args.report is not None:
        write_diff_page(args.report, done, (args.a, args.b), force=args.force)
    if args.json:
        print_json(figures_of(done) | {"page": facts_of(done).to_dict()})
    else:
        print("\n".join(words_of(done)))
    note_written(path for path in (args.output, args.report) if path is not None)
    return ExitCode.CHECK_FAILED if done.same is False else ExitCode.WELL
