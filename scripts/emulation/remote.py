"""Replace the kernels in the tests by calls to the program of `host`.

A pytest plugin (-p emulation.remote). Arrays and structures are copied into the shared file before a call and back
after it, with all addresses in them translated.
"""

from __future__ import annotations

import ctypes
import os
import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.array_utils import byte_bounds

from emulation.host import ADDRESS, MEGABYTES
from rigkit.kernels import calls
from rigkit.kernels.declarations import header

COMMAND = "RIGKIT_EMULATED_HOST"
"""The environment's word for how the program is started, the shared file's own path last."""
SLOTS = 4096
"""Bytes at the beginning of the file, for arguments and results."""
ALIGNMENT = 64
EMPTY_THERE = ADDRESS + SLOTS
"""What `calls.EMPTY` is in the program: no array lies there."""


class Host:
    """The running program and the file that it shares."""

    def __init__(self, command: list[str], shared: Path) -> None:
        size = MEGABYTES << 20
        with shared.open("wb") as file:
            file.truncate(size)
        file_number = os.open(shared, os.O_RDWR)
        libc = ctypes.CDLL(None, use_errno=True)
        libc.mmap.restype = ctypes.c_void_p
        libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_int64]
        # To read and to write; shared, and at this very address.
        at = libc.mmap(ADDRESS, size, 0x1 | 0x2, 0x01 | 0x10, file_number, 0)
        if at != ADDRESS:
            raise OSError(ctypes.get_errno(), "the shared file could not be mapped")
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)

    def run(self, which: int) -> None:
        """Have the function run on what stands in the slots; raises RuntimeError where the program has died."""
        assert self._process.stdin is not None and self._process.stdout is not None
        number = which.to_bytes(8, "little")
        self._process.stdin.write(number)
        if self._process.stdout.read(8) != number:
            raise RuntimeError(f"the emulated program ended: exit code {self._process.wait()}")


class Call:
    """The arguments of one call, as they lie in the shared file."""

    def __init__(self) -> None:
        self._next = EMPTY_THERE + ALIGNMENT
        self._blocks: list[tuple[int, int, int, bool]] = []
        """Address here, bytes, address there, whether it may be written to."""
        self._structures: list[tuple[ctypes.Structure, int]] = []

    def take_arrays(self, values: list[Any]) -> None:
        """Copy all arrays that are reached from `values`; those that share memory here share it there."""
        bounds = [(*_bounds(array), array.flags.writeable) for array in _arrays(values)]
        merged: list[list[Any]] = []
        for start, end, writeable in sorted(bounds):
            size = end - start
            if merged and start <= merged[-1][0] + merged[-1][1]:
                last = merged[-1]
                last[1], last[2] = max(last[1], start + size - last[0]), last[2] or writeable
            else:
                merged.append([start, size, writeable])
        for start, size, writeable in merged:
            there = self._place(size)
            ctypes.memmove(there, start, size)
            self._blocks.append((start, size, there, writeable))

    def _place(self, size: int) -> int:
        there = self._next
        self._next += (size // ALIGNMENT + 2) * ALIGNMENT
        if self._next > ADDRESS + (MEGABYTES << 20):
            raise MemoryError("the shared file is too small for this call")
        return there

    def there(self, address: int | None) -> int:
        """Return what an address is in the program; raises LookupError where it points to nothing that was copied."""
        if not address or address == ctypes.addressof(calls.EMPTY):
            return 0 if not address else EMPTY_THERE
        for start, size, there, _ in self._blocks:
            if start <= address <= start + size:
                return there + address - start
        raise LookupError(f"no array of this call lies at {address:#x}")

    def _here(self, address: int) -> int:
        """Return what an address of the program is on this side; 0 of none."""
        if address == EMPTY_THERE:
            return ctypes.addressof(calls.EMPTY)
        places = [start + address - there for start, size, there, _ in self._blocks if there <= address <= there + size]
        return places[0] if places else 0

    def structure(self, struct: ctypes.Structure) -> int:
        """Copy a structure with what it points to; return where it lies in the program."""
        for known, there in self._structures:
            if known is struct:
                return there
        there = self._place(ctypes.sizeof(struct))
        ctypes.memmove(there, ctypes.addressof(struct), ctypes.sizeof(struct))
        self._structures.append((struct, there))
        self._translate(type(struct), struct, there)
        return there

    def _translate(self, kind: type[ctypes.Structure], struct: Any, there: int) -> None:
        """Set the addresses among the members of the copy of `struct`, and of what is part of it."""
        for name, member in [(field[0], field[1]) for field in kind._fields_]:
            value, at = getattr(struct, name), there + getattr(kind, name).offset
            if member is ctypes.c_void_p:
                ctypes.c_uint64.from_address(at).value = self.there(value)
            elif isinstance(value, ctypes.Structure):
                self._translate(type(value), value, at)
            elif isinstance(value, ctypes._Pointer):
                ctypes.c_uint64.from_address(at).value = self.structure(value.contents)
            elif isinstance(value, ctypes.Array) and issubclass(value._type_, ctypes.Structure):
                for i, part in enumerate(value):
                    self._translate(value._type_, part, at + i * ctypes.sizeof(value._type_))

    def bring_back(self) -> None:
        """Copy what the program may have written: arrays, and the numbers and addresses of structures."""
        for start, size, there, writeable in self._blocks:
            if writeable:
                ctypes.memmove(start, there, size)
        for struct, there in self._structures:
            for name, member in [(field[0], field[1]) for field in type(struct)._fields_]:
                at = there + getattr(type(struct), name).offset
                if member in (ctypes.c_int64, ctypes.c_double, ctypes.c_float):
                    setattr(struct, name, member.from_address(at).value)
                elif member is ctypes.c_void_p:
                    setattr(struct, name, self._here(ctypes.c_uint64.from_address(at).value))


def _arrays(value: Any) -> list[np.ndarray[Any, Any]]:
    """Return the arrays that are reached from a value: itself, in containers, or kept by structures."""
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, dict):
        return _arrays(list(value.values()))
    if isinstance(value, list | tuple | ctypes.Array):
        return [array for part in value for array in _arrays(part)]
    if not isinstance(value, ctypes.Structure):
        return []
    return _arrays(getattr(value, "_kept", []))


def _bounds(array: np.ndarray[Any, Any]) -> tuple[int, int]:
    """Return the first address of an array and the one behind its last byte."""
    return byte_bounds(array) if array.nbytes else (array.ctypes.data, array.ctypes.data)


class RemoteKernel(calls.Kernel):
    """A function of the emulated library: its arguments are checked as always, then taken to the program."""

    def __init__(self, name: str, library: ctypes.CDLL) -> None:
        super().__init__(name, library)
        self._which = list(header().functions).index(name)
        self._arguments: tuple[Any, ...] = ()
        self._copies: list[Any] = []

    def _compile(self) -> Any:
        super()._compile()
        # Arrays that are passed and are no arguments: copies of these, images, results and scratch.
        for name in ("_ready", "_image", "_new"):
            setattr(self._call, name, self._noted(getattr(self._call, name)))
        returns = header().results[self.name].type != "void"
        self._compiled = self._call.compiled(self._there, returns=returns)
        return self._compiled

    def _noted(self, make: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that makes the same arrays and notes them."""

        def noted(*one: Any) -> Any:
            self._copies.append(make(*one))
            return self._copies[-1]

        return noted

    def __call__(self, *arguments: Any) -> Any:
        before, self._arguments, self._copies = (self._arguments, self._copies), arguments, []
        try:
            return super().__call__(*arguments)
        finally:
            self._arguments, self._copies = before

    def _there(self, *passed: Any) -> Any:
        program, call, result = host(), Call(), header().results[self.name]
        call.take_arrays([*self._arguments, *self._copies])
        for i, (value, one) in enumerate(zip(passed, header().functions[self.name], strict=True)):
            at = ADDRESS + 8 * i
            if isinstance(value, ctypes.Structure):
                ctypes.c_uint64.from_address(at).value = call.structure(value)
            elif isinstance(value, ctypes._Pointer):
                ctypes.c_uint64.from_address(at).value = call.structure(value.contents)
            elif one.array is not None:
                ctypes.c_uint64.from_address(at).value = call.there(value)
            else:
                kind: Any = {"double": ctypes.c_double, "float": ctypes.c_float}.get(one.type, ctypes.c_int64)
                kind.from_address(at).value = value
        program.run(self._which)
        call.bring_back()
        if result.type == "char":
            return ctypes.string_at(ADDRESS)
        kinds: dict[str, Any] = {"double": ctypes.c_double, "int64_t": ctypes.c_int64}
        return None if result.type == "void" else kinds[result.type].from_address(ADDRESS).value


_HOSTS: list[Host] = []


def host() -> Host:
    """Return the program of this process, started at the first call."""
    if not _HOSTS:
        *command, shared = shlex.split(os.environ[COMMAND])
        own = Path(f"{shared}-{os.getpid()}")
        host_path = f"Z:{own}".replace("/", "\\") if "wine" in command[0] else str(own)
        _HOSTS.append(Host([*command, host_path], own))
    return _HOSTS[0]


def pytest_configure() -> None:
    """Put the emulated kernels in the place of this system's."""
    calls.Kernel = RemoteKernel  # type: ignore[misc]
