"""Compiled kernels for the loops that numpy is slow at. Without them everything works, slower.

They are plain C called through ctypes, one library a C file, built when the package is installed (setup.py) if the
machine has a C compiler. Every kernel repeats one function of the package that is written in numpy, gives the same
result to rounding (tests compare them), and is called by that function alone.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib.util
import os
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

__all__ = ["address", "kernels"]

SWITCH = "RIGKIT_NATIVE"
"""Environment variable: 0 leaves the kernels unused."""


@functools.cache
def kernels(name: str) -> ctypes.CDLL | None:
    """Return the library built from NAME.c: None where there is none, NAME.c has changed or gone, or `SWITCH` is 0."""
    if os.environ.get(SWITCH) == "0":
        return None
    found = importlib.util.find_spec(f"rigkit.kernels._{name}")
    if found is None or found.origin is None:
        return None
    try:
        library = ctypes.CDLL(found.origin)
        library.rigkit_source.restype = ctypes.c_char_p
        built_from = library.rigkit_source().decode()
        folder = Path(__file__).parent
        source = (folder / f"{name}.c").read_bytes() + (folder / "kernels.h").read_bytes()
    except (OSError, AttributeError):
        return None
    return library if built_from == hashlib.sha256(source).hexdigest()[:16] else None


def address(array: NDArray[Any]) -> int:
    """Return the address of the first value of a contiguous `array`, which must outlive its use.

    `array.ctypes.data` takes four times as long, and a detection needs two hundred addresses.
    """
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        # Read-only, or empty.
        return int(array.ctypes.data)
