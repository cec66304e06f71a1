"""`rigkit demo`: renders a capture with known truth and runs everything on it."""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.core.errors import InputError

HELP = "render a small fisheye capture and run the whole job on it; needs no data"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", default="rigkit-demo", metavar="DIR", help="new folder (default rigkit-demo)")
    parser.add_argument("--seed", type=int, default=1, help="of the random scene (default 1)")
    parser.add_argument("-j", "--jobs", type=int, metavar="N", help="processes (default: one a core)")
    parser.add_argument("--json", action="store_true", help="print the result for programs")
    # The rest of what `rigkit validate` takes, at its defaults.
    parser.set_defaults(
        force=False, recalibrate=False, chain="raw", no_pictures=False, no_crosscheck=False, figures="png"
    )


def run(args: argparse.Namespace) -> int:
    import json

    import numpy as np

    from rigkit.cli.console import note, progress_on_stderr
    from rigkit.cli.validate import validate_dataset
    from rigkit.io.manifest import load_dataset
    from rigkit.synthetic.demo import build_demo

    if args.seed < 0:
        raise InputError(f"demo: --seed {args.seed}: a number from 0 upwards is needed")
    root = Path(args.output)
    manifest = build_demo(root, np.random.default_rng(args.seed), progress_on_stderr())
    note(f"capture written to {root}: images, boards, {manifest.name}, and truth.json, which rigkit does not read")
    code = validate_dataset(args, load_dataset(manifest), root / "out")
    if not args.json:
        truth = json.loads((root / "truth.json").read_text(encoding="utf-8"))
        for name, pair in truth["pairs"].items():
            print(f"exact baseline of {name}: {pair['baseline_mm']:.2f} mm")
    return code
