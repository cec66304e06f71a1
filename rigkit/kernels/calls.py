"""Calls of the kernels as api.h declares them: sizes are read from arrays, results and scratch are made, and of every
array type, shape and C-contiguity are checked.

A detection makes sixty calls, some of functions that take ten microseconds: so each call is compiled once, with its
checks as one expression. What that refuses is looked at again, array by array: what a kernel only reads is copied into
the type and order that api.h says, and of all else is said what is wrong.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NoReturn, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import GreyImage
from rigkit.kernels.declarations import SCALARS, Declaration, Role, header

STRUCTURES: dict[str, type[Struct]] = {}
"""By their names in api.h; a structure stands there before those that it is part of."""

NAMES_IN_SIZES: dict[str, Any] = dict(header().constants)
"""What sizes of arrays may be made of, beside other arguments: the constants, and the kernels once they are loaded."""

FIRST_BYTE: Callable[[Any], ctypes.c_char] = ctypes.c_char.from_buffer
"""Raises TypeError or ValueError for what is not contiguous, or read-only, or empty."""
EMPTY = ctypes.c_double()
"""What is passed for an empty array, which has no first value."""


AnyStruct = TypeVar("AnyStruct", bound="Struct")


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


class _Call:
    """How a function is called, or a structure made, from what Python gives: the parameters `names`.

    The others follow from these: sizes of the arrays given, whether an image is of bytes, results and scratch.
    """

    def __init__(self, owner: str, declarations: list[Declaration], pointed: frozenset[str] = frozenset()) -> None:
        self.owner = owner
        self._all = tuple(one.name for one in declarations)
        self._pointed = pointed
        self._arrays = {one.name: one.array for one in declarations if one.array is not None}
        self._given = {name: array for name, array in self._arrays.items() if array.role is Role.GIVEN}
        self._made = {name: array for name, array in self._arrays.items() if array.role is not Role.GIVEN}
        numbers = {one.name for one in declarations if one.type == "int64_t" and one.array is None}
        # The first array that has a number as a size tells it; the checks then hold the others against it.
        self._sizes: dict[str, str] = {}
        for name, array in self._given.items():
            for axis, size in enumerate(array.sizes):
                if size in numbers:
                    self._sizes.setdefault(size, f"{name}.shape[{axis}]")
            if array.dtype is None:
                self._sizes["bytes"] = f"{name}.dtype == _uint8"
        self.names = tuple(name for name in self._all if name not in self._sizes and name not in self._made)

    def compiled(self, target: Callable[..., Any], *, returns: bool = False) -> Callable[..., Any]:
        """Return a function of the parameters `names`, in their order, that calls `target` with addresses for arrays.

        It returns the results, alone or as a tuple, after what `target` returns where it `returns` something, and
        raises TypeError where an array is not as declared. What sizes are made of must be loaded.
        """
        images = [f"{name} = _image({name})" for name, array in self._given.items() if array.dtype is None]
        sizes = [f"{size} = {where}" for size, where in self._sizes.items()]
        tests = [f"{name}.shape == {array.shape}" for name, array in self._given.items()]
        # A type is one object, but for those of another order of bytes.
        tests += [_is_of(name, array.dtype) for name, array in self._given.items() if array.dtype is not None]
        ready = [f"{name} = _ready('{name}', {name}, {array.shape})" for name, array in self._given.items()]
        made = [f"{name} = _new({array.shape}, _{array.dtype})" for name, array in self._made.items()]
        passed = [self._passed(name, "_addressof(_from_buffer({0})) if {0}.size else _empty") for name in self._all]
        checked = [self._passed(name, "_address({0})") for name in self._all]
        results = [name for name, array in self._made.items() if array.role is Role.RESULT]
        out = ", ".join([*(["_returned"] if returns or not results else []), *results])
        # A structure keeps alive what it points to; a function is done with it when it returns.
        keep = ", ".join(f"'{name}': {name}" for name in self._all) if isinstance(target, type) else None
        code = f"""
def call({", ".join(self.names)}):
    {"; ".join(images) or "pass"}
    try:
        {"; ".join(sizes) or "pass"}
    except IndexError:
        _refuse_axes({", ".join(self._given)})
    if not ({" and ".join(tests) or "True"}):
        {"; ".join(ready) or "pass"}
    {"; ".join(made) or "pass"}
    try:
        _returned = _target({", ".join(passed)})
    except (TypeError, ValueError, BufferError):
        {"; ".join(ready) or "pass"}
        _returned = _target({", ".join(checked)})
    {"pass" if keep is None else f"_returned._kept = {{{keep}}}"}
    return {out}
"""
        scope: dict[str, Any] = dict(NAMES_IN_SIZES)
        scope |= {f"_{array.dtype}": array.dtype for array in self._arrays.values()}
        scope |= {"_bool": np.dtype(np.bool_), "_uint8": np.dtype(np.uint8), "_pointer": ctypes.pointer}
        scope |= {"_image": self._image, "_refuse_axes": self._refuse_axes, "_ready": self._ready, "_new": self._new}
        scope |= {"_addressof": ctypes.addressof, "_from_buffer": FIRST_BYTE, "_address": address}
        scope |= {"_empty": ctypes.addressof(EMPTY), "_target": target}
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

    def _refuse_axes(self, *arrays: NDArray[Any]) -> NoReturn:
        """Raise TypeError for the first array that has not as many axes as declared: its sizes cannot be read."""
        for array, (name, declared) in zip(arrays, self._given.items(), strict=True):
            if array.ndim != len(declared.sizes):
                raise TypeError(
                    f"{self.owner}: '{name}' is {array.dtype} {array.shape}, wants ({', '.join(declared.sizes)})"
                )
        raise AssertionError("all arrays have as many axes as declared")

    @staticmethod
    def _image(image: GreyImage) -> GreyImage:
        """Return an image as kernels take it, of bytes or of float32."""
        return np.ascontiguousarray(image, None if image.dtype == np.uint8 else np.float32)

    @staticmethod
    def _new(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return the memory of a result, or scratch."""
        return np.empty(shape, dtype)


def _is_of(name: str, dtype: np.dtype[Any]) -> str:
    """Return the test of an array's type; bytes and truth values lie alike in memory."""
    test = f"{name}.dtype is _{dtype}"
    return f"({test} or {name}.dtype is _bool)" if dtype == np.uint8 else test


class Struct(ctypes.Structure):
    """A structure of api.h, its members filled in by `structure`; one without arrays is made like any of ctypes."""

    _call: _Call
    _names: frozenset[str]
    _make: Callable[..., Self] | None
    _kept: dict[str, Any]

    @classmethod
    def of(cls, **values: Any) -> Self:
        """Return the structure with its members, given by name but for sizes; it keeps alive what it points to.

        Raises TypeError where a member is missing or an array is not as api.h says.
        """
        if values.keys() != cls._names:
            raise TypeError(f"{cls.__name__}: wants {', '.join(cls._call.names)}; was given {', '.join(values)}")
        if cls._make is None:
            cls._make = staticmethod(cls._call.compiled(cls))
        return cls._make(**values)


def structure(name: str) -> Any:
    """Return a decorator that makes a class the structure `name` of api.h."""

    def fill(cls: type[AnyStruct]) -> type[AnyStruct]:
        members = header().structures[name]
        pointed = frozenset(one.name for one in members if one.pointer and one.type in STRUCTURES)
        cls._call = _Call(name, members, pointed)
        cls._names, cls._make = frozenset(cls._call.names), None
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
    """A function of the library, called with what api.h wants of Python: arrays, numbers, structures."""

    def __init__(self, name: str, library: ctypes.CDLL) -> None:
        self.name = name
        self._function = getattr(library, name)
        self._call = _Call(name, header().functions[name])
        self._compiled: Callable[..., Any] | None = None

    def _compile(self) -> Callable[..., Any]:
        """Declare the arguments, at the first call: by then the caller has declared the structures among them."""
        parameters, result = header().functions[self.name], header().results[self.name]
        self._function.argtypes = [_ctype(one) for one in parameters]
        self._function.restype = None if result.type == "void" else _ctype(result)
        self._compiled = self._call.compiled(self._function, returns=result.type != "void")
        return self._compiled

    def __call__(self, *arguments: Any) -> Any:
        """Call it and return what it returns, and its results; raises TypeError where an argument is missing or an
        array is not as declared."""
        if len(arguments) != len(self._call.names):
            raise TypeError(f"{self.name}: wants {', '.join(self._call.names)}; was given {len(arguments)}")
        return (self._compiled or self._compile())(*arguments)
