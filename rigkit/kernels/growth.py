"""Calls of the kernels in growth.c: plain arrays in, plain arrays out; all tolerances come from the callers."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p, pointer
from typing import ClassVar

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.kernels import address
from rigkit.kernels.front import RingRules

__all__ = ["FitRules", "GrowthRules", "Squares", "components_of", "fit", "grown"]

FIT_COLUMNS = 12


class FitRules(Structure):
    """fit_rules_t."""

    _fields_: ClassVar = [
        ("degree", c_int64),
        ("radius", c_int64),
        ("leave_out", c_int64),
        ("width", c_double),
        ("ridge", c_double * 2),
    ]


class GrowthRules(Structure):
    """growth_rules_t; `make` also keeps the arrays that it points to."""

    _fields_: ClassVar = [
        ("predictions", FitRules * 2),
        ("ring", POINTER(RingRules)),
        ("along", c_void_p),
        *((name, c_int64) for name in ("places", "most", "tried", "fewest")),
        *(
            (name, c_double)
            for name in (
                *("reach", "ring_part", "min_ring", "max_ring", "line_sine", "contrast_ratio"),
                *("aside", "min_aside", "max_aside", "least_area"),
            )
        ),
    ]

    @classmethod
    def make(
        cls,
        predictions: Sequence[FitRules],
        ring: RingRules,
        along: np.ndarray,
        **numbers: float,
    ) -> GrowthRules:
        """Return the rules; `along` are the places of an edge that are looked at."""
        kept = np.ascontiguousarray(along, np.float64)
        rules = cls(**numbers)
        rules.predictions = (FitRules * 2)(*predictions)
        rules.ring = pointer(ring)
        rules.along, rules.places = address(kept), len(kept)
        rules.kept = kept
        return rules


class _Level(Structure):
    _fields_: ClassVar = [
        ("brightness", c_void_p),
        *((name, c_int64) for name in ("width", "height")),
        *((name, c_double) for name in ("scale", "offset")),
    ]


class _Sheet(Structure):
    _fields_: ClassVar = [
        *((name, c_void_p) for name in ("pixels", "contrast", "due_first", "due_second")),
        *((name, c_int64) for name in ("rows", "columns")),
        ("sign", c_double),
    ]


class Squares(Structure):
    """squares_t: points (N, 2), N > 0, sorted into squares, to find those near a place."""

    _fields_: ClassVar = [
        *((name, c_void_p) for name in ("points", "first", "order")),
        *((name, c_int64) for name in ("columns", "rows")),
        *((name, c_double) for name in ("left", "top", "side")),
    ]

    @classmethod
    def of(cls, library: ctypes.CDLL, points: FloatArray) -> Squares:
        points = np.ascontiguousarray(points, np.float64)
        memory = np.empty(_declared(library).squares_memory(len(points)), np.int32)
        squares = cls()
        squares.kept = (points, memory)
        library.sort_points(address(points), len(points), address(memory), byref(squares))
        return squares


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    """Declare the arguments, once a library."""
    if library.fit_cells.argtypes is None:
        library.fit_cells.argtypes = [c_void_p, c_int64, c_int64, c_void_p, POINTER(FitRules), c_void_p]
        library.fit_cells.restype = None
        library.grow_lattice.argtypes = [
            *(POINTER(kind) for kind in (_Sheet, _Level, Squares, GrowthRules)),
            *(c_int64, c_void_p, c_void_p),
        ]
        library.grow_lattice.restype = c_int64
        library.squares_memory.argtypes, library.squares_memory.restype = [c_int64], c_int64
        library.sort_points.argtypes = [c_void_p, c_int64, c_void_p, POINTER(Squares)]
        library.sort_points.restype = None
        library.find_components.argtypes = [c_int64, *[c_void_p] * 7]
        library.find_components.restype = c_int64
    return library


def fit(library: ctypes.CDLL, lattice: FloatArray, cells: BoolArray, rules: FitRules) -> FloatArray:
    """Return the fits of M `cells` (R, C) of `lattice` (R, C, 2): (M, 12), in the order of `LocalFit`."""
    lattice = np.ascontiguousarray(lattice, np.float64)
    cells = np.ascontiguousarray(cells, np.bool_)
    out = np.empty((int(np.count_nonzero(cells)), FIT_COLUMNS))
    rows, columns = cells.shape
    _declared(library).fit_cells(address(lattice), rows, columns, address(cells), byref(rules), address(out))
    return out


def grown(
    library: ctypes.CDLL,
    pixels: FloatArray,
    contrast: FloatArray,
    sign: float,
    image: np.ndarray,
    scale: float,
    offset: float,
    saddles: Squares,
    rules: GrowthRules,
    rings: int,
) -> int:
    """Grow the lattice `pixels` (R, C, 2), `contrast` (R, C) in place; both contiguous float64, NaN where unknown.

    Returns the rings that are left if the lattice has reached the border of its arrays, -1 if it has grown all it can.
    """
    rows, columns = contrast.shape
    image = np.ascontiguousarray(image, np.float32)
    due = np.ones((2, rows, columns), np.uint8)
    fresh, where = np.empty((rows * columns, 3)), np.empty(rows * columns, np.int64)
    start = address(due)
    sheet = _Sheet(address(pixels), address(contrast), start, start + rows * columns, rows, columns, sign)
    level = _Level(address(image), image.shape[1], image.shape[0], scale, offset)
    call = _declared(library).grow_lattice
    return int(call(byref(sheet), byref(level), byref(saddles), byref(rules), rings, address(fresh), address(where)))


def components_of(library: ctypes.CDLL, links: IntArray) -> tuple[int, IntArray, IntArray, IntArray, IntArray]:
    """Return the number of lattices that mutual `links` make up, and label, grid (N, 2), turn, members of the corners.

    `links` (N, 4) are 4 * the neighbour + its arm, -1 for none.
    """
    count = len(links)
    links = np.array(links, np.int64, order="C")
    label, grid, turn = np.empty(count, np.int64), np.empty((count, 2), np.int64), np.empty(count, np.int64)
    members, queue, bound = np.empty(count, np.int64), np.empty(2 * count, np.int64), np.empty(4 * count, np.uint8)
    arrays = (label, grid, turn, members, queue, bound)
    found = _declared(library).find_components(count, address(links), *(address(a) for a in arrays))
    return int(found), label, grid, turn, members
