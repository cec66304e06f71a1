"""Calls of the kernels with their arguments checked: type, shape and C-contiguity of every array, as api.h says.

A detection makes sixty calls, some of functions that take ten microseconds: so the checks of each are compiled once,
into one expression. What that refuses is looked at again, array by array: what a kernel only reads is copied into the
type and order that api.h says, and of all else is said what is wrong.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import GreyImage
from rigkit.kernels.declarations import SCALARS, Declaration, header

STRUCTURES: dict[str, type[Struct]] = {}
"""By their names in api.h; a structure stands there before those that it is part of."""

NAMES_IN_SIZES: dict[str, Any] = dict(header().constants)
"""What sizes of arrays may be made of, beside other arguments: the constants, and the kernels once they are loaded."""

FIRST_BYTE: Callable[[Any], ctypes.c_char] = ctypes.c_char.from_buffer
"""Raises TypeError or ValueError for what is not contiguous, or read-only, or empty."""
EMPTY = ctypes.c_double()
"""What is passed for an empty array, which has no first value."""


AnyStruct = TypeVar("AnyStruct", bound="Struct")


def image_arguments(image: GreyImage) -> tuple[GreyImage, bool, int, int]:
    """Return an image as kernels take it: its pixels, whether they are bytes, width and height."""
    grey = np.ascontiguousarray(image, None if image.dtype == np.uint8 else np.float32)
    return grey, grey.dtype == np.uint8, grey.shape[1], grey.shape[0]


def address(array: NDArray[Any]) -> int:
    """Return the address of the first value of a C-contiguous `array`, which must outlive its use.

    Raises ValueError for another order in memory. `array.ctypes.data` takes four times as long, and a detection needs
    two hundred addresses.
    """
    try:
        return ctypes.addressof(FIRST_BYTE(array))
    except (TypeError, ValueError):
        if not array.flags.c_contiguous:
            raise ValueError("not C-contiguous") from None
        return int(array.ctypes.data)


class _Checks:
    """The arrays among the parameters of a function or the members of a structure, and what they must be."""

    def __init__(self, owner: str, declarations: list[Declaration], pointed: frozenset[str] = frozenset()) -> None:
        self.owner = owner
        self.names = tuple(one.name for one in declarations)
        self._pointed = pointed
        self._arrays = {one.name: one.array for one in declarations if one.array is not None}

    def calling(self, target: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of the parameters, in their order, that calls `target` with addresses for the arrays.

        It raises TypeError where one is not as declared. What sizes are made of must be loaded.
        """
        tests = [f"{name}.shape == {array.shape}" for name, array in self._arrays.items()]
        # A type is one object, but for those of another order of bytes.
        tests += [_is_of(name, array.dtype) for name, array in self._arrays.items() if array.dtype is not None]
        passed = [self._passed(name, "_addressof(_from_buffer({0})) if {0}.size else _empty") for name in self.names]
        ready = [f"{name} = _ready('{name}', {name}, {array.shape})" for name, array in self._arrays.items()]
        checked = [self._passed(name, "_address({0})") for name in self.names]
        # A structure keeps alive what it points to; a function is done with it when it returns.
        keep = f"_made._ready = ({''.join(f'{name}, ' for name in self._arrays)})" if isinstance(target, type) else ""
        code = f"""
def call({", ".join(self.names)}):
    if {" and ".join(tests) or "True"}:
        try:
            return _target({", ".join(passed)})
        except (TypeError, ValueError, BufferError):
            pass
    {"; ".join(ready) or "pass"}
    _made = _target({", ".join(checked)})
    {keep}
    return _made
"""
        scope: dict[str, Any] = dict(NAMES_IN_SIZES)
        scope |= {f"_{array.dtype}": array.dtype for array in self._arrays.values()}
        scope |= {"_bool": np.dtype(np.bool_), "_pointer": ctypes.pointer, "_target": target, "_ready": self._ready}
        scope |= {"_addressof": ctypes.addressof, "_from_buffer": FIRST_BYTE, "_address": address}
        scope |= {"_empty": ctypes.addressof(EMPTY)}
        exec(compile(code, f"api.h: {self.owner}", "exec"), scope)
        return cast("Callable[..., Any]", scope["call"])

    def _passed(self, name: str, of_array: str) -> str:
        """Return the expression for what is passed for a parameter: `of_array` with its name where it is one."""
        if name in self._arrays:
            return of_array.format(name)
        return f"_pointer({name})" if name in self._pointed else name

    def _ready(self, name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """Return an array, or a copy as declared of one that is only read; raises TypeError where it is not as declared
        and a copy would not do."""
        declared = self._arrays[name]
        dtype = array.dtype if declared.dtype is None else declared.dtype
        same = array.dtype == dtype or (dtype == np.uint8 and array.dtype == np.bool_)
        if array.shape != shape or not (same or (declared.read_only and np.can_cast(array.dtype, dtype, "safe"))):
            raise TypeError(f"{self.owner}: '{name}' is {array.dtype} {array.shape}, wants {dtype} {shape}")
        if declared.read_only:
            return np.ascontiguousarray(array, array.dtype if same else dtype)
        if not array.flags.c_contiguous:
            raise TypeError(f"{self.owner}: '{name}' is not C-contiguous")
        return array


def _is_of(name: str, dtype: np.dtype[Any]) -> str:
    """Return the test of an array's type; bytes and truth values lie alike in memory."""
    test = f"{name}.dtype is _{dtype}"
    return f"({test} or {name}.dtype is _bool)" if dtype == np.uint8 else test


class Struct(ctypes.Structure):
    """A structure of api.h, its members filled in by `structure`; one without arrays is made like any of ctypes."""

    _checks: _Checks
    _names: frozenset[str]
    _make: Callable[..., Self] | None
    _kept: dict[str, Any]

    @classmethod
    def of(cls, **values: Any) -> Self:
        """Return the structure with all its members, given by name; it keeps alive what it points to.

        Raises TypeError where a member is missing or an array is not as api.h says.
        """
        names = cls._checks.names
        if values.keys() != cls._names:
            raise TypeError(f"{cls.__name__}: wants {', '.join(names)}; was given {', '.join(values)}")
        if cls._make is None:
            cls._make = staticmethod(cls._checks.calling(cls))
        out = cls._make(**values)
        out._kept = values
        return out


def structure(name: str) -> Any:
    """Return a decorator that makes a class the structure `name` of api.h."""

    def fill(cls: type[AnyStruct]) -> type[AnyStruct]:
        members = header().structures[name]
        pointed = frozenset(one.name for one in members if one.pointer and one.type in STRUCTURES)
        cls._checks = _Checks(name, members, pointed)
        cls._names, cls._make = frozenset(cls._checks.names), None
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
        self._checks = _Checks(name, header().functions[name])
        self._call: Callable[..., Any] | None = None

    def _declare(self) -> Callable[..., Any]:
        """Declare the arguments, at the first call: by then the caller has declared the structures among them."""
        parameters, result = header().functions[self.name], header().results[self.name]
        self._function.argtypes = [_ctype(one) for one in parameters]
        self._function.restype = None if result.type == "void" else _ctype(result)
        self._call = self._checks.calling(self._function)
        return self._call

    def __call__(self, *arguments: Any) -> Any:
        """Call it; raises TypeError where an argument is missing or an array is not as declared."""
        if len(arguments) != len(self._checks.names):
            raise TypeError(f"{self.name}: wants {', '.join(self._checks.names)}; was given {len(arguments)}")
        return (self._call or self._declare())(*arguments)
