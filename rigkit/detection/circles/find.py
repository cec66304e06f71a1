"""The grid of circles of a lattice of blobs: the fit of circles, growth, and evidence."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.circles.blobs import Blobs, reduced
from rigkit.detection.circles.certainty import centre_sigmas
from rigkit.detection.circles.evidence import OCTAGONAL, GridEvidence, noise_levels
from rigkit.detection.circles.fit import ITERATIONS, PLAIN_ITERATIONS, CircleFit, edge_reach, fit_circles
from rigkit.detection.circles.grid import CircleGrid
from rigkit.detection.circles.local_map import (
    CORNER,
    PlaneMap,
    Radii,
    beside_each,
    local_maps,
    steps,
    with_smooth_curvatures,
)
from rigkit.detection.circles.rows import joined, rows_of, with_rows
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_model import TAIL_SIGMAS

if TYPE_CHECKING:
    from rigkit.detection.circles.lattices import LabelledBlobs

FIRST_EDGE_BLUR = 0.8
FINE_BLUR_PX = 1.25
"""Blur, in px of a reduced image, above which a finer one adds hardly any information: its pixels sharpen edges by 2 %
and with them centres by 1 %."""
MIN_SIDE = 3
"""Smallest number of rows and columns: smaller lattices are too often no grids."""
MIN_CIRCLES = MIN_SIDE**2
FIRST_SIGMA_PX = 0.1
"""Standard deviation of the centroids of blobs."""
MAX_CIRCLE_GROWTH = 0.25
"""Largest relative difference of a circle's size and slant from the predictions by its neighbours."""
OFF_PLACE = 0.12
"""Largest distance of a circle from its prediction by its neighbours, in distances of neighbours."""
MIN_CIRCLE_CONTRAST, MAX_CIRCLE_CONTRAST = 0.35, 2.5
"""Range of a circle's contrast relative to the typical one of the grid, or of its share of the brightness, which a
shadow does not change: an object outside of both ranges is no circle of the grid."""
MAX_CIRCLE_RESIDUAL = 3.0
"""Largest ratio of residual to contrast relative to the typical one: a circle above it is partly covered."""
MIN_TYPICAL_CIRCLE = 0.03
"""Lower limit of the typical ratio of residual to contrast."""
SUPPORT = 5
"""Smallest number of neighbours that predict a circle without a blob."""
MAX_GAIN = 10.0
"""Largest standard deviation of a place predicted by circles of standard deviation 1: a corner of the grid, predicted
from one side, has five."""
SURE_GAIN = 1.5
"""The same for circles in the middle of others, which show whether a lattice is a smooth image of a plane."""
BLUR_ROUNDS = 3
"""Largest number of rounds with the neighbours' light. The second has their centres and sizes from the first, which
removes errors of up to 0.1 px (RENDERED, hexagonal, blur 3 px). The third, if the anisotropy of the blur changed, has
it from the residuals of the second, and has circles that the neighbours' light had hidden."""
MIXED_ROUNDS = 2
"""Rounds for circles always fitted with neighbours' light; each has sizes and anisotropy from the last one."""
FIRST_TOLERANCE = 2.0
"""Factor of the limits in the first fit: maps from the centroids of blobs are inaccurate at the rim of a grid."""
MIN_UNEVEN, MAX_UNEVEN = 0.1, 0.9
"""Smallest applied change and largest value of the blur's anisotropy, relative to its variance. Smaller changes do not
move centres (REAL, hexagonal: within 0.0003 px); the largest is a blur four times as wide one way as across."""
MAX_NEW_RINGS = 40
"""Largest number of rings of circles by which a grid grows: around a centre, circles are neighbours without end."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Draft:
    """A grid that is being extended and fitted."""

    label: IntArray
    fit: CircleFit
    around: PlaneMap
    radius: Radii
    hexagonal: bool
    bright: bool
    uneven_px2: FloatArray = field(default_factory=lambda: np.zeros(2))
    mixed: bool = False

    @property
    def corner(self) -> float:
        """Return the radius of a circle's own pixels, in half distances to its neighbours."""
        return CORNER[self.hexagonal] if self.mixed else 1.0

    def chosen(self, which: BoolArray) -> _Draft:
        return replace(self, label=self.label[which], fit=rows_of(self.fit, which), around=rows_of(self.around, which))

    def enlarged(self, scale: int) -> _Draft:
        """Return the draft in an image that is `scale` times as large."""
        fit, around = self.fit.enlarged(scale), self.around.enlarged(scale)
        return replace(self, fit=fit, around=around, uneven_px2=scale**2 * self.uneven_px2)


def grid_of(grey: GreyImage, blobs: Blobs, found: LabelledBlobs, *, quick: bool = False) -> CircleGrid | None:
    """Return the grid of the `blobs` of a lattice, or None. Large circles are found in a smaller image."""
    scale = blobs.reduction()
    small, own = reduced(grey, scale), blobs.reduced(scale)
    draft = _first(small, own, found, brief=not quick)
    if not quick:
        draft, scale = _in_finer_images(grey, draft, scale)
        if not _enough(draft):
            draft = _first(small, own, found, beside=True).enlarged(blobs.reduction())
            draft, scale = _mixed(grey, draft), 1
    if not _enough(draft):
        return None
    evidence = _evidence(reduced(grey, scale), draft)
    # Sizes of much blurred circles are not yet those of the image itself.
    for _ in range(0 if quick or draft.mixed or blobs.reduction() == 1 else 1 if scale == 1 else 2):
        if evidence.convincing:
            break
        again = _again(grey, draft.enlarged(scale))
        if not _enough(again):
            break
        draft, evidence, scale = again, _evidence(grey, again), 1
    if evidence.may_convince and not quick:
        draft = _through_its_blur(reduced(grey, scale), draft)
        later = None if evidence.convincing else _evidence(reduced(grey, scale), draft)
        evidence = later if later and later.convinces_late else evidence
    return _finished(draft.enlarged(scale), evidence, (grey.shape[1], grey.shape[0]))


def _in_finer_images(grey: GreyImage, draft: _Draft, scale: int) -> tuple[_Draft, int]:
    """Return the draft of an image reduced by `scale`, extended, and fitted in one reduced by less, and the last scale.

    Each fit has its maps from the last centres; with those of a much smaller image, slants scatter by up to five times
    as much (RENDERED, circles of 200 px), and with them the stated sigmas.
    """
    for step in (_again, _with_all):
        if _enough(draft):
            draft = step(reduced(grey, scale), draft, brief=True)
    while _enough(draft):
        last = scale == 1 or bool(np.median(draft.fit.blur_px) > FINE_BLUR_PX)
        finer = scale if last else scale // 2
        last = last or finer == 1
        draft = _again(reduced(grey, finer), draft.enlarged(scale // finer), brief=not last)
        scale = finer
        if last:
            break
    return draft, scale


def _first(grey: GreyImage, own: Blobs, found: LabelledBlobs, *, beside: bool = False, brief: bool = False) -> _Draft:
    """Return the circles of blobs; `beside`: fitted with the light of neighbours; `brief`: for a further fit."""
    label, hexagonal = found.label, found.hexagonal
    around = local_maps(label, own.pixels, label, hexagonal=hexagonal, sigma_px=FIRST_SIGMA_PX)
    radius = Radii.of(own.shape, around)
    others, corner = (beside_each(label, hexagonal), CORNER[hexagonal]) if beside else (None, 1.0)
    blur = np.full(len(own), FIRST_EDGE_BLUR)
    fit = _fitted(grey, own.pixels, around, radius, corner, blur, np.zeros(2), others, brief=brief)
    bright = bool(own.sign[0] > 0)
    draft = _Draft(label=label, fit=fit, around=around, radius=radius, hexagonal=hexagonal, bright=bright, mixed=beside)
    return _tested(draft, FIRST_TOLERANCE)


def _mixed(grey: GreyImage, draft: _Draft) -> _Draft:
    """Return the draft of circles that cannot be fitted without their neighbours' light, because of blur or motion."""
    for _ in range(MIXED_ROUNDS):
        if _enough(draft):
            draft = _again(grey, replace(draft, uneven_px2=_uneven(draft)), beside=True)
    return draft


def _with_all(grey: GreyImage, draft: _Draft, *, beside: bool = False, brief: bool = False) -> _Draft:
    """Return the draft extended by rings of circles without blobs; `beside`, `brief`: as in `_first`."""
    for _ in range(MAX_NEW_RINGS):
        grown = _larger(grey, draft, beside=beside, brief=brief) if _enough(draft) else None
        if grown is None:
            break
        draft = grown
    return draft


def is_large_enough(label: IntArray) -> bool:
    """Return whether there are MIN_CIRCLES, in at least MIN_SIDE rows and columns."""
    return len(label) >= MIN_CIRCLES and bool((np.ptp(label, axis=0) >= MIN_SIDE - 1).all())


def _enough(draft: _Draft) -> bool:
    return is_large_enough(draft.label)


def _fitted(
    grey: GreyImage,
    pixels: FloatArray,
    around: PlaneMap,
    radius: Radii,
    corner: float,
    blur_px: FloatArray,
    uneven_px2: FloatArray,
    beside: IntArray | None = None,
    only: BoolArray | None = None,
    *,
    iterations: int = ITERATIONS,
    brief: bool = False,
) -> CircleFit:
    """Return the fitted circles; those that are not among `only` are only used as neighbours of the others."""
    maps = radius.seen * around.first
    reach = edge_reach(maps, 0.5 / radius.seen, blur_px, around.surrounded, corner)
    reach = reach if only is None else np.where(only, reach, 0.0)
    at = (pixels, maps, radius.printed**2 * around.second, blur_px, reach, beside, uneven_px2)
    return fit_circles(grey, *at, iterations=iterations, brief=brief)


def like_contrast(fit: CircleFit, contrast: float, share: float) -> BoolArray:
    """Return which circles (N,) have about the typical `contrast`, or the typical `share` of the brightness."""
    parts = np.stack([np.abs(fit.contrast) / contrast, fit.share / share])
    return np.asarray(((parts > MIN_CIRCLE_CONTRAST) & (parts < MAX_CIRCLE_CONTRAST)).any(axis=0))


def _sigma(fit: CircleFit) -> float:
    return float(np.median(fit.sigma_px)) if len(fit.sigma_px) else FIRST_SIGMA_PX


def _tested(draft: _Draft, tolerance: float = 1.0) -> _Draft:
    """Return the draft without false circles; `tolerance`: factor of the limits of shape and residual."""
    fit = draft.fit
    good = fit.valid & ((fit.contrast > 0.0) == draft.bright)
    good &= (np.abs(_own_growth(fit, good)) < tolerance * MAX_CIRCLE_GROWTH).all(axis=1)
    if good.sum() < MIN_CIRCLES:
        return draft.chosen(good)
    contrast = np.abs(fit.contrast)
    relative = fit.residual / np.maximum(contrast, 1e-9)
    typical = max(float(np.median(relative[good])), MIN_TYPICAL_CIRCLE)
    good &= like_contrast(fit, float(np.median(contrast[good])), float(np.median(fit.share[good])))
    good &= relative < tolerance * MAX_CIRCLE_RESIDUAL * typical
    if good.sum() < MIN_CIRCLES:
        return draft.chosen(good)
    expected = local_maps(
        draft.label[good],
        fit.pixels[good],
        draft.label,
        hexagonal=draft.hexagonal,
        sigma_px=_sigma(rows_of(fit, good)),
        leave_out=True,
    )
    off = np.linalg.norm(fit.pixels - expected.pixels, axis=1) / _spacing(expected)
    good &= (off < OFF_PLACE) | (expected.gain > MAX_GAIN)
    return draft.chosen(good)


def _own_growth(fit: CircleFit, good: BoolArray) -> FloatArray:
    """Return the growth (N, 3) of circles minus the median growth of size of the `good` ones: fitted without their
    neighbours' light, all circles seem smaller than they are."""
    common = float(np.median(fit.growth[good, 0])) if good.any() else 0.0
    return np.asarray(fit.growth - np.array([common, 0.0, 0.0]))


def _spacing(around: PlaneMap) -> FloatArray:
    """Return the distances (M,) of neighbours, px, averaged over directions."""
    return np.asarray(np.sqrt(np.maximum(np.abs(np.linalg.det(around.first)), 1e-9)))


def _again(grey: GreyImage, draft: _Draft, *, beside: bool = False, brief: bool = False) -> _Draft:
    """Return the draft fitted with maps through its current circles; `beside`, `brief`: as in `_first`."""
    fit = draft.fit
    around = local_maps(draft.label, fit.pixels, draft.label, hexagonal=draft.hexagonal, sigma_px=_sigma(fit))
    size_px = (grey.shape[1], grey.shape[0])
    around = with_smooth_curvatures(around, draft.label, fit.pixels, size_px, hexagonal=draft.hexagonal)
    radius = Radii.of(fit.maps, around, moved=bool(draft.uneven_px2.any()))
    others = beside_each(draft.label, draft.hexagonal) if beside else None
    at = (grey, fit.pixels, around, radius, draft.corner, fit.blur_px, draft.uneven_px2, others)
    fresh = _fitted(*at, brief=brief)
    return _tested(replace(draft, fit=fresh, around=around, radius=radius))


def _uneven(draft: _Draft) -> FloatArray:
    """Return the anisotropy (2,) of the blur of all circles, px^2, from their residuals.

    A small one cannot be separated from the slant for a single circle, but for all circles of a plane it can.
    """
    first, second, *normal = draft.fit.uneven.sum(axis=0)
    more = np.linalg.solve(
        np.array([[normal[0], normal[1]], [normal[1], normal[2]]]) + 1e-12 * np.eye(2), [first, second]
    )
    uneven = draft.uneven_px2 + more
    most = MAX_UNEVEN * float(np.median(draft.fit.blur_px)) ** 2
    return np.asarray(uneven * min(1.0, most / max(float(np.linalg.norm(uneven)), 1e-12)))


def _through_its_blur(grey: GreyImage, draft: _Draft) -> _Draft:
    """Return the draft fitted with the light of neighbours and the anisotropy of the blur, if they matter; and with
    circles that are found only so.

    It is used for grids, and what may be one, only: large circles with much blur overlap to a pattern like a
    chessboard.
    """
    grown = False
    for done in range(BLUR_ROUNDS):
        half_gap_px = (0.5 / draft.radius.seen - 1.0) * np.sqrt(np.abs(np.linalg.det(draft.fit.maps)))
        beside = bool((half_gap_px < TAIL_SIGMAS * draft.fit.blur_px).any())
        uneven = _uneven(draft)
        change = float(np.linalg.norm(uneven - draft.uneven_px2))
        settled = change < MIN_UNEVEN * float(np.median(draft.fit.blur_px)) ** 2
        if settled and not grown and (not beside or done == BLUR_ROUNDS - 1):
            break
        fitted = _again(grey, replace(draft, uneven_px2=uneven), beside=beside)
        if not _enough(fitted):
            break
        draft = _with_all(grey, fitted, beside=beside) if done else fitted
        grown = len(draft.label) > len(fitted.label)
    return draft


def _larger(grey: GreyImage, draft: _Draft, *, beside: bool, brief: bool) -> _Draft | None:
    """Return the draft with circles found beside its own, or None if there are none."""
    fit = draft.fit
    places, around = _beside(draft, (grey.shape[1], grey.shape[0]))
    if not len(places):
        return None
    tried = _tried(grey, draft, places, around, beside=beside, brief=brief)
    near = np.linalg.norm(tried.pixels - around.pixels, axis=1) < OFF_PLACE * _spacing(around)
    if not near.any():
        return None
    grown = replace(
        draft,
        label=np.concatenate([draft.label, places[near]]),
        fit=joined(fit, rows_of(tried, near)),
        around=joined(draft.around, rows_of(around, near)),
    )
    tested = _tested(grown)
    return tested if len(tested.label) > len(draft.label) else None


def _tried(
    grey: GreyImage, draft: _Draft, places: IntArray, around: PlaneMap, *, beside: bool, brief: bool
) -> CircleFit:
    """Return the circles fitted at places beside those of the draft."""
    typical, known = draft.fit, len(draft.label) if beside else 0
    pixels, blur, every, others = around.pixels, np.full(len(places), float(np.median(typical.blur_px))), around, None
    if beside:
        others = beside_each(np.concatenate([draft.label, places]), draft.hexagonal)
        pixels, blur = np.concatenate([typical.pixels, pixels]), np.concatenate([typical.blur_px, blur])
        every = joined(draft.around, around)
    at = (grey, pixels, every, draft.radius, draft.corner, blur, draft.uneven_px2, others)
    only = np.arange(len(pixels)) >= known
    fit = _fitted(*at, only, iterations=PLAIN_ITERATIONS, brief=brief)
    # Where there is no circle, a fit would use all its steps.
    near = np.linalg.norm(fit.pixels - pixels, axis=1) < OFF_PLACE * _spacing(every)
    parts = [np.abs(fit.contrast) / np.median(np.abs(typical.contrast)), fit.share / np.median(typical.share)]
    unsettled = only & ~fit.valid & near & (np.maximum(*parts) > MIN_CIRCLE_CONTRAST)
    if unsettled.any():
        fit = with_rows(fit, unsettled, _fitted(*at, unsettled, brief=brief))
    return rows_of(fit, only)


def _beside(draft: _Draft, size_px: tuple[int, int]) -> tuple[IntArray, PlaneMap]:
    """Return the places next to circles of the draft where a circle would be inside the image, and the maps there."""
    step = steps(draft.hexagonal)
    known = {tuple(label) for label in draft.label.tolist()}
    beside = {tuple(place) for place in (draft.label[:, None] + step).reshape(-1, 2).tolist()}
    places = np.array(sorted(beside - known), np.int64).reshape(-1, 2)
    around = local_maps(draft.label, draft.fit.pixels, places, hexagonal=draft.hexagonal, sigma_px=_sigma(draft.fit))
    extent = draft.radius.seen * np.sqrt((around.first**2).sum(axis=2))
    inside = ((around.pixels > extent) & (around.pixels < np.array(size_px) - 1.0 - extent)).all(axis=1)
    fine = inside & (around.support >= SUPPORT) & (around.gain < MAX_GAIN) & (extent.min(axis=1) > 1.0)
    return places[fine], rows_of(around, fine)


def _evidence(grey: GreyImage, draft: _Draft) -> GridEvidence:
    fit, label = draft.fit, draft.label
    expected = local_maps(label, fit.pixels, label, hexagonal=draft.hexagonal, sigma_px=_sigma(fit), leave_out=True)
    off = np.linalg.norm(fit.pixels - expected.pixels, axis=1) / _spacing(expected)
    sure = expected.gain < SURE_GAIN
    beyond_noise = np.maximum(fit.residual**2 - noise_levels(grey, fit) ** 2, 0.0) / fit.contrast**2
    return GridEvidence(
        unexplained=float(np.sqrt(np.median(beyond_noise))),
        misshapen=float(np.median(np.sqrt((fit.growth**2).sum(axis=1)))),
        displaced=float(np.median(off[sure])) if sure.any() else np.inf,
        corners=float((np.hypot(*fit.harmonics.mean(axis=0).T) * [1, 1, 1, 1, OCTAGONAL, OCTAGONAL]).max()),
    )


def _finished(draft: _Draft, evidence: GridEvidence, size_px: tuple[int, int]) -> CircleGrid:
    fit, label = draft.fit, draft.label
    empty, _ = _beside(draft, size_px)
    first = label.min(axis=0)
    label, empty = label - first, empty - first
    order = np.lexsort(label.T)
    return CircleGrid(
        label=label[order],
        pixels=fit.pixels[order],
        sigma_px=centre_sigmas(fit, label, draft.around.slope_gain, draft.radius.seen)[order],
        maps=fit.maps[order],
        hexagonal=draft.hexagonal,
        bright=draft.bright,
        radius=draft.radius.printed,
        blur_px=float(np.median(fit.blur_px)),
        contrast=float(np.median(np.abs(fit.contrast))),
        share=float(np.median(fit.share)),
        uneven_px2=draft.uneven_px2,
        empty=empty,
        evidence=evidence,
    )
