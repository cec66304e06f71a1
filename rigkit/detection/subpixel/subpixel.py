"""Corners of whole lattices to a hundredth of a pixel: the edge model at every corner, guided by the lattice.

The lattice says which way the lines run, how far the cell reaches, and how the lines bend; the fit says where the
corners are, and so gives a better lattice for a second pass, which also tries the cells that were left empty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, upper_median
from rigkit.detection.lattice.lattice import Lattice, LatticeStack
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.consistent import checked, confirmed, with_holes
from rigkit.detection.subpixel.correlation import board_factors
from rigkit.detection.subpixel.edge_curvature import line_curvatures_to_fit
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, EdgeFit, fit_edges
from rigkit.detection.subpixel.edge_model import TAIL_SIGMAS, WINDOW_REACH, Geometry, ends_of, tilted
from rigkit.detection.subpixel.outer_squares import fitted_beside_paper
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import scatter_factors

Part = tuple[slice, slice]
EvidenceScore = Callable[[RefinedLattice, Sequence[tuple[Lattice, RefinedLattice]]], float]
"""How much of the evidence that a lattice is a board one fit of it shows, beside others that are placed (as they were
found, and as they are): above 0 it may be one."""

FIRST_BLUR = 1.0
"""s that the first pass starts from, px."""

FIRST_PASS = (8.0, 4, 0.02)
LAST_PASS = (18.0, 8, 0.01)
"""Radius in px, Gauss-Newton steps at most, and the step in px that ends them: the first pass only has to bring the
lattice to a few hundredths of a pixel; after the last step of the last one there is a ten-thousandth to go."""

REACHED = 0.25
"""Of the corners of a board: where blur brings the edges of neighbouring lines into so many windows, all are fitted
once more. Squares at a slant, or at the rim, do not make a sharp image slower by a third."""

MORE_EVIDENCE, BESIDE_PAPER = 0.5, 1.5
"""Of lattices with small squares: the second fit adds no more to their promise than the first number (measured: 0.13),
and what lies beyond their outer squares and the second fit together no more than the second (0.53 where the promise is
above -3.5; 1.8 at -4.4, 1.1 below). Of 173 such lattices in real images, some of them blurred, boards have 3.7 and
more; one sample of a board that is found whole besides has -4.6."""


def refine(
    image: GreyImage,
    lattices: Sequence[Lattice],
    evidence_score: EvidenceScore = lambda *_: np.inf,
    *,
    radius_px: float = LAST_PASS[0],
) -> list[RefinedLattice]:
    """Return `lattices` with their corners placed by the edge model on the full-resolution grey `image`.

    Corners whose fit fails or that contradict their neighbours are dropped; corners in empty cells that the fit
    confirms are added. Lattices with small squares that the `evidence_score` of one fit is too bad of are left as
    that has them. Pixels further from a corner than `radius_px` are not used.
    """
    if not lattices:
        return []
    # All lattices lie on one sheet, so that each step is one call.
    stack = LatticeStack.of(lattices)
    first = _first_pass(image, Lattice(stack.pixels, stack.contrast, True), stack.signs)
    start, holes = with_holes(first.lattice, stack.signs != 0.0)
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
    unreached = np.flatnonzero(~reached).tolist()
    if len(unreached) == len(lattices):
        return sheet.placed(before, (shape.sides, gaps), blur, unreached, aslant=False)
    out = list[RefinedLattice | None](None for _ in lattices)
    if unreached:
        mine = sheet.corners_of(unreached)
        own = mine[start.known]
        settled = sheet.placed(before.without(~mine), (shape.sides[own], gaps[own]), blur, unreached, aslant=False)
        for number, item in zip(unreached, settled, strict=True):
            out[number] = item
    # Of the others it matters where exactly the neighbouring lines are, whose edges reach into the windows.
    close = np.flatnonzero(reached).tolist()
    theirs = sheet.corners_of(close)
    their = theirs[start.known]
    windows = sheet.windows(before.without(~theirs), (shape.sides[their], gaps[their]), blur, aslant=True)
    placed = [(lattices[k], item) for k, item in enumerate(out) if item is not None]
    nearer, plausible = _nearer_pass(sheet, windows, close, lambda item: evidence_score(item, placed))
    for number in close:
        # Clutter in the background is small, and would cost as much as the board.
        out[number] = sheet.cut(nearer, number)
    if plausible:
        before = nearer.without(~sheet.corners_of(plausible))
        blur = _typical_blur(before, [stack.parts[k] for k in plausible])
        shape = fit_cells(before.lattice.pixels, before.lattice.known)
        again = sheet.placed(before, (shape.sides, shape.gaps()), blur, plausible, aslant=True)
        for number, item in zip(plausible, again, strict=True):
            out[number] = item
    return [item for item in out if item is not None]


def _typical_blur(item: RefinedLattice, parts: Sequence[Part]) -> FloatArray:
    """Return (R, C) the blur of each corner, kept near what is typical of its board."""
    blur = np.full(item.blur_px.shape, FIRST_BLUR)
    for part in parts:
        mine = item.blur_px[part]
        known = np.isfinite(mine)
        if known.any():
            typical = upper_median(mine[known])
            blur[part] = np.where(known, np.clip(mine, 0.7 * typical, 1.4 * typical), typical)
    return blur.clip(*BLUR_RANGE)


def _first_pass(image: GreyImage, start: Lattice, signs: FloatArray) -> RefinedLattice:
    """Fit all corners of the sheet `start`, known to about a tenth of a pixel; those that fail are left out."""
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
    """The windows around the corners of a sheet, N of them, and what is known of these before their last fit.

    Attributes
    ----------
    lattice, geometry : where the corners are, (R, C), and what the lattice says of them, (N,).
    curvature_sigma, blur : (N, 2) and (N,), as of `fit_edges`.
    radius_px : of the largest window.
    """

    lattice: Lattice
    geometry: Geometry
    curvature_sigma: FloatArray
    blur: FloatArray
    radius_px: float

    @classmethod
    def of(
        cls,
        start: RefinedLattice,
        sides: FloatArray,
        gaps: FloatArray,
        blur: FloatArray,
        radius_px: float,
        *,
        aslant: bool,
    ) -> _Windows:
        """Return those of the corners of `start`, with `sides` and `gaps` (N, 2, 2), and `blur` (R, C); `aslant` where
        it matters how neighbouring lines are turned."""
        known, pixels = start.lattice.known, start.lattice.pixels
        curvatures, curvature_sigma = line_curvatures_to_fit(pixels, start.sigma_px, known, sides, radius_px)
        geometry = Geometry(sides, curvatures, gaps, ends_of(known, known))
        geometry = tilted(geometry, known) if aslant else geometry
        return cls(start.lattice, geometry, curvature_sigma, blur[known], radius_px)

    def fit(
        self, image: GreyImage, signs: FloatArray, which: BoolArray | slice, geometry: Geometry, stop: tuple[int, float]
    ) -> EdgeFit:
        """Return the fit of the corners `which` (N,), with `geometry` instead of their own; `signs` (R, C).
        `stop`: after so many steps, or one so short, px."""
        known = self.lattice.known
        return fit_edges(
            image,
            self.lattice.pixels[known][which],
            geometry,
            signs[known][which],
            self.blur[which],
            radius_px=self.radius_px,
            iterations=stop[0],
            converged_px=stop[1],
            curvature_sigma=self.curvature_sigma[which],
            contrast=self.lattice.contrast[known][which],
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Stacked:
    """Lattices on one sheet (`LatticeStack`), with their corners where the first pass has them, `start`, and where
    `holes` in them (R, C) are foretold."""

    image: GreyImage
    lattices: Sequence[Lattice]
    signs: FloatArray
    parts: Sequence[Part]
    start: Lattice
    holes: BoolArray
    radius_px: float

    def corners_of(self, numbers: Sequence[int]) -> BoolArray:
        """Return which cells (R, C) are of the lattices of such numbers."""
        out = np.zeros(self.holes.shape, np.bool_)
        for number in numbers:
            out[self.parts[number]] = True
        return out

    def cut(self, item: RefinedLattice, number: int) -> RefinedLattice:
        """Return the lattice of that number of the whole sheet `item`."""
        mine = item.cut(*self.parts[number])
        return mine.of(Lattice(mine.lattice.pixels, mine.lattice.contrast, self.lattices[number].rising))

    def windows(
        self, before: RefinedLattice, lines: tuple[FloatArray, FloatArray], blur: FloatArray, *, aslant: bool
    ) -> _Windows:
        """Return the windows around the corners of `before`, `lines` as `_Windows.of` has them: sides and gaps."""
        return _Windows.of(before, *lines, blur, self.radius_px, aslant=aslant)

    def placed(
        self,
        before: RefinedLattice,
        lines: tuple[FloatArray, FloatArray],
        blur: FloatArray,
        numbers: Sequence[int],
        *,
        aslant: bool,
    ) -> list[RefinedLattice]:
        """Return the lattices of such `numbers`, whose corners alone are in `before`, with these fitted for the last
        time, without those that contradict the others."""
        parts = [self.parts[k] for k in numbers]
        last, factors = _last_pass(self, self.windows(before, lines, blur, aslant=aslant), parts)
        if self.holes.any():
            last = confirmed(last, self.start, self.holes)
        good = checked(last, parts)
        # Where corners scatter about the lattice by more than the noise in the image explains (JPEG blocks, aliasing,
        # wavy paper), the sigmas of the board are raised to what is seen.
        scatter = scatter_factors(good.lattice.pixels, good.sigma_px, parts)
        return [
            replace(item, sigma_px=item.sigma_px * raised, scatter=raised, correlated=factor)
            for item, raised, factor in zip(
                [self.cut(good, k) for k in numbers], scatter.tolist(), factors.tolist(), strict=True
            )
        ]


def _beside_paper(
    sheet: _Stacked, windows: _Windows, fit: EdgeFit, mine: IntArray, wanted: BoolArray | None
) -> EdgeFit:
    """Return the `fit` of the corners in their `windows` with those fitted again that see what lies beyond the boards,
    `mine` (N,), that they are of. Without it the outermost corners of a blurred board move by tenths of a pixel, and
    with them the lines through the others. `wanted` (N,) as of `fitted_beside_paper`."""

    def fitted(which: BoolArray | slice, geometry: Geometry) -> EdgeFit:
        return windows.fit(sheet.image, sheet.signs, which, geometry, LAST_PASS[1:])

    signs = sheet.signs[windows.lattice.known]
    return fitted_beside_paper(sheet.image, windows.geometry, fit, fitted, signs, mine, wanted)


def _nearer_pass(
    sheet: _Stacked, windows: _Windows, numbers: Sequence[int], evidence_score: Callable[[RefinedLattice], float]
) -> tuple[RefinedLattice, list[int]]:
    """Return where the corners are, in the windows of the last pass, and the numbers of the lattices (of `numbers`)
    with a good `evidence_score`; corners that fail are left out. Only beside these it is asked what lies beyond."""

    def plausible(item: RefinedLattice, numbers: Sequence[int], more: float) -> list[int]:
        parts = ((k, item.cut(*sheet.parts[k])) for k in numbers)
        return [k for k, mine in parts if mine.lattice.count > 0 and evidence_score(mine) > -more]

    fit = windows.fit(sheet.image, sheet.signs, slice(None), windows.geometry, LAST_PASS[1:])
    nearer = _spread(windows.lattice, fit, fit.sigma_px)
    good = plausible(nearer, numbers, BESIDE_PAPER)
    if not good:
        return nearer, []
    known = windows.lattice.known
    mine = _owners(known, [sheet.parts[k] for k in numbers])
    after = _beside_paper(sheet, windows, fit, mine, sheet.corners_of(good)[known])
    nearer = nearer if after is fit else _spread(windows.lattice, after, after.sigma_px)
    return nearer, plausible(nearer, good, MORE_EVIDENCE)


def _last_pass(sheet: _Stacked, windows: _Windows, parts: Sequence[Part]) -> tuple[RefinedLattice, FloatArray]:
    """Fit all corners in their `windows`; those that fail are left out. Say (P,) how correlated noise raises sigmas.

    Noise is told from other residuals, and how that of neighbouring pixels is correlated on each of the `parts`.
    """
    mine = _owners(windows.lattice.known, parts)
    fit = windows.fit(sheet.image, sheet.signs, slice(None), windows.geometry, LAST_PASS[1:])
    fit, sides, radius_px = _beside_paper(sheet, windows, fit, mine, None), windows.geometry.sides, windows.radius_px
    good = fit.valid & (fit.contrast > 0.0)
    factors, uneven = board_factors(fit, good, sides, mine, len(parts), radius_px)
    return _spread(windows.lattice, fit, fit.sigma_px * factors[mine] * uneven), factors


def _owners(known: BoolArray, parts: Sequence[Part]) -> IntArray:
    """Return the numbers (N,) of the `parts` that the N `known` corners of a sheet are in."""
    owner = np.zeros(known.shape, np.int64)
    for k, part in enumerate(parts):
        owner[part] = k
    return owner[known]


def _reached_by_others(known: BoolArray, gaps: FloatArray, blur: FloatArray, parts: Sequence[Part]) -> BoolArray:
    """Return (P,) of which boards, the `known` corners of the `parts` of a sheet (R, C), blur (R, C) brings the edges
    of neighbouring lines into REACHED windows. `gaps` (N, 2, 2) as of `Geometry`."""
    owner = _owners(known, parts)
    near = TAIL_SIGMAS * blur[known] > (1.0 - WINDOW_REACH) * gaps.reshape(-1, 4).min(axis=1, initial=np.inf)
    return np.bincount(owner, near, len(parts)) > REACHED * np.bincount(owner, minlength=len(parts))


def _spread(start: Lattice, fit: EdgeFit, sigma_px: FloatArray) -> RefinedLattice:
    """Return the sheet `start` with its corners as fitted, without those that failed."""
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
