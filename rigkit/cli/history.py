"""`rigkit history`: plot a register of checks as drift over time, with control limits.

examples:
  rigkit history calib/history/cam.jsonl -r history.html
  rigkit history cam.jsonl --add new.json --to calibration.json      the change from an old calibration to a new one
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.cli.console import page_path
from rigkit.core.errors import ExitCode, printable


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "register", type=Path, metavar="FILE.jsonl", help="register written by `rigkit check --register`"
    )
    parser.add_argument(
        "--add",
        type=Path,
        metavar="NEW.json",
        help="append the change between the calibration CALIBRATION.json and this newer one",
    )
    parser.add_argument(
        "--to", type=Path, metavar="CALIBRATION.json", help="the calibration that --add is compared with"
    )
    parser.add_argument("--temperature", type=float, metavar="C", help="temperature during the capture for --add")
    parser.add_argument(
        "-r",
        "--report",
        nargs="?",
        const=Path("history.html"),
        type=page_path,
        metavar="history.html",
        help="write an HTML report",
    )
    parser.add_argument("--force", action="store_true", help="replace an existing page")
    parser.add_argument("--json", action="store_true", help="print the entries as JSON")


def run(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from rigkit.cli.console import note, note_written, print_json
    from rigkit.core.errors import InputError
    from rigkit.io.disk.reading import read_text

    if (args.add is None) != (args.to is None):
        raise InputError("history: --add NEW.json needs --to CALIBRATION.json, the calibration to compare it with")
    if args.temperature is not None and args.add is None:
        raise InputError("history: --temperature belongs to --add and --to; give these, too")
    if args.add is None:
        # A register that cannot be read is refused before everything else is imported.
        read_text(args.register, "register")
    from rigkit.workflows.checks.history import add_to_history, show_history

    if args.add is not None:
        add_to_history(args.register, args.add, args.to, temperature_c=args.temperature)
        note(f"1 entry appended to {args.register}")
    entries, written = show_history(args.register, report=args.report, force=args.force)
    if args.json:
        print_json([asdict(entry) for entry in entries])
    else:
        for entry in entries:
            heat = "" if entry.temperature_c is None else f", {entry.temperature_c:g} C"
            print(
                printable(f"{entry.date} {entry.kind} of {entry.source}{heat}: p = {entry.chance:.3g}, {entry.verdict}")
            )
    note_written(written)
    return ExitCode.WELL
