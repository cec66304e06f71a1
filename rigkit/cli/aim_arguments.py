"""Arguments of several verbs for boards, their positions, and a length to be measured."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from rigkit.core.errors import InputError

if TYPE_CHECKING:
    from rigkit.core.measurement_task import Task
    from rigkit.core.reach import Reach


def add_board_argument(parser: argparse._ActionsContainer, words: str, *, required: bool = False) -> None:
    """Add boards, with the help text `words`."""
    parser.add_argument(
        "--board", action="append", default=[], required=required, metavar="CxRxMM|BOARD.toml", help=words
    )


def add_reach_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the limits of the positions of boards."""
    parser.add_argument("--near", type=float, default=0.0, metavar="MM", help="smallest distance of the board")
    parser.add_argument("--far", type=float, default=float("inf"), metavar="MM", help="largest distance of the board")
    parser.add_argument(
        "--field", type=float, metavar="DEG", help="full field of view of the lens, where boards can be seen"
    )


def reach_of(args: argparse.Namespace) -> Reach:
    """Return the limits of the positions of boards."""
    from rigkit.core.reach import Reach

    return Reach(nearest_mm=args.near, farthest_mm=args.far, field_deg=args.field)


def length_of(args: argparse.Namespace, verb: str) -> Task | None:
    """Return the length to be measured, or None; raises InputError for a length without distance or vice versa."""
    from rigkit.core.measurement_task import Quantity, Task

    if (args.length is None) != (args.distance is None):
        raise InputError(f"{verb}: --length and --distance belong together")
    if args.length is None:
        return None
    return Task(quantity=Quantity.LENGTH, size_mm=args.length, distance_mm=args.distance)
