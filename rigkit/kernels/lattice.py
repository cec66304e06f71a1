"""Calls of the kernels in lattice.c and splits.c: plain arrays in and out; all tolerances come from the callers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.front import ImageOf

ROOM_FOR_SCATTER, ROOM_FOR_SURFACES = 7, 20
"""Numbers that lattice.c keeps for each corner."""


@structure("scatter_rules_t")
class ScatterRules(Struct):
    """The constants of `detection.subpixel.scatter`."""


@structure("split_rules_t")
class SplitRules(Struct):
    """The constants of `detection.checks.discontinuity`."""


def uneven_steps(pixels: FloatArray) -> tuple[list[float], list[int], tuple[float, float]]:
    """Return what `detection.lattice.spacing.spacing_changes` does of `pixels` (R, C, 2).

    That is `typical` and `seen` of the inner columns and then of the inner rows, and `every` of both.
    """
    rows, columns = pixels.shape[:2]
    inner = max(columns - 2, 0) + max(rows - 2, 0)
    scratch, typical, every = np.empty(2 * rows * columns), np.empty(inner), np.empty(2)
    seen = np.empty(inner, np.int64)
    kernels().uneven_steps(pixels, rows, columns, scratch, inner, typical, seen, every)
    along_rows, along_columns = every.tolist()
    return typical.tolist(), seen.tolist(), (along_rows, along_columns)


def line_gaps(sides: FloatArray, bends: FloatArray) -> FloatArray:
    """Return what `detection.lattice.local_fit.LocalFit.gaps` does of its `sides` and `bends`, (M, 2, 2)."""
    out = np.empty(sides.shape)
    kernels().line_gaps(sides, bends, len(sides), out)
    return out


def excess_scatter(
    pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]], rules: ScatterRules
) -> FloatArray:
    """Return what `subpixel.scatter.excess_scatter` does of `pixels` (R, C, 2) and `sigma_px` (R, C), (P,)."""
    where = np.array(
        [(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start) for rows, columns in parts],
        np.int64,
    ).reshape(-1, 4)
    scratch, out = np.empty(ROOM_FOR_SCATTER * sigma_px.size), np.empty(len(where))
    kernels().excess_scatter(pixels, sigma_px, *sigma_px.shape, where, len(where), rules, scratch, out)
    return out


def surface_scatter(pixels: FloatArray, sigma_px: FloatArray, rules: ScatterRules) -> tuple[float, float]:
    """Return how far `pixels` (R, C, 2) lie off surfaces of both degrees over what `sigma_px` (R, C) says, rms.

    NaN where these fit any, or where rows and columns have differences enough to tell (`excess_scatter`).
    """
    scratch, out = np.empty(ROOM_FOR_SURFACES * sigma_px.size), np.empty(2)
    kernels().surface_scatter(pixels, sigma_px, *sigma_px.shape, rules, scratch, out)
    lower, higher = out.tolist()
    return lower, higher


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
    image = np.ascontiguousarray(image, np.float32)
    places = np.array(along, np.float64)
    rows, columns = pixels.shape[:2]
    sums, out = np.empty((len(places), steps + 1)), np.empty(len(places))
    kernels().edge_shifts(
        *(pixels, rows, columns, 1.0 if rising else -1.0, ImageOf.make(image), scale, offset, reach),
        *(places, len(places), steps, most, sums, out),
    )
    return out


def clearest_splits(
    pixels: FloatArray, sigma_px: FloatArray, several: bool, rules: SplitRules
) -> list[tuple[float, int, int]]:
    """Return the clearest split of `pixels` (R, C, 2), `sigma_px` (R, C), between columns, and that between rows: how
    many times better the two sides fit alone, 0 where there is none, and the first and the last (exclusive) between
    them. `detection.checks.discontinuity` says what that is."""
    scratch, out = np.empty(kernels().splits_scratch(*sigma_px.shape)), np.empty((2, 3))
    kernels().clearest_splits(pixels, sigma_px, *sigma_px.shape, several, rules, scratch, out)
    return [(ratio, int(start), int(end)) for ratio, start, end in out.tolist()]
