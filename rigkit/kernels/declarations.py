"""Parser of api.h and the headers it includes, from which the calls of `rigkit.kernels` and their checks are made.

They are written in a subset of C (described there) that a few regular expressions can parse.
"""

from __future__ import annotations

import ctypes
import functools
import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

SCALARS: dict[str, type[ctypes.c_int64] | type[ctypes.c_double] | type[ctypes.c_float]] = {
    "int64_t": ctypes.c_int64,
    "double": ctypes.c_double,
    "float": ctypes.c_float,
}

DTYPES: dict[str, np.dtype[np.generic] | None] = {
    "truth_t": np.dtype(np.bool_),
    "uint8_t": np.dtype(np.uint8),
    "uint16_t": np.dtype(np.uint16),
    "int32_t": np.dtype(np.int32),
    "int64_t": np.dtype(np.int64),
    "float": np.dtype(np.float32),
    "double": np.dtype(np.float64),
    "void": None,
}
"""NumPy types of C types; `void` is that of an image, of bytes or float32."""

IMAGE = r"ARRAY(const void, \1, height, width), int64_t bytes, int64_t width, int64_t height"
"""Expansion of the macro of that name."""


class Role(StrEnum):
    """The role of an array: given by the caller, or allocated by the call as a result or as scratch memory."""

    GIVEN = "ARRAY"
    RESULT = "RESULT"
    SCRATCH = "SCRATCH"


@dataclass(frozen=True, slots=True)
class Array:
    """An array passed by its address: its type (None for an image), its sizes as expressions of other parameters, and
    whether it is read-only."""

    dtype: np.dtype[np.generic] | None
    sizes: tuple[str, ...]
    read_only: bool = False
    role: Role = Role.GIVEN

    @property
    def shape(self) -> str:
        """The sizes as a tuple in Python."""
        return f"({', '.join(self.sizes)},)"


@dataclass(frozen=True, slots=True)
class Declaration:
    """A member of a structure or a parameter of a function.

    Attributes
    ----------
    type : name of a scalar or of a structure, "char" for text.
    array : its properties if it is an array.
    pointer : whether it is the address of a value or structure.
    length : number of values of a member that is a C array, else None.
    """

    name: str
    type: str
    array: Array | None = None
    pointer: bool = False
    length: int | None = None


@dataclass(frozen=True, slots=True)
class Header:
    """All of api.h: constants, members of structures, parameters and results of functions."""

    constants: dict[str, int]
    structures: dict[str, list[Declaration]]
    functions: dict[str, list[Declaration]]
    results: dict[str, Declaration]


@functools.cache
def header() -> Header:
    """Return the declarations of api.h and its parts; raises ValueError if they are not in the subset of C."""
    folder = Path(__file__).parent
    text = (folder / "api.h").read_text(encoding="utf-8")
    parts = re.findall(r'^#include "(\w+\.h)"', text, flags=re.MULTILINE)
    return parsed("\n".join([text, *((folder / part).read_text(encoding="utf-8") for part in parts)]))


def parsed(text: str) -> Header:
    """Return the declarations of the header `text`."""
    text = re.sub(r"/\*.*?\*/", " ", text, flags=re.DOTALL)
    text = re.sub(r"^\s*#.*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"\bIMAGE\((\w+)\)", IMAGE, text)
    constants: dict[str, int] = {}
    for body in re.findall(r"\benum\s*\{(.*?)\}\s*;", text, flags=re.DOTALL):
        for entry in _split(body):
            name, value = (part.strip() for part in entry.split("=", 1))
            constants[name] = int(eval(_python(value), {"__builtins__": {}}, constants))
    structures = {}
    for body, name in re.findall(r"\btypedef\s+struct\s*\{(.*?)\}\s*(\w+)\s*;", text, flags=re.DOTALL):
        structures[name] = [member for line in body.split(";") if line.strip() for member in _declared(line, constants)]
    functions, results = {}, {}
    for result, name, body in re.findall(r"\bEXPORT\s+([\w\s*]*?)(\w+)\((.*?)\)\s*;", text, flags=re.DOTALL):
        parameters = [] if body.strip() == "void" else _split(body)
        functions[name] = [_declared(part, constants)[0] for part in parameters]
        results[name] = _declared(f"{result} {name}", constants)[0]
    if text.count("EXPORT") != len(functions):
        raise ValueError("api.h: a function is not declared in the way that can be read")
    return Header(constants, structures, functions, results)


def _split(text: str) -> list[str]:
    """Return the parts of `text` between commas that are not in brackets."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts if part.strip()]


def _python(expression: str) -> str:
    """Return C arithmetic on sizes, which are not negative, in Python."""
    return expression.replace("/", "//")


def _declared(text: str, constants: dict[str, int]) -> list[Declaration]:
    """Return the members or parameters of one declaration, which may have several names."""
    text = " ".join(text.split())
    if found := re.fullmatch(r"(ARRAY|RESULT|SCRATCH)\((const )?(\w+), (\w+), (.*)\)", text):
        role, const, kind, name, sizes = found.groups()
        array = Array(DTYPES[kind], tuple(_split(_python(sizes))), const is not None, Role(role))
        return [Declaration(name, kind, array)]
    found = re.fullmatch(r"(?:const )?(\w+) (.*)", text)
    if found is None:
        raise ValueError(f"api.h: cannot read {text!r}")
    kind, names = found.groups()
    out = []
    for name in _split(names):
        parts = re.fullmatch(r"(\*?)\s*(\w+)(?:\[(\w+)\])?", name)
        if parts is None:
            raise ValueError(f"api.h: cannot read {text!r}")
        star, plain, length = parts.groups()
        many = None if length is None else int(constants.get(length, length))
        out.append(Declaration(plain, kind, None, star == "*", many))
    return out
