"""Damaged inputs by the thousand: what rigkit reads, changed at random, must end in a result or in one clear line.

    python scripts/fuzz.py --count 2000 --seed 7 [--classes board,ply] [--seconds 30] [--memory-gb 4] [--keep DIR]

A finding is an exception that is no RigkitError, exit code 70 or one that is not documented, a message that does not
name the file, a case that takes too long, and a process that dies. The files of each finding are kept, and it is
printed with a command that shows it again. The cases depend on seed, class and number alone. Exit code: 1 if anything
was found.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

sys.path.insert(0, str(Path(__file__).resolve().parent))

import fuzz_api
import fuzz_seeds
from fuzz_mutations import mutated, mutated_arguments

DOCUMENTED = {0, 1, 2, 3}
"""Exit codes that a person may see; 70 says that rigkit has a bug."""
PATIENCE = 4.0
"""A process that does not answer for so many times the limit of a case is killed: it hangs where no signal comes in."""


class TooLong(BaseException):
    """The case is over its time; no handler of Exception may keep it."""


@dataclass(frozen=True)
class Kind:
    """A class of input: the file that is changed, and what reads it ("{case}", "{out}"); "module:function" is called.

    Without a file the words of the command, or the arguments of a call, are changed.
    """

    file: str | None
    readers: tuple[tuple[str, ...], ...]
    names_file: bool = True


def _camera_file(name: str, *more: tuple[str, ...]) -> Kind:
    return Kind(name, (("export", "{case}", "--to", "rigkit", "-o", "{out}/new.json"), *more))


def _board_file(name: str) -> Kind:
    return Kind(name, (("rigkit.io.board_file:load_board", "{case}"), ("board", "{case}", "-o", "{out}/b")))


KINDS: dict[str, Kind] = {
    "png": Kind("image.png", (("rigkit.io.images:read_image", "{case}"), ("detect", "-j", "1", "{case}"))),
    "png16": Kind("deep.png", (("rigkit.io.images:read_image", "{case}"),)),
    "jpg": Kind("image.jpg", (("rigkit.io.images:read_image", "{case}"), ("detect", "-j", "1", "{case}"))),
    "tif": Kind("image.tif", (("rigkit.io.images:read_image", "{case}"),)),
    "bmp": Kind("image.bmp", (("rigkit.io.images:read_image", "{case}"),)),
    "pgm": Kind("image.pgm", (("rigkit.io.images:read_image", "{case}"),)),
    "webp": Kind("image.webp", (("rigkit.io.images:read_image", "{case}"),)),
    "board": _board_file("board.toml"),
    "aprilgrid": _board_file("aprilgrid.toml"),
    "circles": _board_file("circles.toml"),
    "session": Kind("session.toml", (("rigkit.io.session:load_session", "{case}"),)),
    "rig-session": Kind("rig-session.toml", (("rigkit.io.rig_session:load_rig_session", "{case}"),)),
    "dataset": Kind("dataset.toml", (("rigkit.io.manifest:load_dataset", "{case}"),)),
    "study": Kind("study.toml", (("rigkit.io.study_file:load_study", "{case}"),)),
    "calibration": Kind(
        "calibration.json",
        (
            ("rigkit.io.calibration_file:load_calibration", "{case}"),
            ("diff", "{case}", "calibration.json"),
            ("plan", "{case}", "-n", "1"),
            ("certify", "{case}", "--length", "200", "--distance", "900"),
            ("export", "{case}", "--to", "opencv", "-o", "{out}/new.yaml"),
            ("rectify", "image.png", "--camera", "{case}", "-o", "{out}/new.png"),
        ),
    ),
    "rig": Kind(
        "rig.json",
        (
            ("rigkit.io.rig_file:load_saved_rig", "{case}"),
            ("diff", "{case}", "rig.json"),
            ("certify", "{case}", "--depth", "200", "--distance", "900"),
            ("export", "{case}", "--to", "kalibr", "-o", "{out}/new.yaml"),
            ("export", "{case}", "--to", "opencv", "-o", "{out}/new.yaml"),
            ("rectify", "image.png", "image.jpg", "--rig", "{case}", "-o", "{out}/new.png"),
        ),
    ),
    "board-rigs": Kind("board-rigs.json", (("rigkit.io.rig_file:load_board_rigs", "{case}"),)),
    "corners-json": Kind("corners.json", (("rigkit.io.corners_file:read_corners", "{case}"),)),
    "corners-csv": Kind("corners.csv", (("rigkit.io.corners_file:read_corners", "{case}"),)),
    "corners-vnl": Kind("corners.vnl", (("fuzz_api:read_vnl", "{case}"),)),
    "truth-csv": Kind("truth.csv", (("fuzz_api:read_truth", "{case}"),)),
    "pairs-csv": Kind("pairs.csv", (("rigkit.io.correspondences:read_correspondences", "{case}"),)),
    "pairs-npz": Kind("pairs.npz", (("rigkit.io.correspondences:read_correspondences", "{case}"),)),
    "ply": Kind("cloud.ply", (("rigkit.io.ply:read_ply", "{case}"),)),
    "opencv": _camera_file("opencv.yaml", ("export", "{case}", "--from", "opencv", "-o", "{out}/new.json")),
    "kalibr": _camera_file("kalibr.yaml", ("rigkit.workflows.camera_files:import_camera", "{case}")),
    "chain": Kind("chain.yaml", (("export", "{case}", "--to", "mrcal", "-o", "{out}/new.cameramodel"),)),
    "opencv-stereo": Kind("stereo.yaml", (("export", "{case}", "--to", "kalibr", "-o", "{out}/new.yaml"),)),
    "ros": _camera_file("ros.yaml", ("export", "{case}", "--from", "ros", "-o", "{out}/new.json")),
    "colmap": _camera_file("cameras.txt"),
    "mrcal": _camera_file("lens.cameramodel"),
    "mrcal-spline": _camera_file("spline.cameramodel"),
    "ocamcalib": _camera_file("calib_results.txt"),
    "py-ocamcalib": Kind("ocam.json", (("fuzz_api:read_py_ocam", "{case}"),)),
    "commands": Kind(None, fuzz_seeds.COMMANDS, names_file=False),
    "api": Kind(None, (), names_file=False),
}
"""Every class of input."""


def case_of(kind: Kind, label: str, seed: int, number: int, seeds: Path, place: Path) -> list[str]:
    """Make the case in the new folder `place`: the good files and the changed one. Return its command or call.

    The first case of each reader is sound: nothing is changed.
    """
    rng = random.Random(f"{seed}/{label}/{number}")
    if label == "api":
        return [f"fuzz_api:case_{seed}_{number}"]
    shutil.copytree(seeds, place)
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
                    fuzz_api.run_case(*map(int, function.split("_")[1:]))
                    return None
                getattr(importlib.import_module(module), function)(*map(Path, words[1:]))
                return None
            code = main(list(words))
    except RigkitError as error:
        return f"refused, though sound: {error}" if sound else _unnamed(str(error), names_file)
    except SystemExit as stop:
        return None if stop.code in (0, 2) else f"SystemExit {stop.code}"
    except TooLong:
        return "takes too long"
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    said = err.getvalue().strip()
    if code not in DOCUMENTED or (sound and code and names_file is not None):
        lines = said.splitlines()
        return f"exit {code}: " + " | ".join(line.strip() for line in lines[-5:])
    return _unnamed(said, names_file) if code in (2, 3) else None


def _unnamed(message: str, name: str | None) -> str | None:
    """Return a fault for a message that does not name the file."""
    if name is not None and name not in message:
        return f"message does not name the file: {message[:300]}"
    return None


def _command(label: str, words: Sequence[str], place: Path) -> str:
    """Return the shell line that shows a case again."""
    scripts = Path(__file__).resolve().parent
    head = f"cd {shlex.quote(str(place))} && " if place.is_dir() else ""
    if label == "api":
        seed, number = words[0].split("_")[-2:]
        return f"cd {shlex.quote(str(scripts))} && python -c 'import fuzz_api; fuzz_api.run_case({seed}, {number})'"
    if ":" in words[0]:
        module, _, function = words[0].partition(":")
        code = f"from {module} import {function}; {function}({', '.join(map(repr, words[1:]))})"
        return f"{head}PYTHONPATH={shlex.quote(str(scripts))} python -c {shlex.quote(code)}"
    return f"{head}rigkit {shlex.join(words)}"


def run_cases(kind: Kind, label: str, args: argparse.Namespace, start: int, seeds: Path, log: Path) -> None:
    """Run the cases from number `start` on in this process, noting each before it begins and each fault in `log`."""
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
            notes.write(json.dumps({"number": number, "words": words}) + "\n")
            os.chdir(place if place.is_dir() else args.keep)
            case = next((w for w in words if w.startswith("case.")), None) if kind.names_file else None
            signal.setitimer(signal.ITIMER_PROF, args.seconds)
            try:
                fault = fault_of(words, case, number < len(kind.readers))
            except TooLong:
                fault = "takes too long"
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            os.chdir(args.keep)
            if fault is None:
                shutil.rmtree(place, ignore_errors=True)
            else:
                notes.write(json.dumps({"number": number, "fault": fault, "words": words}) + "\n")


def run_class(label: str, args: argparse.Namespace, seeds: Path) -> list[tuple[int, str, str]]:
    """Return number, fault and command of the findings of a class; a process that dies or hangs is one, and the rest
    goes on in a new one."""
    log = args.keep / f"{label}-{args.seed}.jsonl"
    log.unlink(missing_ok=True)
    log.touch()
    start = 0
    died: dict[int, str] = {}
    while start < args.count:
        child = os.fork()
        if child == 0:
            code = 1
            try:
                run_cases(KINDS[label], label, args, start, seeds, log)
                code = 0
            except BaseException:
                (args.keep / f"{label}-harness.txt").write_text(traceback.format_exc())
            os._exit(code)
        reason = _wait(child, log, PATIENCE * args.seconds)
        if reason is None:
            break
        lines = [json.loads(line) for line in log.read_text().splitlines()]
        last = lines[-1]["number"] if lines else start
        died[last] = reason
        start = last + 1
    findings = {}
    for line in map(json.loads, log.read_text().splitlines()):
        number = line["number"]
        fault = line.get("fault") or died.get(number)
        if fault:
            place = args.keep / f"{label}-{args.seed}-{number}"
            findings[number] = (number, fault, _command(label, line["words"], place))
    return list(findings.values())


def _wait(child: int, log: Path, patience: float) -> str | None:
    """Wait for the process; return how it died, None where it ended well. One that notes nothing is killed."""
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            return None if code == 0 else (f"killed by signal {-code}" if code < 0 else "the harness itself failed")
        if time.time() - max(log.stat().st_mtime, log.stat().st_ctime) > patience:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return "hangs where no signal comes in"
        time.sleep(0.05)


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
        fuzz_seeds.write_seeds(seeds)
    total = 0
    for label in labels:
        begun = time.monotonic()
        findings = run_class(label, args, seeds)
        total += len(findings)
        print(f"{label}: {args.count} cases, {len(findings)} findings, {time.monotonic() - begun:.0f} s", flush=True)
        for number, fault, command in findings:
            print(f"  {label} {number}: {fault}\n    {command}", flush=True)
    print(f"{total} findings; seed {args.seed}; files in {args.keep}")
    return 1 if total else 0


if __name__ == "__main__":
    _run: Callable[[], int] = main
    sys.exit(_run())
