"""Calls of the kernels with their arguments checked: type, shape and C-contiguity of every array, as api.h says."""

from __future__ import annotations

import ctypes
from types import CodeType
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from rigkit.kernels.declarations import SCALARS, Declaration, header

STRUCTURES: dict[str, type[Struct]] = {}
"""By their names in api.h; a structure stands there before those that it is part of."""

NAMES_IN_SIZES: dict[str, Any] = {"__builtins__": {}, **header().constants}
"""What sizes of arrays may be made of, beside other arguments: the constants, and the kernels once they are loaded."""

AnyStruct = TypeVar("AnyStruct", bound="Struct")


def address(array: NDArray[Any]) -> int:
    """Return the address of the first value of a C-contiguous `array`, which must outlive its use.

    Raises ValueError for another order in memory. `array.ctypes.data` takes four times as long, and a detection needs
    two hundred addresses.
    """
    try:
        # This refuses what is not contiguous.
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        # Read-only, or empty, or another order.
        if not array.flags.c_contiguous:
            raise ValueError("not C-contiguous") from None
        return int(array.ctypes.data)


class _Checks:
    """The arrays among the parameters of a function or the members of a structure, and what they must be."""

    def __init__(self, owner: str, declarations: list[Declaration]) -> None:
        self.owner = owner
        self.arrays = [
            (place, one.name, one.array.dtype) for place, one in enumerate(declarations) if one.array is not None
        ]
        shapes = "".join(f"{one.array.shape}," for one in declarations if one.array is not None)
        self.shapes: CodeType = compile(f"({shapes})", "api.h", "eval")

    def addresses(self, values: dict[str, Any]) -> list[tuple[int, int]]:
        """Return place and address of each of the arrays in `values`; raises TypeError where one is not as declared."""
        out = []
        for (place, name, dtype), shape in zip(self.arrays, eval(self.shapes, NAMES_IN_SIZES, values), strict=True):
            array = values[name]
            # Bytes and truth values lie alike in memory.
            if array.shape != shape or (array.dtype != dtype and dtype is not None and not _alike(array.dtype, dtype)):
                raise TypeError(
                    f"{self.owner}: '{name}' is {array.dtype} {array.shape}, wants {dtype or 'any type'} {shape}"
                )
            try:
                out.append((place, address(array)))
            except ValueError as error:
                raise TypeError(f"{self.owner}: '{name}' is {error}") from None
        return out


def _alike(given: np.dtype[Any], wanted: np.dtype[Any]) -> bool:
    return given == np.bool_ and wanted == np.uint8


class Struct(ctypes.Structure):
    """A structure of api.h, its members filled in by `structure`; one without arrays is made like any of ctypes."""

    _checks: _Checks
    _pointed: frozenset[str]
    _kept: dict[str, Any]

    @classmethod
    def of(cls, **values: Any) -> Self:
        """Return the structure with all its members, given by name; it keeps alive what it points to.

        Raises TypeError where a member is missing or an array is not as api.h says.
        """
        names = [field[0] for field in cls._fields_]
        if set(names) != values.keys():
            raise TypeError(f"{cls.__name__}: wants {', '.join(names)}; was given {', '.join(values)}")
        members = [ctypes.pointer(values[name]) if name in cls._pointed else values[name] for name in names]
        for place, at in cls._checks.addresses(values):
            members[place] = at
        out = cls(*members)
        out._kept = values
        return out


def structure(name: str) -> Any:
    """Return a decorator that makes a class the structure `name` of api.h."""

    def fill(cls: type[AnyStruct]) -> type[AnyStruct]:
        members = header().structures[name]
        cls._checks = _Checks(name, members)
        cls._pointed = frozenset(one.name for one in members if one.pointer and one.type in STRUCTURES)
        cls._fields_ = [(one.name, _ctype(one)) for one in members]
        STRUCTURES[name] = cls
        return cls

    return fill


def _ctype(one: Declaration) -> Any:
    """Return the type of ctypes for a member, parameter or result."""
    if one.array is not None or (one.pointer and one.type in SCALARS) or one.type in ("int32_t", "uint8_t"):
        return ctypes.c_void_p
    if one.type == "char":
        return ctypes.c_char_p
    kind = SCALARS.get(one.type) or STRUCTURES[one.type]
    if one.pointer:
        return ctypes.POINTER(kind)
    return kind if one.length is None else kind * one.length


class Kernel:
    """A function of the library, called with the arguments of its declaration in api.h: arrays, numbers, structures."""

    def __init__(self, name: str, library: ctypes.CDLL) -> None:
        self.name = name
        self._function = getattr(library, name)
        self._names = tuple(one.name for one in header().functions[name])
        self._checks: _Checks | None = None

    def _declare(self) -> _Checks:
        """Declare the arguments, at the first call: by then the caller has declared the structures among them."""
        parameters, result = header().functions[self.name], header().results[self.name]
        self._function.argtypes = [_ctype(one) for one in parameters]
        self._function.restype = None if result.type == "void" else _ctype(result)
        self._checks = _Checks(self.name, parameters)
        return self._checks

    def __call__(self, *arguments: Any) -> Any:
        """Call it; raises TypeError where an argument is missing or an array is not as declared."""
        if len(arguments) != len(self._names):
            raise TypeError(f"{self.name}: wants {', '.join(self._names)}; was given {len(arguments)}")
        checks, given = self._checks or self._declare(), list(arguments)
        for place, at in checks.addresses(dict(zip(self._names, arguments, strict=True))):
            given[place] = at
        return self._function(*given)
