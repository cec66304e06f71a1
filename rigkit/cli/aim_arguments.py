"""Arguments of several verbs for boards, their positions, and a length to be measured."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from rigkit.cli.console import add_options
from rigkit.core.errors import InputError

if TYPE_CHECKING:
    from rigkit.core.measurement_task import Task


def add_board_argument(parser: argparse._ActionsContainer, words: str, *, required: bool = False) -> None:
    """Add boards, with the help text `words`."""
    parser.add_argument(
        "--board", action="append", default=[], required=required, metavar="CxRxMM|BOARD.toml", help=words
    )


def add_reach_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the limits of the positions of boards, which `options_of(Reach, args)` reads."""
    from rigkit.core.reach import Reach

    add_options(parser, Reach, nearest_mm="--near MM", farthest_mm="--far MM", field_deg="--field DEG")


def length_of(args: argparse.Namespace, verb: str) -> Task | None:
    """Return the length to be measured, or None; raises InputError for a length without distance or vice versa."""
    from rigkit.core.measurement_task import Quantity, Task

    if (args.length is None) != (args.distance is None):
        raise InputError(f"{verb}: --length and --distance belong together")
    if args.length is None:
        return None
    return Task(quantity=Quantity.LENGTH, size_mm=args.length, distance_mm=args.distance)
