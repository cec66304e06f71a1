"""Common functions of the verbs: notes on stderr, results on stdout, arguments of options and options from them."""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
from dataclasses import MISSING, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from rigkit.cli.progress import progress_on_stderr as progress_on_stderr
from rigkit.core.errors import IN_PYTHON, ExitCode, InputError, printable
from rigkit.io.disk.schema_builders import attributes_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from rigkit.core.arrays import FloatArray
    from rigkit.geometry.rigid3 import Rigid3
    from rigkit.report.pages.page_facts import PageFacts

Options = TypeVar("Options")
FILE = re.compile(r"[A-Z]+\.\w+")
"""A placeholder of a file: CORNERS.csv."""
IMAGE_SIZE = re.compile(r"([0-9]{1,6})[xX]([0-9]{1,6})")


def note(text: str) -> None:
    """Log a message for the user, which goes to stderr."""
    logging.getLogger("rigkit.cli").info("%s", printable(text.replace(IN_PYTHON, "")))


def note_left_out(reasons: Collection[object]) -> ExitCode:
    """Log why images, or the like, are left out; return the exit code, that of bad input if any are."""
    for reason in reasons:
        note(f"left out: {reason}")
    return ExitCode.BAD_INPUT if reasons else ExitCode.WELL


def note_written(paths: Iterable[Path]) -> None:
    """Log the written files."""
    for path in paths:
        note(f"{path} written")


def add_options(parser: argparse._ActionsContainer, kind: type, /, **spelled: str) -> None:
    """Add arguments for fields of a workflow's options, which `options_of` reads.

    Type, choices and default are those of the field, the help is its description in the docstring. `spelled` has the
    flags (--name if there is no long one) and the placeholders of values: output="-o FILE", before="IMAGE...",
    report="-r [check.html]". With the dots a list takes several values at once, without them the argument is repeated;
    in brackets stands the name of the page without a value.
    """
    defaults = {field.name: field.default for field in fields(kind)}
    types, words = get_type_hints(kind), attributes_of(kind)
    for name, spelling in spelled.items():
        flags = [word for word in spelling.split() if word.startswith("-")]
        places = [word for word in spelling.split() if word not in flags]
        if not any(flag.startswith("--") for flag in flags):
            flags.append(f"--{name.replace('_', '-')}")
        given = _argument_of(types[name], defaults[name], places)
        # python -OO removes docstrings.
        text = words.get(name, "").rstrip(".")
        if given.get("action") == "append":
            text += " (repeatable)"
        elif given.get("default") not in (None, []) and "default" not in text:
            text += f" (default: {given['default']})"
        parser.add_argument(*flags, dest=name, help=text.replace("%", "%%"), **given)


def _argument_of(own: Any, default: Any, places: list[str]) -> dict[str, Any]:
    """Return type, number of values, choices and default of the argument for a field of type `own`, with placeholders
    of values."""
    if get_origin(own) in (Union, UnionType):
        own = next(one for one in get_args(own) if one is not NoneType)
    if own is bool:
        return {"action": argparse.BooleanOptionalAction if default is None else "store_true"}
    out: dict[str, Any] = {"default": default} if default is not MISSING else {"required": True}
    if places and places[0].startswith("["):
        name = places[0].strip("[]")
        return out | {"metavar": name, "nargs": "?", "const": Path(name), "type": page_path}
    if places:
        out["metavar"] = tuple(places) if len(places) > 1 else places[0].removesuffix("...")
        own = file_path if own is Path and FILE.fullmatch(places[0]) else own
    if get_origin(own) is tuple:
        own, *others = get_args(own)
        if others != [...]:
            out["nargs"] = 1 + len(others)
        else:
            out |= {"default": [], **({"nargs": "+"} if places[0].endswith("...") else {"action": "append"})}
    return out | ({"choices": get_args(own)} if get_origin(own) is Literal else {"type": own})


def file_path(text: str) -> Path:
    """Return the path of a file; raises ArgumentTypeError, to which argparse adds the option, for one of a folder."""
    if text.endswith(("/", os.sep)):
        raise argparse.ArgumentTypeError(f"'{text}' names a folder; give a file in it")
    return Path(text)


def page_path(text: str) -> Path:
    """Return the path of a page; raises InputError for a folder of images that was written behind -r."""
    path = file_path(text)
    if path.is_dir():
        raise InputError(f"cannot write the page to '{text}', a folder of that name exists; give -r last")
    return path


def require_existing(*paths: str | Path | None, remedy: str = "check the path") -> None:
    """Raise InputError if there is nothing at a path; called before the work is imported, which takes a second.

    None, live cameras (camera:0) and numbered sequences (%04d.png) pass."""
    for path in paths:
        if path is None or any(mark in str(path) for mark in ("camera:", "%")):
            continue
        try:
            os.lstat(path)
        except FileNotFoundError as error:
            raise InputError(f"'{path}' does not exist; {remedy}") from error
        except (OSError, ValueError):
            pass  # its reader says what is wrong


def options_of(kind: type[Options], args: argparse.Namespace, /, **others: Any) -> Options:
    """Return a workflow's options from `others` and from the arguments with the names of its other fields."""
    own = {field.name for field in fields(kind) if field.name not in others}  # type: ignore[arg-type]
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
