"""Common functions of the verbs: progress on stderr, results on stdout, options from arguments."""

from __future__ import annotations

import json
import logging
import re
import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

from rigkit.core.errors import InputError, printable
from rigkit.core.progress import Progress

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Iterable
    from pathlib import Path

    from rigkit.core.arrays import FloatArray
    from rigkit.geometry.rigid3 import Rigid3
    from rigkit.report.pages.page_facts import PageFacts

Options = TypeVar("Options")
REDRAW_S = 0.1
BAR_WIDTH = 24
IMAGE_SIZE = re.compile(r"([0-9]{1,6})[xX]([0-9]{1,6})")


def progress_on_stderr() -> Progress:
    """Return a progress callback: a bar on a terminal, elsewhere one line for each finished stage."""
    started: dict[str, float] = {}
    drawn = 0.0

    def show(what: str, done: int, total: int) -> None:
        nonlocal drawn
        now = time.monotonic()
        started.setdefault(what, now)
        finished = done >= total
        # A closed or full stderr must not stop the work.
        with suppress(OSError, ValueError):
            if sys.stderr.isatty():
                if finished or now - drawn >= REDRAW_S:
                    drawn = now
                    filled = BAR_WIDTH * done // max(total, 1)
                    bar = "#" * filled + "." * (BAR_WIDTH - filled)
                    end = f" {now - started[what]:.1f} s\n" if finished else ""
                    print(f"\r{what:<36.36} [{bar}] {done}/{total}{end}", end="", file=sys.stderr, flush=True)
            elif finished:
                print(f"{what}: {done} done in {now - started[what]:.1f} s", file=sys.stderr, flush=True)
        if finished:
            started.pop(what, None)

    return show


def note(text: str) -> None:
    """Log a message for the user, which goes to stderr."""
    logging.getLogger("rigkit.cli").info("%s", printable(text))


def note_written(paths: Iterable[Path]) -> None:
    """Log the written files."""
    for path in paths:
        note(f"{path} written")


def options_of(kind: type[Options], args: Namespace, /, **others: Any) -> Options:
    """Return a workflow's options from `others` and from the arguments with the names of its other fields."""
    from dataclasses import fields

    own = {f.name for f in fields(kind) if f.name not in others}  # type: ignore[arg-type]
    given = {name: tuple(v) if isinstance(v, list) else v for name, v in vars(args).items() if name in own}
    return kind(**given, **others)


def print_statement(facts: PageFacts) -> None:
    """Print headline and sentences of a page."""
    print("\n  ".join([facts.headline, *facts.sentences]))


def pose_in_words(name: str, pose: Rigid3, turn_sigma_rad: FloatArray, move_sigma_mm: FloatArray) -> str:
    """Return a pose in words: rotation vector (deg) and translation (mm) with standard deviations."""
    import numpy as np

    from rigkit.geometry.rotation import log_so3
    from rigkit.report.tables import rounded_words

    degrees = zip(np.degrees(log_so3(pose.rotation)), np.degrees(turn_sigma_rad), strict=True)
    turned = ", ".join(rounded_words(float(value), float(sigma)) for value, sigma in degrees)
    shifts = zip(pose.translation_mm, move_sigma_mm, strict=True)
    moved = ", ".join(rounded_words(float(value), float(sigma)) for value, sigma in shifts)
    return f"{name}: rotation vector ({turned}) deg, translation ({moved}) mm"


def print_json(value: Any) -> None:
    """Print a result as JSON."""
    print(json.dumps(value, indent=1, allow_nan=False))


def size_of_words(text: str) -> tuple[int, int]:
    """Return (width, height) of "1280x960"; raises InputError for anything else."""
    match = IMAGE_SIZE.fullmatch(text)
    if match is None:
        raise InputError(f"--size {text}: give width and height in px, such as 1280x960")
    return int(match[1]), int(match[2])
