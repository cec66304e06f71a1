"""`rigkit demo`: render a small fisheye capture with ground truth and run every step on it; needs no data."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", default="rigkit-demo", metavar="DIR", help="new folder (default rigkit-demo)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the random scene (default 1)")
    parser.add_argument("-j", "--jobs", type=int, metavar="N", help="number of processes (default: one per core)")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.console import progress_on_stderr
    from rigkit.cli.validation_words import show
    from rigkit.workflows.demo import DemoOptions, run_demo

    options = DemoOptions(output=Path(args.output), seed=args.seed, jobs=args.jobs)
    done = run_demo(options, progress=progress_on_stderr())
    code = show(done.validation, done.output, json=args.json)
    if not args.json:
        for name, baseline_mm in done.exact_baselines_mm.items():
            print(f"exact baseline of {name}: {baseline_mm:.2f} mm")
    return code
