"""`rigkit history`: a register of checks over months as drift plots with control limits."""

from __future__ import annotations

import argparse
from pathlib import Path

from rigkit.core.errors import ExitCode, printable


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("register", type=Path, metavar="FILE.jsonl", help="as `rigkit check --register` wrote it")
    parser.add_argument("--add", type=Path, metavar="NEW.json", help="a calibration made anew, added to the register,")
    parser.add_argument("--to", type=Path, metavar="CALIBRATION.json", help="as a change of this one")
    parser.add_argument("--temperature", type=float, metavar="C", help="of the calibration added")
    parser.add_argument("-r", "--report", type=Path, metavar="FILE.html", help="write a page to look at")
    parser.add_argument("--force", action="store_true", help="replace an existing page")
    parser.add_argument("--json", action="store_true", help="print the entries for programs")


def run(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from rigkit.cli.console import note, note_written, print_json
    from rigkit.core.errors import InputError
    from rigkit.workflows.checks.history import add_to_history, show_history

    if (args.add is None) != (args.to is None):
        raise InputError("history: --add NEW.json needs --to CALIBRATION.json, the one that it is compared with")
    if args.temperature is not None and args.add is None:
        raise InputError("history: --temperature is of a calibration that is added; give --add and --to, too")
    if args.add is not None:
        add_to_history(args.register, args.add, args.to, temperature_c=args.temperature)
        note(f"{args.register} has one entry more")
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
