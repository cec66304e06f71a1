"""Search for chessboards of unknown number and size: loose corners, links, lattices, growth, sub-pixel fit,
evidence."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import known_median
from rigkit.detection.checks.border import squares_end
from rigkit.detection.checks.discontinuity import may_be_discontinuous, split_at_discontinuities, without_outliers
from rigkit.detection.checks.evidence import MIN_EXPECTED_CORNERS, OF_EXPECTED_SIZE, OF_WHOLE, Evidence
from rigkit.detection.checks.validate import (
    exceeds_known_sizes,
    has_bowed_edges,
    has_edge_offset,
    is_board,
    is_compact,
    is_large_enough,
    part_of_known_size,
    sample_of,
    without_shared_corners,
    without_stray_rows,
)
from rigkit.detection.lattice.grow import MAX_FAILED_GROWTHS, grow_all
from rigkit.detection.lattice.lattice import MANY_CORNERS, MIN_ROWS, Lattice, build_lattices
from rigkit.detection.lattice.links import find_links
from rigkit.detection.lattice.split import join_parts, split_at_turns, split_necks
from rigkit.detection.new_corners import is_mostly, new_corners, with_better
from rigkit.detection.saddles.response import GreyImage, Level, grey_image
from rigkit.detection.saddles.saddle import Corners
from rigkit.detection.searched_image import SearchedImage
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import small_scatter
from rigkit.detection.subpixel.subpixel import refine
from rigkit.detection.subpixel.uniform_blur import LOOKED_AT_PX, with_uniform_blur
from rigkit.detection.subpixel.whole_board import placed_together

IsPlausible = Callable[[GreyImage, Level, Lattice], bool]

MIN_PART_CORNERS = 6
"""Corners of the smallest part of a partly covered board."""

MIN_BOARD_CORNERS = MIN_ROWS**2

MarkerTest = Callable[[GreyImage, Lattice], bool]
"""Returns whether markers in the squares of a lattice prove that it is a board."""

SMEARED_CORNERS = 12
"""Smallest number of corners with motion blur for which an image without a board is searched again with them."""


@dataclass(frozen=True, slots=True)
class BoardCriteria:
    """What a lattice must fulfil to be a board.

    Attributes
    ----------
    min_corners : smallest number of corners.
    sizes : (columns, rows) of all possible boards, if known.
    has_markers : the test that proves a lattice to be one of them.
    """

    min_corners: int
    sizes: Sequence[tuple[int, int]] = ()
    has_markers: MarkerTest | None = None


def find_lattices(
    image: NDArray[np.generic],
    min_corners: int,
    sizes: Sequence[tuple[int, int]] = (),
    *,
    has_markers: MarkerTest | None = None,
    searched: SearchedImage | None = None,
) -> list[RefinedLattice]:
    """Return the refined lattices of all boards in `image`, in arbitrary order and orientation.

    `sizes` : (columns, rows) of all possible boards, if known.
    `has_markers` : for boards with markers in their squares, which affect edges and fit. Lattices with edge offsets
    (`has_edge_offset`) are then not rejected, and those for which it is true are accepted regardless of their evidence
    and shape.
    `searched` : the corners of `image`, if they are known, or those at twice the resolution.
    """
    grey = grey_image(image)
    size_px = (grey.shape[1], grey.shape[0])
    searched = searched or SearchedImage.of(grey)
    plausible = _RejectionCounter(_is_plausible if has_markers is None else _plausible_or_marked(has_markers))
    search = _Search(searched, grey, BoardCriteria(min_corners, sizes, has_markers), plausible)
    found = search.at(searched)
    if _needs_second_search(searched, found, sizes):
        smeared = searched.saddles.smeared
        found = search.more(found, searched.with_smeared(), smeared, SMEARED_CORNERS, ties=True) or found
    for k in range(1, 1 if searched.enlarged else len(searched.levels)):
        # Coarser levels help only where squares do not meet at their corners; those of clutter do.
        if _has_whole_board(found, sizes) or plausible.rejected >= MAX_FAILED_GROWTHS:
            break
        coarser = searched.coarser(k)
        if coarser is None:
            break
        again = search.more(found, coarser, coarser.corners, MIN_BOARD_CORNERS, ties=False)
        if again is None:  # Still coarser levels show fewer corners.
            break
        found = again
    if min_corners < MIN_BOARD_CORNERS and has_markers is None:
        return found
    return [
        item
        for item in found
        if _of_size(item.lattice, sizes)
        or is_compact(item.lattice, size_px)
        or (has_markers is not None and has_markers(grey, item.lattice))
    ]


@dataclass(slots=True)
class _RejectionCounter:
    """A test of lattices that counts those that it, or a later test, rejects."""

    plausible: IsPlausible
    rejected: int = 0

    def __call__(self, grey: GreyImage, finest: Level, lattice: Lattice) -> bool:
        passed = self.plausible(grey, finest, lattice)
        self.rejected += not passed
        return passed


@dataclass(slots=True)
class _Search:
    """Searches of one image with different corners.

    Attributes
    ----------
    first : the corners of the first search.
    grey, criteria : where boards are fitted, and what they must fulfil.
    plausible : the test of lattices before they are fully grown.
    fitted : what `fit_and_confirm` gave for the lattices of each search: the same often grow from several levels.
    """

    first: SearchedImage
    grey: GreyImage
    criteria: BoardCriteria
    plausible: _RejectionCounter
    fitted: list[tuple[list[Lattice], list[RefinedLattice]]] = field(default_factory=list)

    def at(
        self, searched: SearchedImage, before: Sequence[RefinedLattice] = (), more_than: int = 0
    ) -> list[RefinedLattice]:
        """Return the boards from the corners `searched`, none unless their lattices have `more_than` corners; those
        found `before` are plausible."""
        plausible = _again_or(self.plausible, before) if before else self.plausible
        boards = candidate_lattices(searched, self.criteria.min_corners, plausible)
        if sum(item.count for item in boards) <= more_than:
            return []
        out = self._confirmed(boards)
        if self.criteria.has_markers is None:
            out = [item for item in out if not self._has_odd_edges(item.lattice, searched)]
        self.plausible.rejected += 0 if out else len(boards)
        return out

    def _has_odd_edges(self, lattice: Lattice, searched: SearchedImage) -> bool:
        """Return whether the edges of a board show that it is none, unless that was tested before the fit.

        Large lattices were tested before they were fully grown. Of discs that nearly touch, coarser levels show corners
        that hide how far the edges bow between them. Markers in the squares bow edges, too, but the finest level shows
        their corners.
        """
        if searched is self.first and lattice.count < MANY_CORNERS:
            return False
        test = has_edge_offset if searched is self.first else has_bowed_edges
        return lattice.solid and test(lattice, self.first.finest)

    def _confirmed(self, boards: list[Lattice]) -> list[RefinedLattice]:
        for same, out in self.fitted:
            if _have_same_corners(same, boards):
                return out
        self.fitted.append((boards, fit_and_confirm(self.grey, boards, self.criteria)))
        return self.fitted[-1][1]

    def more(
        self, found: list[RefinedLattice], at: SearchedImage, seen: Corners, least: int, *, ties: bool
    ) -> list[RefinedLattice] | None:
        """Return what was `found`, or what the corners `at` show if that is more, with `ties` if it is as much.

        None if those `seen` cannot add to it: none may belong to its lattices, and fewer than `least` are elsewhere.
        """
        if not found:
            return self.at(at)
        new, may_belong = new_corners(found, seen.pixels)
        # With uneven blur the corners of the board itself are smeared.
        if may_belong or (ties and any(item.picture is not None for item in found)):
            before = corner_count(found)
            again = self.at(at, found, 0 if ties else before)
            return again if corner_count(again) >= before + (not ties) else found
        if np.count_nonzero(new) < least:
            return None
        elsewhere = at.corners.of(new_corners(found, at.corners.pixels)[0])
        return with_better(found, self.at(replace(at, corners=elsewhere), found))


def _again_or(plausible: IsPlausible, before: Sequence[RefinedLattice]) -> IsPlausible:
    """Return a test by which a lattice with mostly the same corners as those confirmed `before` is plausible; others
    are tested by `plausible`."""
    known = np.concatenate([item.lattice.pixels[item.lattice.known] for item in before])

    def test(grey: GreyImage, finest: Level, lattice: Lattice) -> bool:
        return is_mostly(lattice, known) or plausible(grey, finest, lattice)

    return test


def _have_same_corners(one: Sequence[Lattice], two: Sequence[Lattice]) -> bool:
    """Return whether two searches gave the same lattices, but for the places of their first corners."""
    if [item.count for item in one] != [item.count for item in two]:
        return False
    places = [[np.sort(item.pixels[item.known].view(np.complex128), axis=0) for item in found] for found in (one, two)]
    return all(np.array_equal(*pair) for pair in zip(*places, strict=True))


def corner_count(found: Sequence[RefinedLattice]) -> int:
    """Return the number of corners of all lattices."""
    return sum(item.lattice.count for item in found)


def _has_whole_board(found: Sequence[RefinedLattice], sizes: Sequence[tuple[int, int]]) -> bool:
    """Return whether one of `found` is complete and has one of `sizes`, or any size if none is known."""
    whole = {frozenset(item.lattice.size) for item in found if item.lattice.known.all()}
    return not whole.isdisjoint(map(frozenset, sizes)) if sizes else bool(whole)


def _needs_second_search(
    searched: SearchedImage, found: Sequence[RefinedLattice], sizes: Sequence[tuple[int, int]]
) -> bool:
    """Return whether a search with motion-blurred corners may find more: no whole board of `sizes` was `found`, or no
    board at all without `sizes`, or a board with uneven blur."""
    if sizes and _has_whole_board(found, sizes):
        return False
    if any(item.picture is not None for item in found):
        return len(searched.saddles.smeared) > 0
    return (bool(sizes) or not found) and len(searched.saddles.smeared) >= SMEARED_CORNERS


def candidate_lattices(searched: SearchedImage, min_corners: int, plausible: IsPlausible) -> list[Lattice]:
    """Return the lattices of an image that may be boards, before the sub-pixel fit; only `plausible` ones are grown."""
    size_px = (searched.grey.shape[1], searched.grey.shape[0])
    level = searched.levels[0]
    lattices = build_lattices(searched.corners, find_links(searched.corners, level))
    grown = grow_all(lattices, searched.saddles, level, functools.partial(plausible, searched.grey, searched.finest))
    grown = [item for item in grown if item.count >= MIN_PART_CORNERS]
    if not any(item.solid or min_corners < MIN_BOARD_CORNERS for item in grown):
        return []
    boards = [board for item in grown for part in split_at_turns(item) for board in split_necks(part)]
    parts = without_shared_corners([without_stray_rows(board, size_px) for board in boards], MIN_PART_CORNERS)
    return [board for board in join_parts(parts) if is_large_enough(board, min_corners)]


def fit_and_confirm(grey: GreyImage, boards: Sequence[Lattice], criteria: BoardCriteria) -> list[RefinedLattice]:
    """Return those of `boards` that the fit confirms, refined, without corners of boards that they touch.

    Boards with uneven blur are fitted in a resampled part of the image with even blur (`RefinedLattice.picture`).
    """
    refined = refine(grey, boards, _score)
    found = _confirmed_parts(grey, boards, refined, criteria)
    if any(known_median(item.blur_px) <= LOOKED_AT_PX for item in found):
        # Blurred lattices in an image with a sharp board are background.
        return found
    for board, item in zip(boards, refined, strict=True):
        picture = with_uniform_blur(grey, board, item)
        if picture is None:
            continue
        there = [replace(board, pixels=picture.of(board.pixels))]
        room = replace(criteria, sizes=criteria.sizes if len(found) < len(criteria.sizes) else ())
        again = refine(picture.grey, there, _score, radius_px=picture.radius_px)
        found = with_better(found, [one.out_of(picture) for one in _confirmed_parts(picture.grey, there, again, room)])
    return found


def _score(item: RefinedLattice) -> float:
    return Evidence.of(item).score


def _confirmed_parts(
    grey: GreyImage, boards: Sequence[Lattice], refined: Sequence[RefinedLattice], criteria: BoardCriteria
) -> list[RefinedLattice]:
    """Return those of `refined` (the fits of `boards`) that are boards, split where they touch."""
    size_px = (grey.shape[1], grey.shape[0])
    out = []
    for item in _accepted(grey, boards, refined, criteria):
        own = without_outliers(item, size_px)
        parts = (
            split_at_discontinuities(own, several=exceeds_known_sizes(own.lattice, criteria.sizes))
            if may_be_discontinuous(item, size_px)
            else [own]
        )
        if len(parts) == 1:
            if is_large_enough(own.lattice, criteria.min_corners):
                # Corners of squares with markers are fitted again by their finder.
                placed = placed_together(grey, own, criteria.has_markers)
                raised = _with_scatter(placed)
                if raised is placed or _remains_board(grey, raised, criteria):
                    out.append(raised)
            continue
        # The fits of these corners used edges on the other side of the discontinuity: fit them again.
        alone = [part.lattice.trimmed() for part in parts]
        own_parts = [part for part in alone if is_large_enough(part, criteria.min_corners)]
        out += _confirmed_parts(grey, own_parts, refine(grey, own_parts, _score), criteria)
    return out


def _remains_board(grey: GreyImage, item: RefinedLattice, criteria: BoardCriteria) -> bool:
    """Return whether a lattice is still a board after its sigmas were raised for the scatter of its corners."""
    prior = _prior(item.lattice, criteria.sizes)
    return Evidence.of(item).score + prior > 0.0 or _is_marked_board(grey, item.lattice, item, criteria)


def _with_scatter(item: RefinedLattice) -> RefinedLattice:
    """Return `item` with the sigmas of a small board raised for the scatter of its corners
    (`scatter.small_scatter`)."""
    raised = small_scatter(item.lattice.pixels, item.sigma_px)
    return item if raised == 1.0 else replace(item, sigma_px=item.sigma_px * raised, scatter=item.scatter * raised)


def _accepted(
    grey: GreyImage, boards: Sequence[Lattice], refined: Sequence[RefinedLattice], criteria: BoardCriteria
) -> list[RefinedLattice]:
    """Return those of `refined` (the fits of `boards`) that are boards.

    If there are fewer than listed boards, lattices of the listed sizes whose borders are confirmed need less evidence;
    the sigmas of their corners account for their uncertainty. In addition to all listed boards such a lattice would be
    something else: a board in the background, or a mirror image.
    """
    every, sizes, min_corners = list(zip(boards, refined, strict=True)), criteria.sizes, criteria.min_corners
    sure = [
        after
        for before, after in every
        if is_board(after, before.count, min_corners) or _is_marked_board(grey, before, after, criteria)
    ]
    room = len(sizes) - len(sure)
    if room <= 0:
        return sure
    rest = [
        (before.count, part_of_known_size(after, sizes)) for before, after in every if not any(after is s for s in sure)
    ]
    likely = [
        after
        for before, after in rest
        if _of_size(after.lattice, sizes)
        if is_board(after, min(before, after.lattice.known.size), min_corners, _prior(after.lattice, sizes))
        if squares_end(grey, after.lattice)
    ]
    return sure + sorted(likely, key=lambda item: -Evidence.of(item).score)[:room]


def _is_marked_board(grey: GreyImage, before: Lattice, after: RefinedLattice, criteria: BoardCriteria) -> bool:
    """Return whether markers in the squares of a fitted lattice prove that it is a board."""
    if criteria.has_markers is None or not is_board(after, before.count, criteria.min_corners, np.inf):
        return False
    return criteria.has_markers(grey, after.lattice)


def _of_size(lattice: Lattice, sizes: Sequence[tuple[int, int]]) -> bool:
    """Return whether `lattice` has one of `sizes`, and enough corners for that to be evidence."""
    return lattice.count >= MIN_EXPECTED_CORNERS and frozenset(lattice.size) in {frozenset(size) for size in sizes}


def _prior(lattice: Lattice, sizes: Sequence[tuple[int, int]]) -> float:
    """Return what the size of `lattice` adds to its evidence score."""
    return _of_size(lattice, sizes) * (OF_EXPECTED_SIZE + OF_WHOLE * bool(lattice.known.all()))


def _is_plausible(grey: GreyImage, finest: Level, lattice: Lattice) -> bool:
    """Return whether `lattice` may be a board, by the offsets of its edges and a fit of a sample."""
    return not (lattice.solid and has_edge_offset(lattice, finest)) and _sample_is_plausible(grey, finest, lattice)


def _plausible_or_marked(has_markers: MarkerTest) -> IsPlausible:
    """Return the plausibility test of lattices that may have markers in their squares."""
    return lambda grey, finest, lattice: _sample_is_plausible(grey, finest, lattice) or has_markers(grey, lattice)


def _sample_is_plausible(grey: GreyImage, _: Level, lattice: Lattice) -> bool:
    """Return whether `lattice` may be a board, by a fit of a sample of its corners."""
    sample = sample_of(lattice)
    if sample is None:
        return True
    (refined,) = refine(grey, [sample], _score)
    if is_board(refined, sample.count, 0):
        return True
    # Of clutter the fit leaves few corners.
    picture = with_uniform_blur(grey, sample, refined) if refined.lattice.count >= MIN_BOARD_CORNERS else None
    if picture is None:
        return False
    there = [replace(sample, pixels=picture.of(sample.pixels))]
    (again,) = refine(picture.grey, there, _score, radius_px=picture.radius_px)
    return is_board(again, sample.count, 0)
