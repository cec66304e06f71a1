"""`rigkit plan`: suggest the next images to take, or predict the accuracy of a lens, a board and a number of images.

examples:
  rigkit plan calibration.json -r next.html               the three images that would help most, drawn
  rigkit plan rig.json                                    the same for a rig, of all cameras at once
  rigkit plan calibration.json --check                    the three best images for rigkit check
  rigkit plan session.toml -n 5 --length 800 --distance 1500
  rigkit plan --lens 120 --size 1280x960 --board 9x6x30 --views 12
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rigkit.cli.aim_arguments import add_board_argument, add_reach_arguments, length_of
from rigkit.cli.console import add_options, options_of, progress_on_stderr, require_existing, size_of_words
from rigkit.core.errors import ExitCode, InputError
from rigkit.core.reach import Reach
from rigkit.workflows.options.boards import TYPICAL_SIGMA_PX, LensOptions, PlanOptions

if TYPE_CHECKING:
    from rigkit.workflows.capture.plan import PlannedSession

MAX_VIEWS = 100
"""Nobody takes more by a plan."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source",
        nargs="?",
        type=Path,
        metavar="CALIBRATION|RIG.json|SESSION.toml",
        help="calibration or session to improve; or give --lens",
    )
    add_options(parser, PlanOptions, count="-n --views N", check="")
    parser.add_argument("--length", type=float, metavar="MM", help="optimise the measurement of a length of MM")
    parser.add_argument(
        "--distance", type=float, metavar="MM", help="at this distance (default: the projection over the image)"
    )
    add_reach_arguments(parser)
    add_options(parser, PlanOptions, report="-r [plan.html]", force="")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    lens = parser.add_argument_group("before there is a calibration")
    lens.add_argument("--lens", type=float, metavar="DEG", help="field of view across the width of the image")
    lens.add_argument("--size", metavar="WxH", help="image size, px")
    add_board_argument(lens, "board, such as 9x6x25 (repeatable)")
    add_options(lens, LensOptions, model="")
    lens.add_argument(
        "--sigma-px", type=float, metavar="PX", help="standard deviation of a corner per coordinate (default: 0.15)"
    )


def run(args: argparse.Namespace) -> int:
    done = _planned(args)
    from rigkit.cli.console import note_written, print_json
    from rigkit.core.printing import counted
    from rigkit.report.pages.plan_page import plan_facts, plan_lead, plan_to_dict, plan_words
    from rigkit.report.tables import tables_to_text

    plan = done.plan
    if args.json:
        print_json(plan_to_dict(plan) | {"page": plan_facts(plan, done.found).to_dict()})
    else:
        print(plan_lead(plan))
        print("\n".join(f"  {line}" for line in plan_words(plan)))
        if done.found:
            print(tables_to_text(done.found))
        elif args.lens is None:
            print(f"{counted(len(plan.views), 'more image')}: {100.0 * plan.gain:.0f} % less error")
    note_written(done.written)
    return ExitCode.WELL


def _planned(args: argparse.Namespace) -> PlannedSession:
    if (args.source is None) == (args.lens is None):
        raise InputError("plan: give a calibration or a session, or describe a lens with --lens, --size and --board")
    if args.check and (args.lens is not None or args.length is not None):
        raise InputError("plan: --check needs a calibration or a rig; leave out --lens and --length")
    if args.lens is None:
        given = [name for name in ("size", "board", "model", "sigma_px") if getattr(args, name)]
        if given:
            raise InputError(
                f"plan: --{given[0].replace('_', '-')} needs --lens; '{args.source}' states it itself, leave it out"
            )
        require_existing(args.source)
        from rigkit.workflows.capture.plan import plan_session

        return plan_session(args.source, _options(args), progress=progress_on_stderr())
    from rigkit.io.boards.board_words import board_files, board_of_words
    from rigkit.io.disk.writing import ensure_writable
    from rigkit.workflows.capture.plan import plan_lens

    if not (args.size and args.board):
        raise InputError("plan: --lens needs --size 1280x960 and --board 9x6x25")
    size_px = size_of_words(args.size)
    ensure_writable(args.report, force=args.force, inputs=board_files(args.board))
    sigma = TYPICAL_SIGMA_PX if args.sigma_px is None else args.sigma_px
    if not 0.0 < sigma < float("inf"):
        raise InputError(f"--sigma-px {sigma}: it must be positive")
    lens = LensOptions(
        hfov_deg=args.lens,
        size_px=size_px,
        boards=tuple(board_of_words(words) for words in args.board),
        model=args.model,
        sigma_px=sigma,
    )
    return plan_lens(lens, _options(args))


def _options(args: argparse.Namespace) -> PlanOptions:
    if args.count is not None and not 1 <= args.count <= MAX_VIEWS:
        raise InputError(f"--views {args.count}: 1 to {MAX_VIEWS}")
    return options_of(PlanOptions, args, length=length_of(args, "plan"), reach=options_of(Reach, args))
