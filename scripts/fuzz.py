"""Fuzz rigkit: randomly damaged inputs must end in a result or in a clear error message of one line.

    python scripts/fuzz.py --count 2000 --seed 7 [--classes board,ply] [--seconds 30] [--memory-gb 4] [--keep DIR]

A finding is an exception other than RigkitError, exit code 70 or an undocumented one, a message that does not name the
file, a timeout, or a crash. The files of each finding are kept, and the command that reproduces it is printed. Cases
depend only on seed, class and number. Exit code: 1 if anything was found.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import multiprocessing
import os
import random
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import FrameType

sys.path.insert(0, str(Path(__file__).resolve().parent))

from fuzzing.kinds import KINDS, Kind
from fuzzing.messages import fault_of_message
from fuzzing.mutations import mutated, mutated_arguments
from fuzzing.seeds import write_seeds

DOCUMENTED = {0, 1, 2, 3}
"""Exit codes that a person may see; 70 says that rigkit has a bug."""
PATIENCE = 4.0
"""A process that does not answer for so many times the limit of a case is killed: it hangs where no signal comes in."""


POLL_S = 0.05
PROCESSES = multiprocessing.get_context("forkserver")
"""A process that is forked where OpenCV has threads would wait for those of its parent for ever."""
PROCESSES.set_forkserver_preload(["fuzz"])
DRAWN = {"api": "fuzzing.api", "requests": "fuzzing.requests"}
"""Classes without files, and the modules whose `run_case(seed, number)` draws and runs a case."""


class TooLong(BaseException):
    """The case is over its time; no handler of Exception may keep it."""


def linked(source: str, target: str) -> None:
    """Make `target` the same file as `source`, ten times faster than a copy: what is done to a case replaces files, and
    writes into none (`tests/fuzz/conftest.py` looks) but a history, which is continued."""
    if not source.endswith(".jsonl"):
        with contextlib.suppress(OSError):
            os.link(source, target)
            return
    shutil.copy2(source, target)


def case_of(kind: Kind, label: str, seed: int, number: int, seeds: Path, place: Path) -> list[str]:
    """Make the case in the new folder `place`: the good files and the changed one. Return its command or call.

    The first case of each reader is sound: nothing is changed.
    """
    rng = random.Random(f"{seed}/{label}/{number}")
    if label in DRAWN:
        return [f"{DRAWN[label]}:case_{seed}_{number}"]
    # Arguments that are drawn may name any file as one to write.
    shutil.copytree(seeds, place, copy_function=linked if kind.file else shutil.copy2)
    (place / "out").mkdir()
    sound = number < len(kind.readers)
    words = list(kind.readers[number] if sound else rng.choice(kind.readers))
    if kind.file is None:
        return words if sound else mutated_arguments(words, rng)
    case = f"case{Path(kind.file).suffix}"
    data = (seeds / kind.file).read_bytes()
    (place / case).write_bytes(data if sound else mutated(data, kind.file, rng))
    return [word.replace("{case}", case).replace("{out}", "out") for word in words]


def fault_of(words: Sequence[str], names_file: str | None, sound: bool) -> str | None:
    """Run the case in the present folder; return what is wrong with how it ended, None where nothing is.

    `names_file` has to be in the message of an error; a `sound` case has none.
    """
    from rigkit.cli.main import main
    from rigkit.core.errors import RigkitError

    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            if ":" in words[0] and words[0].partition(":")[0].replace(".", "").isidentifier():
                module, _, function = words[0].partition(":")
                if function.startswith("case_"):
                    importlib.import_module(module).run_case(*map(int, function.split("_")[1:]))
                    return None
                getattr(importlib.import_module(module), function)(*map(Path, words[1:]))
                return None
            code = main(list(words))
    except RigkitError as error:
        said = f"refused, though sound: {error}" if sound else None
        return said or fault_of_message(str(error), names_file, words)
    except SystemExit as stop:
        return None if stop.code in (0, 2) else f"SystemExit {stop.code}"
    except TooLong:
        return "takes too long"
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    lines = [line.strip() for line in err.getvalue().strip().splitlines()]
    if code not in DOCUMENTED or (sound and code):
        return f"exit {code}: " + " | ".join(lines[-5:])
    return fault_of_message(" | ".join(lines), names_file, words) if code in (2, 3) else None


def fault_of_case(kind: Kind, number: int, words: Sequence[str]) -> str | None:
    """Run the case of `case_of` in the present folder; return what is wrong with how it ended."""
    case = next((word for word in words if word.startswith("case.")), None) if kind.names_file else None
    return fault_of(words, case, sound=number < len(kind.readers) and not kind.judged)


def _command(label: str, words: Sequence[str], place: Path) -> str:
    """Return the shell line that shows a case again."""
    scripts = Path(__file__).resolve().parent
    head = f"cd {shlex.quote(str(place))} && " if place.is_dir() else ""
    if label in DRAWN:
        seed, number = words[0].split("_")[-2:]
        code = f"import {DRAWN[label]} as kind; kind.run_case({seed}, {number})"
        return f"cd {shlex.quote(str(scripts))} && python -c {shlex.quote(code)}"
    if ":" in words[0]:
        module, _, function = words[0].partition(":")
        code = f"from {module} import {function}; {function}({', '.join(map(repr, words[1:]))})"
        return f"{head}PYTHONPATH={shlex.quote(str(scripts))} python -c {shlex.quote(code)}"
    return f"{head}rigkit {shlex.join(words)}"


def run_cases(label: str, args: argparse.Namespace, start: int, seeds: Path, log: Path) -> None:
    """Run the cases from number `start` on in this process, noting each before it begins and each fault in `log`."""
    kind = KINDS[label]
    limit = int(args.memory_gb * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    quiet = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(quiet, stream)

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLong

    # Of the time that it computes: the machine may be busy. One that waits is killed by the parent.
    signal.signal(signal.SIGPROF, stop)
    with log.open("a", buffering=1) as notes:
        for number in range(start, args.count):
            place = args.keep / f"{label}-{args.seed}-{number}"
            shutil.rmtree(place, ignore_errors=True)
            words = case_of(kind, label, args.seed, number, seeds, place)
            notes.write(json.dumps({"number": number, "words": words, "mb": _most_mb()}) + "\n")
            os.chdir(place if place.is_dir() else args.keep)
            signal.setitimer(signal.ITIMER_PROF, args.seconds)
            try:
                fault = fault_of_case(kind, number, words)
            except TooLong:
                fault = "takes too long"
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            os.chdir(args.keep)
            if fault is None:
                shutil.rmtree(place, ignore_errors=True)
            else:
                notes.write(json.dumps({"number": number, "fault": fault, "words": words}) + "\n")
        notes.write(json.dumps({"number": args.count, "mb": _most_mb()}) + "\n")


def _most_mb() -> int:
    """Return the most memory that this process had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def run_class(label: str, args: argparse.Namespace, seeds: Path) -> tuple[list[tuple[int, str, str]], int]:
    """Return number, fault and command of the findings of a class, and the most memory in MB; a process that dies or
    hangs is a finding, and the rest goes on in a new one."""
    log = args.keep / f"{label}-{args.seed}.jsonl"
    log.unlink(missing_ok=True)
    log.touch()
    start = 0
    died: dict[int, str] = {}
    while start < args.count:
        child = PROCESSES.Process(target=run_cases, args=(label, args, start, seeds, log))
        child.start()
        reason = _wait(child, log, PATIENCE * args.seconds)
        if reason is None:
            break
        lines = [json.loads(line) for line in log.read_text().splitlines()]
        # A case that could not even be made is not noted: the next one follows all the same.
        last = max(lines[-1]["number"] if lines else start, start)
        died[last] = reason
        start = last + 1
    notes = list(map(json.loads, log.read_text().splitlines()))
    # One that ended before it noted anything, the case not made, is a finding, too: there is but the run to show again.
    again = f"python {shlex.quote(str(Path(__file__).resolve()))} --classes {label} --seed {args.seed} --count"
    findings = {number: (number, fault, f"{again} {number + 1}") for number, fault in died.items()}
    for note in notes:
        number = note["number"]
        fault = note.get("fault") or died.get(number)
        if fault:
            place = args.keep / f"{label}-{args.seed}-{number}"
            findings[number] = (number, fault, _command(label, note["words"], place))
    return sorted(findings.values()), max((note.get("mb", 0) for note in notes), default=0)


def _wait(child: ForkServerProcess, log: Path, patience: float) -> str | None:
    """Wait for the process; return how it died, None where it ended well. One that notes nothing is killed."""
    size, waited = -1, 0.0
    while True:
        child.join(POLL_S)
        code = child.exitcode
        if code is not None:
            return None if code == 0 else (f"killed by signal {-code}" if code < 0 else "the harness itself failed")
        # Counted by looks, not by the clock: a machine that was asleep is no process that hangs.
        size, waited = log.stat().st_size, waited + POLL_S if log.stat().st_size == size else 0.0
        if waited > patience:
            child.kill()
            child.join()
            return "hangs where no signal comes in"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the classes one after the other and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="cases of each class (default 200)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--classes", default=",".join(KINDS), help="with commas between; default: all")
    parser.add_argument("--seconds", type=float, default=30.0, help="limit of a case, of computing (default 30)")
    parser.add_argument("--memory-gb", type=float, default=4.0, help="limit of the process (default 4)")
    parser.add_argument("--keep", type=Path, help="folder for the files of findings (default: a new one in /tmp)")
    args = parser.parse_args(argv)
    labels = args.classes.split(",")
    if unknown := [label for label in labels if label not in KINDS]:
        parser.error(f"no class {', '.join(unknown)}; known: {', '.join(KINDS)}")
    args.keep = Path(tempfile.mkdtemp(prefix="fuzz-")) if args.keep is None else args.keep.absolute()
    args.keep.mkdir(parents=True, exist_ok=True)
    seeds = args.keep / "seeds"
    if not seeds.is_dir():
        write_seeds(seeds)
    total = 0
    for label in labels:
        begun = time.monotonic()
        findings, most_mb = run_class(label, args, seeds)
        total += len(findings)
        took, counts = time.monotonic() - begun, f"{args.count} cases, {len(findings)} findings"
        print(f"{label}: {counts}, {took:.0f} s, at most {most_mb} MB", flush=True)
        for number, fault, command in findings:
            print(f"  {label} {number}: {fault}\n    {command}", flush=True)
    print(f"{total} findings; seed {args.seed}; files in {args.keep}")
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
