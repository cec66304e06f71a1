"""Sub-pixel refinement of whole lattices: fits of the edge model at every corner, with the geometry of the lattice.

The lattice gives the directions, lengths and curvatures of the lines. A first pass of fits improves the lattice for a
second one, which also tries empty cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, upper_median
from rigkit.detection.lattice.lattice import Lattice, LatticeStack
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.consistent import (
    with_predicted_holes,
    without_inconsistent,
    without_uncertain,
    without_unconfirmed_holes,
)
from rigkit.detection.subpixel.correlation import board_factors
from rigkit.detection.subpixel.edge_curvature import line_curvatures_to_fit
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, EdgeFit, fit_edges
from rigkit.detection.subpixel.edge_model import TAIL_SIGMAS, WINDOW_REACH, Geometry, ends_of, tilted
from rigkit.detection.subpixel.outer_squares import fitted_beside_paper
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import scatter_factors

Part = tuple[slice, slice]
EvidenceScore = Callable[[RefinedLattice], float]
"""Returns the evidence score of a fitted lattice: above 0 it may be a board."""

FIRST_BLUR = 1.0
"""Initial s of the first pass, px."""

FIRST_PASS = (8.0, 4, 0.02)
LAST_PASS = (18.0, 8, 0.01)
"""Radius of the windows in px, largest number of Gauss-Newton steps, and the step in px at which they end. The first
pass needs an accuracy of a few hundredths of a pixel only; after the last pass the remaining step is about 1e-4 px."""

REACHED = 0.25
"""If blur brings the edges of neighbouring lines into more than this share of a board's windows, all corners are fitted
once more, which takes a third more time; oblique squares or those at the rim alone do not require it."""

MORE_EVIDENCE = 5.5
"""Upper bound of the increase of the evidence score of lattices with small squares: by the second fit (measured: 0.13),
and by modelling the image beyond the outer squares together with it (0.53 for scores above -3.5; 1.8 at -4.4, 1.1
below); and by 4 for a size that is expected, or where markers prove a board. Of 173 such lattices in REAL images, some
of them blurred, boards have 3.7 and more; one sample of a board that is found as a whole anyway has -4.6."""


def refine(
    image: GreyImage,
    lattices: Sequence[Lattice],
    evidence_score: EvidenceScore = lambda _: np.inf,
    *,
    radius_px: float = LAST_PASS[0],
) -> list[RefinedLattice]:
    """Return `lattices` with their corners fitted by the edge model on the full-resolution grey `image`.

    Corners whose fit fails or that contradict their neighbours are dropped; corners in empty cells that the fit
    confirms are added. Lattices with small squares and a low `evidence_score` after one fit are not fitted further.
    Pixels further from a corner than `radius_px` are not used.
    """
    if not lattices:
        return []
    # All lattices are stacked, so that each step is one call.
    stack = LatticeStack.of(lattices)
    first = _first_pass(image, Lattice(stack.pixels, stack.contrast, True), stack.signs)
    start, holes = with_predicted_holes(first.lattice, stack.signs != 0.0)
    before, blur = first.of(start), _typical_blur(first, stack.parts)
    shape = fit_cells(start.pixels, start.known)
    gaps = shape.gaps()
    sheet = _Stacked(
        image=image,
        lattices=lattices,
        signs=stack.signs,
        parts=stack.parts,
        start=start,
        holes=holes,
        radius_px=radius_px,
    )
    reached = _reached_by_others(start.known, gaps, blur, stack.parts)
    out = list[RefinedLattice | None](None for _ in lattices)
    for close in (False, True):
        numbers = np.flatnonzero(reached == close).tolist()
        own = sheet.corners_of(numbers)[start.known]
        mine, lines, typical = before.without(~sheet.corners_of(numbers)), (shape.sides[own], gaps[own]), blur
        if close and numbers:
            # The exact position of neighbouring lines, whose edges extend into the windows, matters.
            windows = sheet.windows(mine, lines, blur, aslant=True)
            nearer, plausible = _nearer_pass(sheet, windows, numbers, evidence_score)
            for number in numbers:
                # Small lattices of background clutter are not fitted again: they would cost as much as the board.
                out[number] = sheet.cut(nearer, number)
            numbers, mine = plausible, nearer.without(~sheet.corners_of(plausible))
            typical = _typical_blur(mine, [stack.parts[k] for k in numbers])
            again = fit_cells(mine.lattice.pixels, mine.lattice.known)
            lines = again.sides, again.gaps()
        placed = sheet.placed(mine, lines, typical, numbers, aslant=close) if numbers else []
        for number, item in zip(numbers, placed, strict=True):
            out[number] = item
    return [item for item in out if item is not None]


def _typical_blur(item: RefinedLattice, parts: Sequence[Part]) -> FloatArray:
    """Return the blur (R, C) of each corner, clipped to a range around the median of its board."""
    blur = np.full(item.blur_px.shape, FIRST_BLUR)
    for part in parts:
        mine = item.blur_px[part]
        known = np.isfinite(mine)
        if known.any():
            typical = upper_median(mine[known])
            blur[part] = np.where(known, np.clip(mine, 0.7 * typical, 1.4 * typical), typical)
    return blur.clip(*BLUR_RANGE)


def _first_pass(image: GreyImage, start: Lattice, signs: FloatArray) -> RefinedLattice:
    """Return the first fit of all corners of the stack `start`, without those that fail."""
    known = start.known
    shape = fit_cells(start.pixels, known)
    radius_px, iterations, converged_px = FIRST_PASS
    fit = fit_edges(
        image,
        start.pixels[known],
        Geometry(shape.sides, shape.curvature(), shape.gaps(), ends_of(known, known)),
        signs[known],
        np.full(start.count, FIRST_BLUR),
        radius_px=radius_px,
        iterations=iterations,
        converged_px=converged_px,
        mirrored=False,
    )
    return _spread(start, fit, fit.sigma_px)


@dataclass(frozen=True, eq=False, slots=True)
class _Windows:
    """The windows around the N corners of a stack, before their last fit.

    Attributes
    ----------
    lattice, geometry : the corners (R, C), and their geometry (N,).
    curvature_sigma, blur : (N, 2) and (N,), as for `fit_edges`.
    radius_px : of the largest window.
    """

    lattice: Lattice
    geometry: Geometry
    curvature_sigma: FloatArray
    blur: FloatArray
    radius_px: float

    def fit(self, image: GreyImage, signs: FloatArray, which: BoolArray | slice, geometry: Geometry) -> EdgeFit:
        """Return the fit of the corners `which` (N,), with their `geometry`; `signs` (R, C)."""
        known = self.lattice.known
        return fit_edges(
            image,
            self.lattice.pixels[known][which],
            geometry,
            signs[known][which],
            self.blur[which],
            radius_px=self.radius_px,
            iterations=LAST_PASS[1],
            converged_px=LAST_PASS[2],
            curvature_sigma=self.curvature_sigma[which],
            contrast=self.lattice.contrast[known][which],
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Stacked:
    """Stacked lattices (`LatticeStack`), with the corners `start` of the first pass and predictions in `holes` (R,
    C)."""

    image: GreyImage
    lattices: Sequence[Lattice]
    signs: FloatArray
    parts: Sequence[Part]
    start: Lattice
    holes: BoolArray
    radius_px: float

    def corners_of(self, numbers: Sequence[int]) -> BoolArray:
        """Return which cells (R, C) belong to the lattices `numbers`."""
        out = np.zeros(self.holes.shape, np.bool_)
        for number in numbers:
            out[self.parts[number]] = True
        return out

    def cut(self, item: RefinedLattice, number: int) -> RefinedLattice:
        """Return lattice `number` of the stack `item`."""
        mine = item.cut(*self.parts[number])
        return mine.of(Lattice(mine.lattice.pixels, mine.lattice.contrast, self.lattices[number].rising))

    def windows(
        self, before: RefinedLattice, lines: tuple[FloatArray, FloatArray], blur: FloatArray, *, aslant: bool
    ) -> _Windows:
        """Return the windows around the corners of `before`, with `lines`: sides and gaps (N, 2, 2), and `blur` (R, C);
        `aslant` : with the tilts of neighbouring lines."""
        (sides, gaps), known = lines, before.lattice.known
        curvatures, loose = line_curvatures_to_fit(before.lattice.pixels, before.sigma_px, known, sides, self.radius_px)
        geometry = Geometry(sides, curvatures, gaps, ends_of(known, known))
        geometry = tilted(geometry, known) if aslant else geometry
        return _Windows(before.lattice, geometry, loose, blur[known], self.radius_px)

    def placed(
        self,
        before: RefinedLattice,
        lines: tuple[FloatArray, FloatArray],
        blur: FloatArray,
        numbers: Sequence[int],
        *,
        aslant: bool,
    ) -> list[RefinedLattice]:
        """Return the lattices `numbers` after the last fit, without corners that contradict the others; `before` has
        only their corners."""
        parts = [self.parts[k] for k in numbers]
        last, factors = _last_pass(self, self.windows(before, lines, blur, aslant=aslant), parts)
        if self.holes.any():
            last = without_unconfirmed_holes(last, self.start, self.holes)
        good = without_inconsistent(last, parts)
        # Sigmas are raised if corners scatter by more than the noise of the image explains (JPEG blocks, aliasing, wavy
        # paper).
        scatter = scatter_factors(good.lattice.pixels, good.sigma_px, parts)
        return [
            without_uncertain(replace(item, sigma_px=item.sigma_px * raised, scatter=raised, correlated=factor))
            for item, raised, factor in zip(
                [self.cut(good, k) for k in numbers], scatter.tolist(), factors.tolist(), strict=True
            )
        ]


def _beside_paper(
    sheet: _Stacked, windows: _Windows, fit: EdgeFit, mine: IntArray, wanted: BoolArray | None
) -> EdgeFit:
    """Return the `fit` of the corners in their `windows` after fitting those again whose windows extend beyond their
    boards, `mine` (N,).

    Otherwise the outermost corners of a blurred board are biased by tenths of a pixel, and with them the curvature of
    the lines. `wanted` (N,) as for `fitted_beside_paper`.
    """

    def fitted(which: BoolArray | slice, geometry: Geometry) -> EdgeFit:
        return windows.fit(sheet.image, sheet.signs, which, geometry)

    signs = sheet.signs[windows.lattice.known]
    return fitted_beside_paper(sheet.image, windows.geometry, fit, fitted, signs, mine, wanted)


def _nearer_pass(
    sheet: _Stacked, windows: _Windows, numbers: Sequence[int], evidence_score: EvidenceScore
) -> tuple[RefinedLattice, list[int]]:
    """Return the fit in the windows of the last pass, without corners that fail, and those of the lattices `numbers`
    with a sufficient `evidence_score`. Only for these the image beyond the boards is modelled."""
    fit = windows.fit(sheet.image, sheet.signs, slice(None), windows.geometry)
    nearer = _spread(windows.lattice, fit, fit.sigma_px)
    parts = ((k, nearer.cut(*sheet.parts[k])) for k in numbers)
    good = [k for k, mine in parts if mine.lattice.count > 0 and evidence_score(mine) > -MORE_EVIDENCE]
    if not good:
        return nearer, []
    known = windows.lattice.known
    mine = _owners(known, [sheet.parts[k] for k in numbers])
    after = _beside_paper(sheet, windows, fit, mine, sheet.corners_of(good)[known])
    return nearer if after is fit else _spread(windows.lattice, after, after.sigma_px), good


def _last_pass(sheet: _Stacked, windows: _Windows, parts: Sequence[Part]) -> tuple[RefinedLattice, FloatArray]:
    """Return the fit of all corners in their `windows`, without those that fail, and the factors (P,) of the sigmas of
    the `parts` due to correlated noise."""
    mine = _owners(windows.lattice.known, parts)
    fit = windows.fit(sheet.image, sheet.signs, slice(None), windows.geometry)
    fit, sides, radius_px = _beside_paper(sheet, windows, fit, mine, None), windows.geometry.sides, windows.radius_px
    good = fit.valid & (fit.contrast > 0.0)
    factors, uneven = board_factors(fit, good, sides, mine, len(parts), radius_px)
    return _spread(windows.lattice, fit, fit.sigma_px * factors[mine] * uneven), factors


def _owners(known: BoolArray, parts: Sequence[Part]) -> IntArray:
    """Return the indices (N,) of the `parts` that contain the N `known` corners of a stack."""
    owner = np.zeros(known.shape, np.int64)
    for k, part in enumerate(parts):
        owner[part] = k
    return owner[known]


def _reached_by_others(known: BoolArray, gaps: FloatArray, blur: FloatArray, parts: Sequence[Part]) -> BoolArray:
    """Return for which `parts` (P,) the `blur` (R, C) brings the edges of neighbouring lines into more than REACHED of
    the windows of the `known` corners (R, C). `gaps` (N, 2, 2) as in `Geometry`."""
    owner = _owners(known, parts)
    near = TAIL_SIGMAS * blur[known] > (1.0 - WINDOW_REACH) * gaps.reshape(-1, 4).min(axis=1, initial=np.inf)
    return np.bincount(owner, near, len(parts)) > REACHED * np.bincount(owner, minlength=len(parts))


def _spread(start: Lattice, fit: EdgeFit, sigma_px: FloatArray) -> RefinedLattice:
    """Return the stack `start` with its corners as fitted, without those that failed."""
    good = fit.valid & (fit.contrast > 0.0)
    cells, shape = start.known.reshape(-1).nonzero()[0], start.contrast.shape
    pixels, single = np.full((start.known.size, 2), np.nan), np.full((5, start.known.size), np.nan)
    fitted, values = fit.pixels, np.array([fit.contrast, sigma_px, fit.blur, fit.residual, fit.noise])
    if not good.all():
        cells, fitted, values = cells[good], fitted[good], values[:, good]
    pixels[cells] = fitted
    single[:, cells] = values
    contrast, *rest = single.reshape(-1, *shape)
    return RefinedLattice(Lattice(pixels.reshape(*shape, 2), contrast, start.rising), *rest)
