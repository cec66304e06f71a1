"""Calls of the kernels in lattice.c and splits.c, with the callers' tolerances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.front import ImageOf


@structure("scatter_rules_t", last_order="MAX_DIFFERENCE_ORDER", degrees="MAX_SCATTER_DEGREE")
class ScatterRules(Struct):
    """The constants of `detection.subpixel.scatter`."""


@structure("split_rules_t")
class SplitRules(Struct):
    """The constants of `detection.checks.discontinuity`."""


def uneven_steps(pixels: FloatArray) -> tuple[list[float], list[int], tuple[float, float]]:
    """Return `typical` and `seen` of the inner columns and then of the inner rows of `pixels` (R, C, 2), and `every` of
    both; see `detection.lattice.spacing.SpacingChange`."""
    rows, columns = pixels.shape[:2]
    typical, seen, every = kernels().uneven_steps(pixels, max(columns - 2, 0) + max(rows - 2, 0))
    along_rows, along_columns = every.tolist()
    return typical.tolist(), seen.tolist(), (along_rows, along_columns)


def line_gaps(sides: FloatArray, curvatures: FloatArray) -> FloatArray:
    """Return the gaps (M, 2, 2) of `detection.lattice.local_fit.LocalFit` from its `sides` and `curvatures`."""
    return np.asarray(kernels().line_gaps(sides, curvatures))


def excess_scatter(
    pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]], rules: ScatterRules
) -> FloatArray:
    """See `detection.subpixel.scatter.excess_scatter`."""
    where = np.array(
        [(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start) for rows, columns in parts],
        np.int64,
    ).reshape(-1, 4)
    return np.asarray(kernels().excess_scatter(pixels, sigma_px, where, rules))


def surface_scatter(pixels: FloatArray, sigma_px: FloatArray, rules: ScatterRules) -> tuple[float, float]:
    """Return the rms residuals of surfaces of both degrees through `pixels` (R, C, 2) over `sigma_px` (R, C).

    NaN without redundancy, or if rows and columns have enough differences for `excess_scatter`.
    """
    lower, higher = kernels().surface_scatter(pixels, sigma_px, rules).tolist()
    return lower, higher


def shifts_of_edges(
    pixels: FloatArray,
    rising: bool,
    image: NDArray[np.float32],
    scale: float,
    offset: float,
    reach: Sequence[float],
    along: Sequence[float],
    steps: int,
    max_edges: int,
) -> FloatArray:
    """Return the offsets (K,) of `detection.checks.validate._edge_offsets`, over about `max_edges` edges."""
    level, sign = ImageOf.of(brightness=image), 1.0 if rising else -1.0
    within, places = np.array(reach), np.array(along)
    return np.asarray(kernels().edge_shifts(pixels, sign, level, scale, offset, within, places, steps, max_edges))


def clearest_splits(
    pixels: FloatArray, sigma_px: FloatArray, several: bool, rules: SplitRules
) -> list[tuple[float, int, int]]:
    """Return the clearest discontinuities of `pixels` (R, C, 2) with `sigma_px` (R, C) between columns and between
    rows.

    Each is (ratio of the residuals of a common fit to those of separate fits, 0 without a discontinuity; first and last
    (exclusive) column or row between the two sides). See `detection.checks.discontinuity`.
    """
    out = kernels().clearest_splits(pixels, sigma_px, several, rules)
    return [(ratio, int(start), int(end)) for ratio, start, end in out.tolist()]
