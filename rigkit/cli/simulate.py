"""`rigkit simulate`: synthetic studies, from a study file to tables and box plots."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "the synthetic study: sweeps over noise, box plots, tables"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("studies", nargs="+", metavar="STUDY.toml", help="one or more study files")
    parser.add_argument("-o", "--output", default="out/studies", metavar="FOLDER", help="default: out/studies")
    parser.add_argument("--trials", type=int, metavar="N", help="instead of the number in the file")
    parser.add_argument("-j", "--jobs", type=int, default=1, metavar="N", help="processes; the numbers stay the same")
    parser.add_argument("--dask", metavar="ADDRESS", help="a Dask scheduler to use instead of processes")
    parser.add_argument("--format", choices=("png", "pdf", "svg"), default="png", help="of the figures")
    parser.add_argument("--json", action="store_true", help="print the tables as JSON instead of Markdown")
    parser.add_argument("--force", action="store_true", help="replace existing files")


def run(args: argparse.Namespace) -> int:
    from dataclasses import replace

    from rigkit.cli.console import note, print_json, progress_on_stderr
    from rigkit.core.errors import InputError
    from rigkit.io.files import ensure_writable, write_together
    from rigkit.io.study_file import load_study
    from rigkit.io.study_run import run_study
    from rigkit.report.study_figure import study_figure
    from rigkit.study.table import tabulate

    if args.jobs < 1:
        raise InputError(f"simulate: --jobs must be at least 1, got {args.jobs}")
    studies = [load_study(path) for path in args.studies]
    if args.trials is not None:
        studies = [replace(study, trials=args.trials) for study in studies]
    names = [study.name for study in studies]
    if len(set(names)) < len(names):
        raise InputError(f"simulate: two studies have the same name ({', '.join(sorted(names))}); rename one")
    out = Path(args.output)
    suffixes = ("csv", "json", "md", args.format)
    for study in studies:
        ensure_writable([out / f"{study.name}.{suffix}" for suffix in suffixes], force=args.force)
    results = []
    for study in studies:
        chunks = run_study(
            study, jobs=args.jobs, dask=args.dask, parts=out / f".{study.name}.parts", progress=progress_on_stderr()
        )
        table = tabulate(study, chunks)
        results.append(table.to_dict())
        files: dict[str, str | bytes] = {
            "csv": table.to_csv(),
            "json": _json(results[-1]),
            "md": table.to_markdown(),
            args.format: study_figure(table, args.format),
        }
        write_together({out / f"{study.name}.{suffix}": data for suffix, data in files.items()}, force=args.force)
        if not args.json:
            print(table.to_markdown())
        note(f"{study.name}: {', '.join(str(out / f'{study.name}.{suffix}') for suffix in suffixes)}")
    if args.json:
        print_json(results)
    return 0


def _json(value: object) -> str:
    import json

    return json.dumps(value, indent=1, allow_nan=False) + "\n"
