"""The compiled kernels: loops that are slow in numpy, in plain C, as one library called through ctypes.

api.h declares the functions once for both sides; `calls` checks every argument against it. The library is part of the
package and is built when that is installed (setup.py); without it, detection and relative pose raise InstallationError.
Reference implementations in numpy are in tests/kernels/reference.
"""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from rigkit.core.errors import InstallationError
from rigkit.kernels.building import library_name, mismatch, source_hash

FOLDER = Path(__file__).parent
Library = TypeVar("Library")


class Kernels:
    """The functions of api.h, each a `calls.Kernel`, by their names."""

    def __init__(self, path: Path) -> None:
        from rigkit.kernels.calls import NAMES_IN_SIZES, Kernel
        from rigkit.kernels.declarations import header

        library = ctypes.CDLL(str(path))
        for name in header().functions:
            setattr(self, name, Kernel(name, library))
        NAMES_IN_SIZES.update(vars(self))

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"api.h declares no function '{name}'")


@functools.cache
def kernels() -> Kernels:
    """Return the kernels; raises InstallationError if they are missing, damaged or built from other sources."""
    return _loaded(Kernels)


def _loaded(load: Callable[[Path], Library]) -> Library:
    """Return the library as loaded by `load`; raises InstallationError as `kernels`."""
    path = FOLDER / library_name()
    wrong = mismatch(path)
    if wrong is not None:
        raise InstallationError(f"the compiled kernels {wrong} ({path}); {_remedy()}")
    try:
        return load(path)
    except OSError as error:
        raise InstallationError(f"the compiled kernels do not load ({error}); {_remedy()}") from error


def about() -> str:
    """Return the hash of the kernels' sources and their instruction set, for `rigkit --version`."""
    try:
        # Not through `Kernels`, which imports numpy.
        instruction_set = _loaded(lambda path: ctypes.CDLL(str(path))).instruction_set
    except InstallationError as error:
        return str(error)
    instruction_set.restype = ctypes.c_char_p
    return f"{source_hash(FOLDER)}, {instruction_set().decode()}"


def _remedy() -> str:
    """Return how to install the kernels."""
    checkout = FOLDER.parents[1]
    if (checkout / "setup.py").is_file():
        install = f"'{sys.executable}' -m pip install --no-deps -e '{checkout}'"
        return f"with a C compiler (gcc or clang) installed type: {install}"
    return f"type: '{sys.executable}' -m pip install --no-deps --force-reinstall rigkit"
