"""`rigkit fetch`: download public captures with measured ground truth, or list them.

examples:
  rigkit fetch                          list the captures
  rigkit fetch caliper-board -o data
"""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", nargs="*", metavar="NAME", help="captures to download (default: list all)")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="where captures are kept (default: RIGKIT_DATA, or the user's cache)",
    )
    parser.add_argument(
        "--catalogue", type=Path, metavar="DIR", help="folder with their descriptions (default: datasets/public)"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.console import note, print_json, progress_on_stderr
    from rigkit.core.errors import ExitCode, InputError
    from rigkit.workflows.fetch import fetch_public_set, public_sets

    known = public_sets(args.catalogue)
    for name in args.names:
        if name not in known:
            raise InputError(f"no public capture is called '{name}'; there are {', '.join(known)}")
    if not args.names:
        listed = {
            name: {"about": one.about, "licence": one.licence, "source": one.source, "fetchable": len(one.urls)}
            for name, one in known.items()
        }
        if args.json:
            print_json(listed)
        for name, one in known.items() if not args.json else ():
            count, known_count = len(one.sha256), len(one.urls)
            rest = "" if known_count == count else f"; the addresses of the others are not known: see {one.source}"
            print(f"{name}: {one.about} ({one.licence}; {known_count} of {count} files fetchable{rest})")
        return ExitCode.WELL
    done, failed = [], False
    for name in args.names:
        try:
            done.append(fetch_public_set(known[name], args.output, progress=progress_on_stderr()))
        except InputError as error:
            if len(args.names) == 1:
                raise
            note(f"{name}: {error}")
            failed = True
    if args.json:
        print_json(
            {d.described.name: {"folder": str(d.folder), "present": len(d.present), "missing": d.missing} for d in done}
        )
    for d in done:
        if not args.json:
            print(f"{d.described.name}: {len(d.present)} files in {d.folder}, {len(d.fetched)} of them new")
        if d.missing:
            note(
                f"{d.described.name}: {len(d.missing)} files have no known address, such as '{d.missing[0]}'; "
                f"get them from {d.described.source}"
            )
    if failed:
        return ExitCode.BAD_INPUT
    return ExitCode.CHECK_FAILED if any(d.missing for d in done) else ExitCode.WELL
