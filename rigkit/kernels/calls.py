"""Calls of the kernels as declared in api.h: sizes are taken from arrays, results and scratch memory are allocated, and
type, shape and C-contiguity of every array are checked.

A detection makes sixty calls, some of functions that take ten microseconds. Each call is therefore compiled once, with
its checks as one expression. If that fails, arrays are checked one by one: read-only arrays are copied to the declared
type and order, for others an error is raised.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any, NoReturn, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import GreyImage
from rigkit.kernels.declarations import SCALARS, Declaration, Role, header

STRUCTURES: dict[str, type[Struct]] = {}
"""By their names in api.h, where a structure precedes those that contain it."""

NAMES_IN_SIZES: dict[str, Any] = dict(header().constants)
"""Names other than arguments in sizes of arrays: the constants, and the kernels once they are loaded."""

FIRST_BYTE: Callable[[Any], ctypes.c_char] = ctypes.c_char.from_buffer
"""Raises TypeError or ValueError for an array that is not contiguous, read-only, or empty."""
EMPTY = ctypes.c_double()
"""Passed for an empty array, which has no first value."""


AnyStruct = TypeVar("AnyStruct", bound="Struct")


def address(array: NDArray[Any]) -> int:
    """Return the address of the first value of a C-contiguous `array`, which must outlive its use.

    Raises ValueError for another order in memory. It takes a quarter of the time of `array.ctypes.data`; a detection
    needs two hundred addresses.
    """
    try:
        return ctypes.addressof(FIRST_BYTE(array))
    except (TypeError, ValueError):
        if not array.flags.c_contiguous:
            raise ValueError("not C-contiguous") from None
        return int(array.ctypes.data)


class _Call:
    """Code of a call, or of making a structure, from the parameters `names`.

    The other parameters follow from these: sizes of the arrays, the type of an image, results and scratch memory.
    """

    def __init__(self, owner: str, declarations: list[Declaration], pointed: frozenset[str] = frozenset()) -> None:
        self.owner = owner
        self._all = tuple(one.name for one in declarations)
        self._pointed = pointed
        self._arrays = {one.name: one.array for one in declarations if one.array is not None}
        self._given = {name: array for name, array in self._arrays.items() if array.role is Role.GIVEN}
        self._made = {name: array for name, array in self._arrays.items() if array.role is not Role.GIVEN}
        numbers = {one.name for one in declarations if one.type == "int64_t" and one.array is None}
        # The first array with a size determines it; the checks compare those of the others.
        self._sizes: dict[str, str] = {}
        for name, array in self._given.items():
            for axis, size in enumerate(array.sizes):
                if size in numbers:
                    self._sizes.setdefault(size, f"{name}.shape[{axis}]")
            if array.dtype is None:
                self._sizes["bytes"] = f"{name}.dtype == _uint8"
        self.names = tuple(name for name in self._all if name not in self._sizes and name not in self._made)

    def compiled(self, target: Callable[..., Any], *, returns: bool = False) -> Callable[..., Any]:
        """Return a function of the parameters `names`, in their order, that calls `target` with addresses of arrays.

        It returns the value of `target`, if that `returns` one, and the results, as a tuple if there are several. It
        raises TypeError if an array is not as declared. NAMES_IN_SIZES must be complete.
        """
        images = [f"{name} = _image({name})" for name, array in self._given.items() if array.dtype is None]
        sizes = [f"{size} = {where}" for size, where in self._sizes.items()]
        tests = [f"{name}.shape == {array.shape}" for name, array in self._given.items()]
        # Types are singletons, except those of another byte order.
        tests += [_is_of(name, array.dtype) for name, array in self._given.items() if array.dtype is not None]
        ready = [f"{name} = _ready('{name}', {name}, {array.shape})" for name, array in self._given.items()]
        made = [f"{name} = _new({array.shape}, _{array.dtype})" for name, array in self._made.items()]
        passed = [self._passed(name, "_addressof(_from_buffer({0})) if {0}.size else _empty") for name in self._all]
        checked = [self._passed(name, "_address({0})") for name in self._all]
        results = [name for name, array in self._made.items() if array.role is Role.RESULT]
        out = ", ".join([*(["_returned"] if returns or not results else []), *results])
        # A structure keeps its arrays alive; a function needs them only until it returns.
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
        """Return the expression of the value passed for a parameter; for an array `of_array` with its name."""
        if name in self._arrays:
            return of_array.format(name)
        return f"_pointer({name})" if name in self._pointed else name

    def _ready(self, name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """Return the array, or a converted copy if it is read-only; raises TypeError if it cannot be converted."""
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
        """Raise TypeError for the first array whose number of axes is not as declared."""
        for array, (name, declared) in zip(arrays, self._given.items(), strict=True):
            if array.ndim != len(declared.sizes):
                raise TypeError(
                    f"{self.owner}: '{name}' is {array.dtype} {array.shape}, wants ({', '.join(declared.sizes)})"
                )
        raise AssertionError("all arrays have the declared number of axes")

    @staticmethod
    def _image(image: GreyImage) -> GreyImage:
        """Return a contiguous image of bytes or float32."""
        return np.ascontiguousarray(image, None if image.dtype == np.uint8 else np.float32)

    @staticmethod
    def _new(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return the memory of a result, or scratch."""
        return np.empty(shape, dtype)


def _is_of(name: str, dtype: np.dtype[Any]) -> str:
    """Return the test of an array's type; bytes and truth values have the same memory layout."""
    test = f"{name}.dtype is _{dtype}"
    return f"({test} or {name}.dtype is _bool)" if dtype == np.uint8 else test


class Struct(ctypes.Structure):
    """A structure of api.h, whose members `structure` declares; one without arrays can be made like any of ctypes."""

    _call: _Call
    _names: frozenset[str]
    _make: Callable[..., Self] | None
    _kept: dict[str, Any]
    _largest: dict[str, int]

    def __init__(self, *values: Any, **named: Any) -> None:
        """Raises ValueError if a member is larger than the kernels have room for."""
        super().__init__(*values, **named)
        for name, largest in self._largest.items():
            value = getattr(self, name)
            if max(value if isinstance(value, ctypes.Array) else (value,)) > largest:
                raise ValueError(f"{type(self).__name__}: '{name}' is larger than {largest}")

    @classmethod
    def of(cls, **values: Any) -> Self:
        """Return the structure with its members, given by name except sizes; it keeps its arrays alive.

        Raises TypeError if a member is missing or an array is not as declared in api.h.
        """
        if values.keys() != cls._names:
            raise TypeError(f"{cls.__name__}: wants {', '.join(cls._call.names)}; was given {', '.join(values)}")
        if cls._make is None:
            cls._make = staticmethod(cls._call.compiled(cls))
        return cls._make(**values)


def structure(name: str, **largest: str) -> Any:
    """Return a decorator that makes a class the structure `name` of api.h.

    `largest` : constants of api.h that members must not exceed, by the members' names.
    """

    def fill(cls: type[AnyStruct]) -> type[AnyStruct]:
        members = header().structures[name]
        pointed = frozenset(one.name for one in members if one.pointer and one.type in STRUCTURES)
        cls._call = _Call(name, members, pointed)
        cls._names, cls._make = frozenset(cls._call.names), None
        cls._largest = {member: header().constants[limit] for member, limit in largest.items()}
        cls._fields_ = [(one.name, _ctype(one)) for one in members]
        STRUCTURES[name] = cls
        return cls

    return fill


_making = threading.Lock()
"""Two classes of one structure are not the same type to a kernel."""


def make_struct(name: str, **members: Any) -> Struct:
    """Return the structure `name` of api.h, which needs no class of its own, with its members; see `Struct.of`."""
    with _making:
        if name not in STRUCTURES:
            structure(name)(type(name, (Struct,), {}))
    return STRUCTURES[name].of(**members)


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
    """A function of the library, called with arrays, numbers and structures as declared in api.h."""

    def __init__(self, name: str, library: ctypes.CDLL) -> None:
        self.name = name
        self._function = getattr(library, name)
        self._call = _Call(name, header().functions[name])
        self._compiled: Callable[..., Any] | None = None

    def _compile(self) -> Callable[..., Any]:
        """Compile the call, at the first call, when all structures are declared."""
        parameters, result = header().functions[self.name], header().results[self.name]
        self._function.argtypes = [_ctype(one) for one in parameters]
        self._function.restype = None if result.type == "void" else _ctype(result)
        self._compiled = self._call.compiled(self._function, returns=result.type != "void")
        return self._compiled

    def __call__(self, *arguments: Any) -> Any:
        """Return the value of the function and its results; raises TypeError if an argument is missing or an array is
        not as declared."""
        if len(arguments) != len(self._call.names):
            raise TypeError(f"{self.name}: wants {', '.join(self._call.names)}; was given {len(arguments)}")
        return (self._compiled or self._compile())(*arguments)
