"""Run the tests of the kernels under AddressSanitizer and UBSan of gcc or clang.

    python scripts/sanitize.py [PYTEST_ARGUMENT...]        (default: tests/kernels; needs Linux and gcc)

The package is copied to a temporary folder and built there with -fsanitize=address,undefined. Python runs with the
sanitizer's runtime preloaded and allocates with malloc, so that numpy arrays are checked too. Any access outside of an
array, and any undefined behaviour, ends the run with a report. Exit code: that of pytest, or of the sanitizer.
"""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COMPILER = os.environ.get("CC", "gcc")
WATCHED = (
    *("-O1", "-g", "-fno-omit-frame-pointer"),
    "-fsanitize=address,undefined",
    # What is undefined ends the run instead of being told and forgotten.
    "-fno-sanitize-recover=all",
    # One copy of each function instead of one a processor: the compiler is slow enough here.
    "-Dtarget_clones(...)=unused",
)
"""In place of the optimisation: arithmetic, and what is exported, are as always."""
OPTIONS = {
    # Python itself leaves memory to the system at its end, and kernels without memory say so.
    "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:detect_stack_use_after_return=1:allocator_may_return_null=1",
    "UBSAN_OPTIONS": "print_stacktrace=1",
    "PYTHONMALLOC": "malloc",
}


def watched_package(folder: Path) -> Path:
    """Copy the package into `folder` and build its kernels there; return the library.

    Raises CalledProcessError where they do not compile.
    """
    package = folder / "rigkit"
    shutil.copytree(ROOT / "rigkit", package, ignore=shutil.ignore_patterns("__pycache__"))
    kernels = package / "kernels"
    building = runpy.run_path(str(kernels / "building.py"))
    library = kernels / building["library_name"]()
    library.unlink(missing_ok=True)
    flags = [flag for flag in building["FLAGS"] if flag not in ("-O3", "-g0")]
    sources = [str(path) for path in building["sources"](kernels)]
    subprocess.run([COMPILER, *flags, *WATCHED, "-fPIC", "-shared", *sources, "-lm", "-o", str(library)], check=True)
    building["write_record"](library, kernels, f"{COMPILER}, sanitized")
    return library


def runtimes() -> list[str]:
    """Return the runtimes of the sanitizers, to be loaded before Python."""
    found = []
    for name in ("libasan.so", "libubsan.so"):
        message = subprocess.run([COMPILER, f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        found.append(str(Path(message.stdout.strip()).resolve()))
    missing = [path for path in found if not Path(path).is_file()]
    if missing:
        raise SystemExit(f"{COMPILER} has no {' and no '.join(missing)}; install the sanitizers of this compiler")
    return found


def main(arguments: Sequence[str]) -> int:
    """Build, look that the watched library is the one that is loaded, and run pytest."""
    with tempfile.TemporaryDirectory(prefix="sanitize-") as name:
        folder = Path(name)
        library = watched_package(folder)
        surroundings = os.environ | OPTIONS
        surroundings |= {"PYTHONPATH": str(folder), "LD_PRELOAD": " ".join(runtimes())}
        # -P: the sources of the working folder stay out of the way.
        python = [sys.executable, "-P"]
        look = "import rigkit.kernels as k; k.kernels(); print(k.FOLDER / k.library_name())"
        loaded = subprocess.run([*python, "-c", look], cwd=ROOT, env=surroundings, capture_output=True, text=True)
        if loaded.stdout.strip() != str(library):
            raise SystemExit(f"the watched kernels are not loaded: {loaded.stdout}{loaded.stderr}")
        paths = [] if any(not word.startswith("-") for word in arguments) else ["tests/kernels"]
        command = [*python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *paths, *arguments]
        return subprocess.run(command, cwd=ROOT, env=surroundings).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
