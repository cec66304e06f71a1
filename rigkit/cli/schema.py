"""`rigkit schema`: list the keys of every file format, as JSON Schema for editors and programs, or as a table.

examples:
  rigkit schema                          list the file formats
  rigkit schema session --keys           every key of a session file with its meaning
  rigkit schema session -o session.json  for editors: first line of the session #:schema ./session.json
"""

from __future__ import annotations

import argparse

from rigkit.cli.console import file_path
from rigkit.core.errors import ExitCode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", nargs="?", metavar="NAME", help="file format (default: list all)")
    parser.add_argument("--keys", action="store_true", help="print a table of keys instead of JSON Schema")
    parser.add_argument("-o", "--output", type=file_path, metavar="FILE.json", help="file to write")
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def run(args: argparse.Namespace) -> int:
    from rigkit.io.schema_names import require_schema

    if args.name is not None:
        require_schema(args.name)
    from rigkit.io.disk.writing import write_atomic
    from rigkit.io.schema import SCHEMAS, key_rows, schema_text

    if args.name is None:
        for name, schema in SCHEMAS.items():
            print(f"{name:14}{schema['title']}")
        return ExitCode.WELL
    if args.output is not None:
        write_atomic(args.output, schema_text(args.name), force=args.force)
        print(args.output)
    elif args.keys:
        for key, kind, words in key_rows(SCHEMAS[args.name]):
            print(f"{key + '  ':40}{kind + '  ':30}{words}")
    else:
        print(schema_text(args.name), end="")
    return ExitCode.WELL
