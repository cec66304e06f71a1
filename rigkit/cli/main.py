"""The `rigkit` program: finds the verb, runs it, turns errors into one line and an exit code.

A verb is a module in this package with `HELP: str`, `add_arguments(parser)` and `run(args) -> int`, one line in `VERBS`
and its examples in `rigkit.cli.examples`. Verb modules import nothing heavy at module level: `rigkit --help` must
answer at once.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from typing import Any

from rigkit.cli.examples import EXAMPLES, FIRST_STEPS
from rigkit.cli.log import add_log_arguments, logged_run, logging_to
from rigkit.cli.surroundings import SURROUNDINGS, Terminated, open_streams, say, settle_stderr, signals_interrupt
from rigkit.core.errors import ExitCode, RigkitError, printable

VERBS: dict[str, tuple[str, str]] = {
    "demo": ("rigkit.cli.demo", "render a small fisheye capture and run the whole job on it; needs no data"),
    "board": ("rigkit.cli.board", "a board to print, true to scale"),
    "calibrate": ("rigkit.cli.calibrate", "calibrate a camera, or several on one mount, from images of boards"),
    "rectify": ("rigkit.cli.rectify", "perspective, cylindrical, equirectangular or stereo images from any camera's"),
    "export": ("rigkit.cli.export", "cameras in other tools' formats; clouds as PLY, LAS, npz or a COLMAP model"),
    "plan": ("rigkit.cli.plan", "which pictures to take next; what a lens, a board and so many pictures will reach"),
    "coach": ("rigkit.cli.coach", "a guided capture on a local page: says what to shoot next and when it is enough"),
    "diff": ("rigkit.cli.diff", "difference of two calibrations over the image; same camera or not"),
    "check": ("rigkit.cli.check", "fresh pictures against a calibration or rig: still holds, or what moved; exit 1"),
    "history": ("rigkit.cli.history", "a register of checks over months: drift plots with control limits"),
    "certify": ("rigkit.cli.certify", "how wrong a length, depth, plane or angle may be that is measured with them"),
    "init": ("rigkit.cli.init", "write a manifest, or a session, from a folder of images"),
    "validate": ("rigkit.cli.validate", "captures beside what was measured of them: a page, clouds; exit 1"),
    "reconstruct": ("rigkit.cli.reconstruct", "oriented clouds (PLY) and pictures of every pair"),
    "mesh": ("rigkit.cli.mesh", "a surface through an oriented cloud (screened Poisson), as a mesh"),
    "crosscheck": ("rigkit.cli.crosscheck", "the pairs of a data set through COLMAP and other ways"),
    "pose": ("rigkit.cli.pose", "where a camera is in the frame of a board that is laid down"),
    "handeye": ("rigkit.cli.handeye", "where a camera sits on a robot, from its poses and images of a board"),
    "detect": ("rigkit.cli.detect", "corners of every board in the images"),
    "simulate": ("rigkit.cli.simulate", "a synthetic study: sweeps over noise, box plots, tables"),
    "fetch": ("rigkit.cli.fetch", "public captures with measured truth: list them, or fetch one"),
    "schema": ("rigkit.cli.schema", "JSON Schema of a file that rigkit reads or writes: for editors and programs"),
}
"""Verb -> (module, one-line help)."""


class _Version(argparse.Action):
    """Shows what is installed; the kernels are looked at only when asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        import platform

        from rigkit import __version__
        from rigkit.kernels import about

        print(f"rigkit {__version__}\nkernels {about()}")
        print(f"{platform.system()} {platform.machine()}, Python {platform.python_version()}")
        parser.exit()


class _VerbParser(argparse.ArgumentParser):
    """A verb's parser: of an argument that it does not know it shows its own usage, not that of all verbs."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown


def build_parser(verb: str | None) -> argparse.ArgumentParser:
    """Return the parser; only the module of `verb` is imported, all others show their one-line help."""
    parser = argparse.ArgumentParser(
        prog="rigkit",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Calibrate lab cameras, reconstruct oriented point clouds, validate them against measured truth.",
        epilog=FIRST_STEPS,
    )
    parser.add_argument("--version", action=_Version, help="show version, compiled kernels and platform, and exit")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True, parser_class=_VerbParser)
    for name, (module_name, summary) in VERBS.items():
        sub = verbs.add_parser(name, help=summary, description=summary)
        if name == verb:
            module = importlib.import_module(module_name)
            sub.formatter_class, sub.epilog = argparse.RawDescriptionHelpFormatter, f"examples:\n{EXAMPLES[name]}"
            sub.description = module.HELP
            module.add_arguments(sub)
            add_log_arguments(sub)
            sub.set_defaults(run=module.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    # The matrices here are small: threads inside BLAS only get in each other's way.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = list(sys.argv[1:] if argv is None else argv)
    verb = next((a for a in arguments if not a.startswith("-")), None)
    open_streams()
    try:
        with signals_interrupt():
            if not arguments:
                say("no verb given; this is what there is", before=build_parser(None).format_help())
                return ExitCode.BAD_INPUT
            args = build_parser(verb).parse_args(arguments)
            with logging_to(verbose=args.verbose, log_file=args.log_file):
                return logged_run(args)
    except RigkitError as error:
        say(f"{error}")
        return error.exit_code
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except KeyboardInterrupt as stop:
        number = stop.number if isinstance(stop, Terminated) else signal.SIGINT
        say("interrupted")
        return ExitCode.BY_SIGNAL + number
    except Exception as error:
        if isinstance(error, MemoryError) or (type(error).__module__ == "cv2" and "Insufficient memory" in str(error)):
            reason = printable(str(error)) or "out of memory"
            say(f"{reason}; use fewer processes (-j 1), smaller images, or a machine with more memory")
            return ExitCode.BAD_INPUT
        if isinstance(error, OSError) and error.errno in SURROUNDINGS:
            where = f"'{error.filename}': " if error.filename else ""
            say(printable(f"{where}{error.strerror}; {SURROUNDINGS[error.errno]}"))
            return ExitCode.BAD_INPUT
        say("this is a bug in rigkit; please report the lines above", before=traceback.format_exc())
        return ExitCode.BUG
    finally:
        settle_stderr()


if __name__ == "__main__":
    sys.exit(main())
