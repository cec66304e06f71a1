"""Corners of whole lattices to a hundredth of a pixel: the edge model at every corner, guided by the lattice.

The lattice says which way the lines run, how far the cell reaches, and how the lines bend; the fit says where the
corners are, and so gives a better lattice for a second pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.arrays import FloatArray
from rigkit.corners.edge_model import BLUR_RANGE, EdgeFit, EdgeStart, fit_edges
from rigkit.corners.lattice import Lattice
from rigkit.corners.local_fit import LocalFit, fit_cells
from rigkit.corners.response import FloatImage

__all__ = ["RefinedLattice", "refine"]

PASSES = 2
FIRST_BLUR = 1.0


@dataclass(frozen=True, eq=False, slots=True)
class RefinedLattice:
    """A lattice with what the fit says of each corner, (R, C) each and NaN where unknown.

    Attributes
    ----------
    lattice : the corners.
    sigma_px, blur_px, residual : predicted standard deviation, width of the edges, RMS of the fit in grey levels.
    """

    lattice: Lattice
    sigma_px: FloatArray
    blur_px: FloatArray
    residual: FloatArray


def refine(image: FloatImage, lattices: Sequence[Lattice]) -> list[RefinedLattice]:
    """Return `lattices` with their corners placed by the edge model on the full-resolution grey `image`.

    Corners whose fit fails are dropped.
    """
    if not lattices:
        return []
    current = list(lattices)
    blurs = [np.full(item.known.shape, FIRST_BLUR) for item in current]
    refined: list[RefinedLattice] = []
    for _ in range(PASSES):
        fits = _fit(image, current, blurs)
        refined = [_filled(item, fit) for item, fit in zip(current, fits, strict=True)]
        current = [item.lattice for item in refined]
        blurs = [_typical_blur(item) for item in refined]
    return refined


def _typical_blur(item: RefinedLattice) -> FloatArray:
    known = np.isfinite(item.blur_px)
    typical = float(np.median(item.blur_px[known])) if known.any() else FIRST_BLUR
    return np.where(known, np.clip(item.blur_px, 0.7 * typical, 1.4 * typical), typical).clip(*BLUR_RANGE)


def _fit(image: FloatImage, lattices: list[Lattice], blurs: list[FloatArray]) -> list[EdgeFit]:
    """Fit all corners of all lattices in one batch."""
    shapes = [fit_cells(item.pixels, item.known) for item in lattices]
    known = [item.known for item in lattices]
    start = EdgeStart(
        np.concatenate([item.pixels[k] for item, k in zip(lattices, known, strict=True)]),
        np.concatenate([_sides(shape) for shape in shapes]),
        np.concatenate([shape.curvature() for shape in shapes]),
        np.concatenate([item.signs()[k] for item, k in zip(lattices, known, strict=True)]),
        np.concatenate([blur[k] for blur, k in zip(blurs, known, strict=True)]),
    )
    fit = fit_edges(image, start)
    ends = np.cumsum([int(k.sum()) for k in known])
    names = EdgeFit.__slots__
    return [
        EdgeFit(*(getattr(fit, name)[end - int(k.sum()) : end] for name in names))
        for end, k in zip(ends, known, strict=True)
    ]


def _sides(shape: LocalFit) -> FloatArray:
    return np.stack([shape.along_column, shape.along_row], axis=1)


def _filled(lattice: Lattice, fit: EdgeFit) -> RefinedLattice:
    known = lattice.known
    good = fit.valid & (fit.contrast > 0.0)

    def spread(values: FloatArray) -> FloatArray:
        out = np.full(known.shape + values.shape[1:], np.nan)
        out[known] = np.where(good.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)
        return out

    refined = Lattice(spread(fit.pixels), spread(fit.contrast), lattice.rising)
    return RefinedLattice(refined, spread(fit.sigma_px), spread(fit.blur), spread(fit.residual))
