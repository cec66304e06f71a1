"""`rigkit demo`: render a small fisheye capture with ground truth and run every step on it; needs no data.

examples:
  rigkit demo                          renders, calibrates, reconstructs, validates: rigkit-demo/out/report.html
  rigkit demo -o demo-7 --seed 7       another random scene
"""

from __future__ import annotations

import argparse

from rigkit.cli.console import add_options, options_of, progress_on_stderr
from rigkit.workflows.options.cameras import DemoOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_options(parser, DemoOptions, output="-o DIR", seed="", jobs="-j N")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.validation_output import show
    from rigkit.workflows.demo import run_demo

    options = options_of(DemoOptions, args)
    done = run_demo(options, progress=progress_on_stderr())
    code = show(done.validation, done.output, json=args.json)
    if not args.json:
        for name, baseline_mm in done.exact_baselines_mm.items():
            print(f"exact baseline of {name}: {baseline_mm:.2f} mm")
    return code
