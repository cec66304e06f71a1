"""Small numeric arrays of MATLAB's MAT-files of version 5 (save -v6 and -v7), as assignments of a script.

SciPy's reader is not used, because it crashes on damaged files. Reference: MathWorks, "MAT-File Format", 2024: elements
of a tag (type, bytes) and data, padded to eight bytes; matrices hold elements; compressed elements hold matrices.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError

HEADER_BYTES = 128
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
MATRIX_TYPE, COMPRESSED = 14, 15
CELL, STRUCT, OBJECT, NUMERIC, OPAQUE = 1, 2, 3, range(6, 16), 17
MAX_NUMBERS = 100
"""Size of an array: those of cameras are smaller; corners and covariances are skipped."""
MAX_STRUCTURES = 6
"""Nesting of structures: the toolbox's cameras have three levels."""
MAX_INFLATED = 64_000_000
"""Bytes of a decompressed variable."""
OBJECTS = "% MATLAB objects:"
"""Start of the lines for objects, which only MATLAB reads."""


def assignments_of(data: bytes, name: str) -> str:
    """Return `a.b = [ 1 2 ; 3 4 ];` for every small array; raises InputError with the file if it is damaged."""
    try:
        order = {b"IM": "<", b"MI": ">"}[data[126:128]]
        lines = [line for kind, body in _elements(data[HEADER_BYTES:], order) for line in _variable(kind, body, order)]
    except (KeyError, ValueError, IndexError, OverflowError, struct.error, zlib.error, StopIteration) as error:
        raise InputError(f"'{name}': not readable as a .mat file; is the file whole?") from error
    return "\n".join(["% MATLAB", *lines]) + "\n"


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 8 <= len(data):
        first, size = struct.unpack_from(f"{order}II", data, at)
        if first >> 16:  # a small element has its data in the tag
            size, first, start, after = first >> 16, first & 0xFFFF, at + 4, at + 8
        else:
            start = at + 8
            after = start + size + (0 if first == COMPRESSED else -size % 8)
        if start + size > len(data) or (start == at + 4 and size > 4):
            raise ValueError("cut")
        yield first, data[start : start + size]
        at = after


def _variable(kind: int, body: bytes, order: str) -> list[str]:
    if kind == COMPRESSED:
        inflated = zlib.decompressobj().decompress(body, MAX_INFLATED)
        return [
            line for k, inner in _elements(inflated, order) if k == MATRIX_TYPE for line in _matrix(inner, order, "", 0)
        ]
    return _matrix(body, order, "", 0) if kind == MATRIX_TYPE else []


def _matrix(body: bytes, order: str, of: str, depth: int) -> list[str]:
    """Return the lines of an array, or of the fields of a structure; `of` is its name in an outer structure."""
    if not body or depth > MAX_STRUCTURES:
        return []
    parts = _elements(body, order)
    flags = struct.unpack_from(f"{order}I", next(parts)[1])[0] & 0xFF
    if flags == OPAQUE:
        return [f"{OBJECTS} {of or _word(next(parts)[1])}"]
    shape = np.frombuffer(next(parts)[1], f"{order}i4")
    own = next(parts)[1]
    if not of and not own:  # internal data of objects and functions
        return []
    key = of or _word(own)
    count = int(np.prod(shape.astype(np.float64)))
    if flags == OBJECT:
        return [f"{OBJECTS} {key}"]
    if flags == STRUCT and count == 1:
        length = int(np.frombuffer(next(parts)[1], f"{order}i4")[0])
        names = next(parts)[1]
        fields = [_word(names[k : k + length]) for k in range(0, len(names), max(length, 1))]
        return [line for field in fields for line in _matrix(next(parts)[1], order, f"{key}.{field}", depth + 1)]
    if flags not in NUMERIC or not 0 < count <= MAX_NUMBERS or shape.size != 2:
        return []
    stored, raw = next(parts)
    flat: FloatArray = np.frombuffer(raw, f"{order}{NUMBERS[stored]}").astype(np.float64)
    values = flat.reshape(tuple(shape[::-1].tolist())).T
    rows = " ; ".join(" ".join(repr(float(value)) for value in row) for row in values)
    return [f"{key} = [ {rows} ];"]


def _word(raw: bytes) -> str:
    """Return a name; raises ValueError for an invalid one."""
    word = raw.split(b"\0")[0].decode("ascii", "replace")
    if not word.isidentifier():
        raise ValueError("no name")
    return word
