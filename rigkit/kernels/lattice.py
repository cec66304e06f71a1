"""Calls of the kernels in lattice.c: plain arrays in, plain arrays out; all tolerances come from the callers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.front import ImageOf

ROOM_FOR_SCATTER = 7
"""Numbers that lattice.c keeps for each corner."""


@structure("scatter_rules_t")
class ScatterRules(Struct):
    """The constants of `detection.subpixel.scatter`."""


def uneven_steps(pixels: FloatArray) -> tuple[list[float], list[int], tuple[float, float]]:
    """Return what `detection.lattice.spacing.spacing_changes` does of `pixels` (R, C, 2).

    That is `typical` and `seen` of the inner columns and then of the inner rows, and `every` of both.
    """
    pixels = np.ascontiguousarray(pixels, np.float64)
    rows, columns = pixels.shape[:2]
    inner = max(columns - 2, 0) + max(rows - 2, 0)
    scratch, typical, every = np.empty(2 * rows * columns), np.empty(inner), np.empty(2)
    seen = np.empty(inner, np.int64)
    kernels().uneven_steps(pixels, rows, columns, scratch, inner, typical, seen, every)
    along_rows, along_columns = every.tolist()
    return typical.tolist(), seen.tolist(), (along_rows, along_columns)


def excess_scatter(
    pixels: FloatArray,
    sigma_px: FloatArray,
    parts: Sequence[tuple[slice, slice]],
    rules: ScatterRules,
) -> FloatArray:
    """Return what `subpixel.scatter.excess_scatter` does of `pixels` (R, C, 2) and `sigma_px` (R, C), (P,)."""
    pixels, sigma_px = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(sigma_px, np.float64)
    where = np.array(
        [(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start) for rows, columns in parts],
        np.int64,
    ).reshape(-1, 4)
    scratch, out = np.empty(ROOM_FOR_SCATTER * sigma_px.size), np.empty(len(where))
    kernels().excess_scatter(pixels, sigma_px, *sigma_px.shape, where, len(where), rules, scratch, out)
    return out


def shifts_of_edges(
    pixels: FloatArray,
    rising: bool,
    image: NDArray[np.float32],
    scale: float,
    offset: float,
    reach: float,
    along: Sequence[float],
    steps: int,
    most: int,
) -> FloatArray:
    """Return how far edges lie aside, (K,), as `detection.checks.validate._edge_offsets`, from about `most` edges."""
    pixels, image = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(image, np.float32)
    places = np.array(along, np.float64)
    rows, columns = pixels.shape[:2]
    sums, out = np.empty((len(places), steps + 1)), np.empty(len(places))
    kernels().edge_shifts(
        *(pixels, rows, columns, 1.0 if rising else -1.0, ImageOf.make(image), scale, offset, reach),
        *(places, len(places), steps, most, sums, out),
    )
    return out
