"""Measure how far each constant of rigkit's detection can be changed before boards are lost or false ones found.

    python scripts/measure_constants.py [MODULE ...] [--data DIR] [--jobs 2] > MARGINS
    python scripts/measure_constants.py --page MARGINS ...

Each number among the constants of `rigkit.detection` (or of the MODULEs given, such as checks.border), and each number
in a tuple, is multiplied and divided by FACTORS, one at a time, in all modules that import it. The images are those of
`detection_bench.constant_looks`, rendered and real, with boards and without. A constant is tried only on the images in
which a line that reads it runs: on at most MOST with and MOST without boards, the quick ones if those are MANY.

Prints for each constant, on both sides, the first factor that has an effect, and the effect: corners lost (more than
MAX_LOST_SHARE of them), false boards found, corners moved (more than MAX_MOVED of their sigmas, rms), or sigmas changed
(more than MAX_SIGMA_CHANGE, rms of the logarithm). "-" if there is none at the largest factor; "same" if not even a
digit of any result changes then: in these images the constant decides nothing. "not read" are constants that no
function reads when called, such as defaults of arguments. The whole takes some 20 minutes of one core.
`--page` enters what was printed in docs/pages/detection-constants.md, in place of older rows.
"""

from __future__ import annotations

import argparse
import datetime
import dis
import importlib
import multiprocessing
import os
import pkgutil
import re
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from detection_bench.constant_looks import DATA, Found, Look, every_look
from detection_bench.constants_page import PAGE, page

import rigkit.detection
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import RigkitError

FACTORS = (1.25, 2.0, 4.0)
MAX_LOST_SHARE, MAX_MOVED, MAX_SIGMA_CHANGE = 0.01, 0.3, 0.1
MANY, AT_ONCE, MOST, GOLDEN = 12, 8, 12, 0.618034
NO_EFFECT = ("same", "-")

Line = tuple[str, int]
"""A file and a line."""


def constants_of(module: ModuleType) -> list[str]:
    """Return the names of the numbers among a module's own constants, those in tuples as NAME[k]."""
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    names = []
    for left in re.findall(r"^((?:_?[A-Z][A-Z0-9_]*(?:, )?)+)\s*(?::[^=\n]+)?=", source, re.MULTILINE):
        for name in left.split(", "):
            value = vars(module).get(name)
            if _number(value):
                names.append(name)
            elif isinstance(value, tuple) and all(map(_number, value)):
                names += [f"{name}[{k}]" for k in range(len(value))]
    return names


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def value_of(module: ModuleType, constant: str) -> float:
    """Return the number of a name of `constants_of`."""
    name, _, k = constant.rstrip("]").partition("[")
    value = vars(module)[name]
    return value[int(k)] if k else value


@contextmanager
def changed(module: ModuleType, constant: str, factor: float) -> Iterator[bool]:
    """Multiply a constant in its module and all that import it; yields whether that is another number."""
    name, _, k = constant.rstrip("]").partition("[")
    value, number = vars(module)[name], value_of(module, constant)
    new: Any = number * factor if isinstance(number, float) else round(number * factor)
    differs = bool(new != number)
    if k:
        new = (*value[: int(k)], new, *value[int(k) + 1 :])
    users = users_of(module, name)
    for user in users:
        setattr(user, name, new)
    forget()
    try:
        yield differs
    finally:
        for user in users:
            setattr(user, name, value)
        forget()


def users_of(module: ModuleType, name: str) -> list[ModuleType]:
    """Return the modules of rigkit that have a module's constant."""
    value = vars(module)[name]
    alike = [one for key, one in sys.modules.items() if key.startswith("rigkit.") and vars(one).get(name) is value]
    # Another module may have an own constant of the same name and integer.
    return [one for one in alike if one is module or name not in {own.partition("[")[0] for own in constants_of(one)}]


def forget() -> None:
    """Clear the caches of functions of rigkit.detection, whose results may contain constants."""
    for key, module in list(sys.modules.items()):
        if key.startswith("rigkit.detection."):
            for value in vars(module).values():
                if hasattr(value, "cache_clear"):
                    value.cache_clear()


def readers_of(module: ModuleType, constant: str) -> set[Line]:
    """Return the lines in which functions read a constant when they are called."""
    name = constant.partition("[")[0]
    return {line for user in users_of(module, name) for line in _reads(user).get(name, ())}


READS: dict[str, dict[str, set[Line]]] = {}


def _reads(module: ModuleType) -> dict[str, set[Line]]:
    """Return the lines in which the functions of a module read each global name."""
    file = str(module.__file__)
    if file not in READS:
        out: dict[str, set[Line]] = {}
        parts = [compile(Path(file).read_text(encoding="utf-8"), file, "exec")]
        while parts:
            part = parts.pop()
            parts += [code for code in part.co_consts if isinstance(code, CodeType)]
            # Bodies of modules and classes run once, at the import.
            if part.co_flags & 1:
                for step in dis.get_instructions(part):
                    if step.opname == "LOAD_GLOBAL" and step.positions and step.positions.lineno:
                        out.setdefault(str(step.argval), set()).add((file, step.positions.lineno))
        READS[file] = out
    return READS[file]


def lines_of(look: Look, lines: set[Line]) -> tuple[Found, set[Line]]:
    """Return what a look finds, and which of some lines run."""
    by_file: dict[str, set[int]] = {}
    for file, line in lines:
        by_file.setdefault(file, set()).add(line)
    run: set[Line] = set()

    def enter(frame: FrameType, event: str, _: object) -> Any:
        code = frame.f_code
        left = by_file.get(code.co_filename)
        if not left:
            return None
        left = left & {line for _, _, line in code.co_lines() if line}

        def step(frame: FrameType, event: str, _: object) -> Any:
            if event == "line" and frame.f_lineno in left:
                run.add((code.co_filename, frame.f_lineno))
                by_file[code.co_filename].discard(frame.f_lineno)
            return step

        return step if left else None

    forget()
    threading.settrace(enter)
    sys.settrace(enter)
    try:
        return look.found(), run
    finally:
        sys.settrace(None)
        threading.settrace(None)


def effect(usual: Sequence[Found], now: Sequence[Found], corners: int) -> str:
    """Return what another value of a constant does, of `corners` in all images: "same", "-", or the loss in words."""
    lost = sum(len(one.corners.keys() - other.corners.keys()) for one, other in zip(usual, now, strict=True))
    false = sum(max(other.false - one.false, 0) for one, other in zip(usual, now, strict=True))
    off, ratio = _moves(usual, now)
    words = [f"{lost} corners lost"] if lost > MAX_LOST_SHARE * corners else []
    words += [f"{false} false boards"] if false else []
    words += [f"corners move by {off:.2g} sigmas"] if off > MAX_MOVED else []
    words += [f"sigmas change by {ratio:.0%}"] if ratio > MAX_SIGMA_CHANGE else []
    if not words:
        alike = all(a.corners == b.corners and a.false == b.false for a, b in zip(usual, now, strict=True))
        return "same" if alike else "-"
    return " and ".join(words)


def _moves(usual: Sequence[Found], now: Sequence[Found]) -> tuple[float, float]:
    """Return how far corners that are found both times move, in sigmas, and the change of log sigma; rms."""
    both = [
        (a.corners[key], b.corners[key])
        for a, b in zip(usual, now, strict=True)
        for key in a.corners
        if key in b.corners
    ]
    if not both:
        return 0.0, 0.0
    first, second = (np.array([pair[k] for pair in both]) for k in (0, 1))
    moves: FloatArray = np.linalg.norm(second[:, :2] - first[:, :2], axis=1) / first[:, 2]
    change = np.log(second[:, 2] / first[:, 2])
    return float(np.sqrt(np.mean(moves**2) / 2.0)), float(np.sqrt(np.mean(change**2)))


def margin(
    module: ModuleType,
    constant: str,
    looks: Sequence[Look],
    usual: Sequence[Found],
    factors: Sequence[float],
    corners: int,
) -> str:
    """Return the first factor that has an effect on `looks`, and the effect.

    The last one is tried first, on the first AT_ONCE looks, and on further ones until it has an effect. Smaller ones
    are tried on the looks that it changed.
    """
    order = list(range(len(looks)))
    last, order = _with(module, constant, looks, usual, order, factors[-1], corners)
    if last in NO_EFFECT:
        return last
    for factor in factors[:-1]:
        words, _ = _with(module, constant, looks, usual, order, factor, corners)
        if words not in NO_EFFECT:
            return f"{factor:.3g}: {words}"
    return f"{factors[-1]:.3g}: {last}"


def _with(
    module: ModuleType,
    constant: str,
    looks: Sequence[Look],
    usual: Sequence[Found],
    order: Sequence[int],
    factor: float,
    corners: int,
) -> tuple[str, list[int]]:
    """Return the effect on the first AT_ONCE looks in `order`, or on more until there is one, and which changed."""
    now: dict[int, Found] = {}
    words = "same"
    with changed(module, constant, factor) as differs:
        while differs and len(now) < len(order) and words in NO_EFFECT:
            for k in order[len(now) : len(now) + AT_ONCE]:
                try:
                    now[k] = looks[k].found()
                except (
                    RigkitError,
                    ArithmeticError,
                    ValueError,
                    IndexError,
                    AssertionError,
                    np.linalg.LinAlgError,
                ) as e:
                    return type(e).__name__, [*now, k]
            words = effect([usual[k] for k in now], list(now.values()), corners)
    return words, [k for k, one in now.items() if one != usual[k]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of real captures")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--page", type=Path, nargs="+", metavar="MARGINS", help="enter rows in the page")
    args = parser.parse_args()
    if args.page:
        files = [file for file in (PAGE, *args.page) if file.exists()]
        printed = "".join(file.read_text(encoding="utf-8") for file in files)
        date = str(datetime.datetime.now(datetime.UTC).date())
        PAGE.write_text(page(printed, every_constant(), date), encoding="utf-8")
        return
    measure(list(every_look(args.data)), args.modules, args.jobs)


def every_module() -> list[str]:
    """Import all modules of rigkit.detection and return their names."""
    package = rigkit.detection
    every = [info.name for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}.") if not info.ispkg]
    for path in every:
        importlib.import_module(path)
    return every


def every_constant() -> list[tuple[str, str]]:
    """Return module, without rigkit.detection, and name of each constant."""
    return [
        (path.removeprefix("rigkit.detection."), name)
        for path in every_module()
        for name in constants_of(sys.modules[path])
    ]


def measure(looks: Sequence[Look], modules: Sequence[str], jobs: int = 1) -> None:
    """Print the rows of some modules, or of all."""
    every = every_module()
    of = [f"rigkit.detection.{name}" for name in modules] or every
    constants = [(sys.modules[path], name) for path in of for name in constants_of(sys.modules[path])]
    lines = {line for module, name in constants for line in readers_of(module, name)}
    measured = [(look, *lines_of(look, lines)) for look in looks]
    for kind in ("REAL", "RENDERED"):
        own = [usual for look, usual, _ in measured if look.name.startswith(kind)]
        found, false = sum(len(one.corners) for one in own), sum(one.false for one in own)
        print(f"{kind}: {len(own)} images, {found} corners, {false} false boards", flush=True)
    MEASURED.extend(measured)
    with ThreadPoolExecutor(jobs) as pool:
        for row in pool.map(_row_of_own_process, [(module.__name__, name) for module, name in constants]):
            print(row, flush=True)


MEASURED: list[tuple[Look, Found, set[Line]]] = []
"""The looks, what they find, and the lines that they run."""


def _row_of_own_process(constant: tuple[str, str]) -> str:
    """Return the row of a constant. A number such as the degree of a surface, for which a kernel has memory up to the
    largest that it knows, may end the process."""
    # A forked process has what was measured.
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=lambda: sender.send(_row(constant)))
    process.start()
    sender.close()
    try:
        return str(receiver.recv())
    except EOFError:
        path, name = constant
        shown = f"{path.removeprefix('rigkit.detection.')}.{name}"
        return f"| {shown} | {value_of(sys.modules[path], name):g} | 0 | {' | '.join(['no other value'] * 2)} |"
    finally:
        process.join()


def _row(constant: tuple[str, str]) -> str:
    """Return the row of a constant (module and name)."""
    path, name = constant
    module = sys.modules[path]
    readers = readers_of(module, name)
    used = [(look, usual) for look, usual, run in MEASURED if run & readers]
    quick = [(look, usual) for look, usual in used if look.quick]
    if sum(look.shown for look, _ in quick) >= MANY:
        used = quick
    # In an order in which the first are of all kinds.
    used = [used[k] for k in np.argsort(np.arange(len(used)) * GOLDEN % 1.0)]
    used = [pair for shown in (True, False) for pair in [pair for pair in used if pair[0].shown == shown][:MOST]]
    sides = ["not called" if readers else "not read"] * 2
    if used:
        looks, found = [look for look, _ in used], [usual for _, usual in used]
        corners = sum(len(usual.corners) for usual in found)
        sides = [
            margin(module, name, looks, found, factors, corners)
            for factors in ([1.0 / factor for factor in FACTORS], FACTORS)
        ]
    shown = f"{path.removeprefix('rigkit.detection.')}.{name}"
    return f"| {shown} | {value_of(module, name):g} | {len(used)} | {' | '.join(sides)} |"


if __name__ == "__main__":
    main()
