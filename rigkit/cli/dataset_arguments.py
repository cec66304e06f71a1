"""Common arguments of the verbs on a data set, named like the options that they make; the folder of results, and failed
pairs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rigkit.cli.console import add_options, note
from rigkit.workflows.options.clouds import DatasetOptions

if TYPE_CHECKING:
    from rigkit.workflows.reconstruction.datasets import PairFailure

NO_DATASET = "write one, or let `rigkit init` start it"
"""What to do about a data set that does not exist."""


def add_dataset_arguments(parser: argparse.ArgumentParser, *, optional: bool = False, several: bool = False) -> None:
    """Add the common arguments; `optional`: the verb refuses no or several data sets itself; `several`: it uses all."""
    number = "*" if optional else "+" if several else None
    parser.add_argument(
        "dataset", metavar="DATASET", nargs=number, help="folder with a dataset.toml, or the file itself"
    )
    add_options(parser, DatasetOptions, pairs="-p --pair ID")
    parser.add_argument("-o", "--output", metavar="DIR", help="folder for results (default: a new one, out/<data set>)")
    add_options(parser, DatasetOptions, force="", recalibrate="", chain="", jobs="-j N")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_direction_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the choices of directions that normals are computed from."""
    parser.add_argument(
        "--directions",
        dest="support",
        default=argparse.SUPPRESS,
        choices=("chord", "neighbours", "line", "patch"),
        help="edge directions at a corner, from the next corner, both neighbours, a line of five or a patch of 5x5 "
        "corners (default)",
    )
    parser.add_argument(
        "--det-scale",
        default=argparse.SUPPRESS,
        choices=("area", "ls", "sqmean", "diagonal"),
        help="scale of DET3UDIR: signed area (default), least squares, the paper's squared mean, diagonal",
    )


def has_directions(args: argparse.Namespace) -> bool:
    """Return whether directions or their scale are given."""
    return "support" in args or "det_scale" in args


def add_planes_argument(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the choice of the boards' planes; `what` it affects is for the help text."""
    parser.add_argument(
        "--planes",
        choices=("free", "coplanar", "lattice"),
        help=f"{what}: free: every point triangulated by itself (default, unless the manifest says otherwise); "
        "coplanar: all points of a board in one plane; lattice: on its known grid; the latter two are fitted to both "
        "images",
    )


def results_folder(args: argparse.Namespace, name: str) -> Path:
    """Return the folder of `--output`, or a new one of that name."""
    from rigkit.workflows.outputs.results import new_results_folder

    return Path(args.output) if args.output else new_results_folder(name, force=args.force)


def failed_pairs(failures: Sequence[PairFailure]) -> dict[str, dict[str, str]]:
    """Return the failures as JSON values; {} without any."""
    return {"failed": {failure.pair_id: str(failure.error) for failure in failures}} if failures else {}


def exit_code_of(failures: Sequence[PairFailure], otherwise: int) -> int:
    """Log the failed pairs; return the exit code of the first one's error, or `otherwise` without failures."""
    for failure in failures:
        note(str(failure))
    return failures[0].error.exit_code if failures else otherwise
