"""The `rigkit` program: finds the verb, runs it, turns errors into one line and an exit code.

A verb is a module of its name in this package with `add_arguments(parser)` and `run(args) -> int`, and one line in
`VERBS`. Its docstring is the description and the examples of its help. Verb modules import nothing heavy at module
level: `rigkit --help` must answer at once.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from rigkit.cli.log import add_log_arguments, logged_run, logging_to
from rigkit.cli.operating_system import SYSTEM_ERRORS, Terminated, flush_stderr, open_streams, say, signals_interrupt
from rigkit.core.errors import ExitCode, InputError, RigkitError, interruption, printable

VERBS: dict[str, str] = {
    "demo": "render a small capture and run every step on it",
    "board": "print a calibration target, or identify the one that images show",
    "calibrate": "calibrate a camera, or a rig, from images of boards",
    "rectify": "undistort, reproject to a panorama, or rectify a stereo pair",
    "export": "convert cameras, rigs and clouds to and from other formats",
    "plan": "suggest the next images to take, and what they will gain",
    "coach": "guide a capture live, on a local web page",
    "diff": "compare two calibrations or rigs within their uncertainties",
    "check": "test a calibration with new images: it holds, or what changed",
    "history": "plot checks over months as drift with control limits",
    "certify": "bound the error of a length, depth, plane or angle",
    "init": "start a data set manifest, or a session, from a folder",
    "validate": "validate reconstructions against measured ground truth",
    "reconstruct": "reconstruct oriented point clouds, of boards or any scene",
    "mesh": "mesh an oriented point cloud",
    "crosscheck": "compare pairs with COLMAP and other independent methods",
    "pose": "pose of a camera relative to one board",
    "handeye": "hand-eye calibration: pose of a camera on a robot",
    "detect": "detect the corners of all boards in images",
    "simulate": "run a synthetic study: noise sweeps, box plots, tables",
    "fetch": "download public captures with measured ground truth",
    "schema": "list the keys of every file format, as JSON Schema or a table",
}
"""Verb -> summary."""

EXAMPLES = "\n\nexamples:\n"
"""Separates them from the description in the docstring of a verb."""

ALLOCATIONS_BETWEEN_COLLECTIONS = 10_000
"""Python's own number, 700, has the collector visit everything imported once or twice a command, 70 ms each time."""

FIRST_STEPS = """first steps:
  rigkit board 9x6 --square-mm 25 -o board           print a board, glue it to something flat
  rigkit calibrate photos --board 9x6x25 -r          calibrate from a dozen images of it, with a report
  rigkit rectify photos --camera photos/calibration.json -o straight
  rigkit demo                                        every step once, on rendered images
  rigkit VERB --help                                 options and examples of a verb

Exit codes: 0 success; 1 a check failed; 2 bad input; 3 degenerate geometry; 70 a bug in rigkit.
"""


class _Version(argparse.Action):
    """Prints the version and the kernels, which are only imported for that."""

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
    """Parser of a verb: one line for bad arguments, with the option that an unknown one is similar to."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            options = [one for one in self._option_string_actions if one.startswith("--")]
            meant = next(filter(None, (_similar(one.partition("=")[0], options) for one in unknown)), "")
            self.error(f"unrecognized arguments: {' '.join(unknown)}{meant}")
        return known, unknown

    def error(self, message: str) -> NoReturn:
        say(f"{self.prog.partition(' ')[2]}: {message}; see {self.prog} --help")
        self.exit(ExitCode.BAD_INPUT)


def _similar(word: str, known: Iterable[str]) -> str:
    """Return a question for the one of the `known` words that is similar; "" if there is none."""
    from difflib import get_close_matches

    close = get_close_matches(word, list(known), 1)
    return f"; did you mean {close[0]}?" if close else ""


def build_parser(verb: str | None) -> argparse.ArgumentParser:
    """Return the parser with the arguments of `verb`, whose module alone is imported; else with all verbs' names."""
    listed = "\n".join(f"  {name:<12} {summary}" for name, summary in VERBS.items())
    parser = argparse.ArgumentParser(
        prog="rigkit",
        usage="rigkit [-h] [--version] VERB ...",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Calibrate cameras and rigs, reconstruct oriented point clouds, validate both against ground "
        "truth.",
        epilog=f"verbs:\n{listed}\n\n{FIRST_STEPS}",
    )
    parser.add_argument("--version", action=_Version, help="show version, compiled kernels and platform, and exit")
    verbs = parser.add_subparsers(
        dest="verb", metavar="VERB", prog="rigkit", required=True, parser_class=_VerbParser, help=argparse.SUPPRESS
    )
    if verb is None:
        return parser
    sub = verbs.add_parser(verb)
    module = importlib.import_module(f"rigkit.cli.{verb}")
    sub.description, _, examples = (module.__doc__ or VERBS[verb]).partition(": ")[2].partition(EXAMPLES)
    sub.formatter_class, sub.epilog = argparse.RawDescriptionHelpFormatter, f"{EXAMPLES.strip()}\n{examples}"
    module.add_arguments(sub)
    add_log_arguments(sub)
    sub.set_defaults(run=module.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    # The matrices are small: threads inside BLAS slow the program down.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # The objects of a command seldom form cycles, and passes of the collector take up to a twentieth of its time.
    gc.set_threshold(ALLOCATIONS_BETWEEN_COLLECTIONS)
    arguments = list(sys.argv[1:] if argv is None else argv)
    verb = next((a for a in arguments if not a.startswith("-")), None)
    open_streams()
    try:
        with signals_interrupt():
            if not arguments:
                say("no verb given; choose one of the list above", before=build_parser(None).format_help())
                return ExitCode.BAD_INPUT
            # As a path it would be the current folder.
            if any(not one or (one.startswith("--") and one.endswith("=")) for one in arguments):
                raise InputError("an argument is empty (''), perhaps an unset shell variable; give a value")
            if verb is not None and verb not in VERBS:
                raise InputError(f"no verb is called '{verb}'{_similar(verb, VERBS) or '; rigkit --help lists them'}")
            args = build_parser(verb).parse_args(arguments)
            with logging_to(verbose=args.verbose, log_file=args.log_file):
                return logged_run(args)
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except (Exception, KeyboardInterrupt) as error:
        if (stop := interruption(error)) is not None:
            say("interrupted")
            return ExitCode.BY_SIGNAL + (stop.number if isinstance(stop, Terminated) else signal.SIGINT)
        if isinstance(error, RigkitError):
            say(f"{error}")
            return error.exit_code
        if isinstance(error, MemoryError) or (type(error).__module__ == "cv2" and "Insufficient memory" in str(error)):
            reason = printable(str(error)) or "out of memory"
            say(f"{reason}; use fewer processes (-j 1), smaller images, or a machine with more memory")
            return ExitCode.BAD_INPUT
        if isinstance(error, OSError) and error.errno in SYSTEM_ERRORS:
            where = f"'{error.filename}': " if error.filename else ""
            say(printable(f"{where}{error.strerror}; {SYSTEM_ERRORS[error.errno]}"))
            return ExitCode.BAD_INPUT
        say("this is a bug in rigkit; please report the lines above", before=traceback.format_exc())
        return ExitCode.BUG
    finally:
        flush_stderr()


if __name__ == "__main__":
    sys.exit(main())
