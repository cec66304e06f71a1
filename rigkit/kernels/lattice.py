"""Calls of the kernels in lattice.c and splits.c: plain arrays in and out; all tolerances come from the callers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.front import ImageOf


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
    typical, seen, every = kernels().uneven_steps(pixels, max(columns - 2, 0) + max(rows - 2, 0))
    along_rows, along_columns = every.tolist()
    return typical.tolist(), seen.tolist(), (along_rows, along_columns)


def line_gaps(sides: FloatArray, curvatures: FloatArray) -> FloatArray:
    """Return what `detection.lattice.local_fit.LocalFit.gaps` does of its `sides` and `curvatures`, (M, 2, 2)."""
    return np.asarray(kernels().line_gaps(sides, curvatures))


def excess_scatter(
    pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]], rules: ScatterRules
) -> FloatArray:
    """Return what `subpixel.scatter.excess_scatter` does of `pixels` (R, C, 2) and `sigma_px` (R, C), (P,)."""
    where = np.array(
        [(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start) for rows, columns in parts],
        np.int64,
    ).reshape(-1, 4)
    return np.asarray(kernels().excess_scatter(pixels, sigma_px, where, rules))


def surface_scatter(pixels: FloatArray, sigma_px: FloatArray, rules: ScatterRules) -> tuple[float, float]:
    """Return how far `pixels` (R, C, 2) lie off surfaces of both degrees over what `sigma_px` (R, C) says, rms.

    NaN where these fit any, or where rows and columns have differences enough to tell (`excess_scatter`).
    """
    lower, higher = kernels().surface_scatter(pixels, sigma_px, rules).tolist()
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
    max_edges: int,
) -> FloatArray:
    """Return how far edges lie aside, (K,), as `detection.checks.validate._edge_offsets`, of about `max_edges`
    edges."""
    level, sign = ImageOf.of(brightness=image), 1.0 if rising else -1.0
    places = np.array(along)
    return np.asarray(kernels().edge_shifts(pixels, sign, level, scale, offset, reach, places, steps, max_edges))


def clearest_splits(
    pixels: FloatArray, sigma_px: FloatArray, several: bool, rules: SplitRules
) -> list[tuple[float, int, int]]:
    """Return the clearest split of `pixels` (R, C, 2), `sigma_px` (R, C), between columns, and that between rows: how
    many times better the two sides fit alone, 0 where there is none, and the first and the last (exclusive) between
    them. `detection.checks.discontinuity` says what that is."""
    out = kernels().clearest_splits(pixels, sigma_px, several, rules)
    return [(ratio, int(start), int(end)) for ratio, start, end in out.tolist()]
