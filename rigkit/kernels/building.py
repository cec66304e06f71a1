"""Compilation of the kernels, and the record of the sources that a library was built from.

It uses the standard library only: setup.py and scripts/cross_compile.py run this file before rigkit is installed.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

FLAGS = (
    *("-O3", "-std=c11", "-g0", "-fvisibility=hidden", "-Wall", "-Wno-unknown-pragmas"),
    # The kernels do not read errno or the flags of floating-point exceptions.
    *("-fno-math-errno", "-fno-trapping-math"),
    # Multiplications and additions are fused if the processor can; the defaults of compilers differ.
    *("-ffp-contract=fast", "-fopenmp-simd"),
)
"""For gcc and clang. No -ffast-math: missing corners are NaN."""


def library_name(platform: str = sys.platform) -> str:
    """Return the library's file name, the same for every version of Python."""
    suffixes = {"win32": "rigkit_kernels.dll", "darwin": "librigkit_kernels.dylib"}
    return suffixes.get(platform, "librigkit_kernels.so")


def sources(folder: Path) -> list[Path]:
    """Return the C files of `folder`."""
    return sorted(folder.glob("[!.]*.c"))


def source_hash(folder: Path) -> str:
    """Return a hash of the C files and headers of `folder` and of FLAGS."""
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    # Hidden files are those of editors, and may be broken links.
    for path in sorted([*sources(folder), *folder.glob("[!.]*.h")]):
        # Independent of the line ends of the system.
        digest.update(path.name.encode() + b"\0" + path.read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()[:16]


def remove_import_library(library: Path) -> None:
    """Remove what the linker for Windows leaves beside `library`: it is loaded by name, and never linked."""
    for path in library.parent.glob("*.lib"):
        path.unlink()


def write_record(library: Path, folder: Path, compiler: str) -> Path:
    """Write the hashes of `library` and of its sources in `folder` to a file with its name; return the path."""
    record = {"sources": source_hash(folder), "library": _hash_of(library), "compiler": compiler}
    path = library.with_suffix(".json")
    path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return path


def mismatch(library: Path) -> str | None:
    """Return what is wrong with `library`; None if it is intact and built from the sources in its folder."""
    if not library.is_file():
        return "are missing"
    try:
        record = json.loads(library.with_suffix(".json").read_text(encoding="utf-8"))
        built_from, whole = record["sources"], record["library"]
    except (OSError, ValueError, KeyError, TypeError):
        return "have no record of what they were built from"
    if whole != _hash_of(library):
        return "are damaged: the library is not the one that was built"
    if built_from != source_hash(library.parent):
        return "are stale: the C files changed after they were built"
    return None


def _hash_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
