"""Compile the kernels for every system that wheels are made for, on this one: pip install ziglang, then

    python scripts/cross_compile.py [-o FOLDER] [TARGET...]

Each library is written to FOLDER/TARGET (out/kernels) with the record that rigkit checks before it loads it.
"""

from __future__ import annotations

import argparse
import runpy
import subprocess
import sys
from pathlib import Path

KERNELS = Path(__file__).resolve().parents[1] / "rigkit" / "kernels"

TARGETS = {
    # As old a libc as manylinux_2_28 promises.
    "linux-x86_64": ("x86_64-linux-gnu.2.28", "linux"),
    "linux-aarch64": ("aarch64-linux-gnu.2.28", "linux"),
    "macos-x86_64": ("x86_64-macos.11.0", "darwin"),
    "macos-arm64": ("aarch64-macos.11.0", "darwin"),
    "windows-x86_64": ("x86_64-windows-gnu", "win32"),
}
"""Our name -> the compiler's name, and Python's for the system."""


def cross_compile(target: str, folder: Path) -> Path:
    """Compile the kernels for one of TARGETS; return the library. Raises CalledProcessError where that fails."""
    building = runpy.run_path(str(KERNELS / "building.py"))
    triple, platform = TARGETS[target]
    library = folder / target / building["library_name"](platform)
    library.parent.mkdir(parents=True, exist_ok=True)
    zig = [sys.executable, "-m", "ziglang", "cc", "-target", triple, "-fno-sanitize=undefined"]
    sources = [str(path) for path in building["sources"](KERNELS)]
    # The linker of macOS's format strips by itself, and knows no -s.
    strip = [] if platform == "darwin" else ["-s"]
    subprocess.run(
        [*zig, *building["FLAGS"], *strip, "-fPIC", "-shared", *sources, "-lm", "-o", str(library)], check=True
    )
    building["remove_import_library"](library)
    building["write_record"](library, KERNELS, f"ziglang {triple}")
    return library


def main() -> int:
    parser = argparse.ArgumentParser(description="Compile the kernels for other systems.")
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)} (all)")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/kernels"), metavar="FOLDER")
    arguments = parser.parse_args()
    unknown = set(arguments.targets) - set(TARGETS)
    if unknown:
        parser.error(f"no such target: {', '.join(sorted(unknown))}")
    for target in arguments.targets or TARGETS:
        library = cross_compile(target, arguments.output)
        print(f"{target}: {library}, {library.stat().st_size // 1024} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
