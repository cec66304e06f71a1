"""AprilGrids: lattices of unevenly spaced saddles, placed on the board's grid by the tags in their squares.

Without squares between the tags there are no saddles: the tags are found by their outlines.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.lattice.lattice import build_lattices
from rigkit.detection.lattice.links import LENGTH_RATIO, find_links
from rigkit.detection.saddles.local_contrast import equalised, stretched
from rigkit.detection.saddles.response import BASE_PIXELS, GreyImage, Level, each_level, enlarged_level
from rigkit.detection.saddles.saddle import Corners, each_once, find_corners
from rigkit.detection.tags.codes import excess_likeness
from rigkit.detection.tags.corners import tag_corners
from rigkit.detection.tags.placing import TagBoard, placed_lattices
from rigkit.detection.tags.quads import placed_tags
from rigkit.detection.tags.surface import SmoothMap
from rigkit.detection.targets.base import Finder, Search

FIRST_SEEN, MIN_SEEN_AT_FIRST = 0.9, 16
"""Smallest share of the visible corners, and smallest number, that must be found on the finest level for the coarser
ones to be skipped; the few missed ones are then searched for one by one."""

LIKE_BEST_CODE = 0.5
"""Smallest excess of a code in its place, relative to that of the code most like it: that one is itself unless blurred;
another code reaches half of the largest of a hundred random ones once in ten times."""


class AprilGridFinder(Finder):
    """Corners are linked as those of chessboards, but the distances to opposite neighbours may differ more."""

    def find(self, search: Search, boards: Sequence[Board]) -> list[BoardDetection]:
        found = self._found(search, search.grey, boards)
        if found or search.grey.dtype == np.uint8:
            return found
        # As for chessboards: in images of more than 8 bits a board may use a hundredth of the range of brightness.
        seen = self._found(search, equalised(search.grey), boards)
        return self._found(search, stretched(search.grey, [item.lattice() for item in seen]), boards) if seen else []

    def _found(self, search: Search, image: GreyImage, boards: Sequence[Board]) -> list[BoardDetection]:
        """Return the detections of the boards in the image of a search, or in that image with other grey levels."""
        every = [TagBoard.of(board) for board in boards]
        found = []
        for inverted in (False, True):
            tags = [item for item in every if item.pattern.inverted == inverted]
            # The negative of an image has its corners in the same places.
            grey = 255 - image if inverted and tags else image
            for item, pixels in self._placed(grey, tags, quick=search.quick):
                seen = tag_corners(grey, item, pixels, search.camera) if np.isfinite(pixels).any() else None
                if seen is None or len(seen.grid) < search.min_corners_of(item.board):
                    continue
                # Corners of another board fit as well.
                if _confirmed(grey, item, seen):
                    found.append(seen)
        return found

    def _placed(
        self, grey: GreyImage, tags: Sequence[TagBoard], *, quick: bool
    ) -> Iterator[tuple[TagBoard, FloatArray]]:
        """Yield the boards and their approximate corners (R, C, 2), NaN where not found."""
        joined = [item for item in tags if item.pattern.corner_squares]
        yield from ((item, placed_tags(grey, item)) for item in tags if not item.pattern.corner_squares)
        if not joined:
            return
        levels = each_level(grey)
        finest = next(levels)
        corners, _ = find_corners([finest])
        placed = list(_placed_by(corners, finest, grey, joined))
        if not all(_nearly_whole(item, pixels, grey.shape) for item, pixels in placed):
            coarser = list(levels)
            corners, saddles = find_corners(coarser, corners)
            # Corners of coarser levels may break the lattices of very slanted tags.
            placed = max(list(_placed_by(corners, finest, grey, joined)), placed, key=_known)
            # Where light or ink spreads, tags and the squares between them touch on coarser levels only.
            for k, level in enumerate(coarser):
                alone = each_once(saddles.by_level[k:])
                if len(alone) < MIN_SEEN_AT_FIRST or any(np.isfinite(pixels).any() for _, pixels in placed):
                    break
                placed = list(_placed_by(alone, level, grey, joined))
        if not quick and grey.size < BASE_PIXELS and not _known(placed):
            # Between tags of 12 px the squares are 4 px wide.
            twice = enlarged_level(grey)
            corners, _ = find_corners([twice])
            placed = list(_placed_by(corners, twice, grey, joined))
        yield from ((item, _or_lone_tags(grey, item, pixels)) for item, pixels in placed)


def _placed_by(
    corners: Corners, finest: Level, image: GreyImage, boards: Sequence[TagBoard]
) -> Iterator[tuple[TagBoard, FloatArray]]:
    """Yield the boards and those of the `corners` that belong to them, (R, C, 2), NaN where there is none."""
    ratio = LENGTH_RATIO * max(max(item.pattern.spacing, 1.0 / item.pattern.spacing) for item in boards)
    lattices = list(build_lattices(corners, find_links(corners, finest, ratio)))
    for item in boards:
        pixels, used = placed_lattices(image, lattices, item)
        lattices = [lattice for n, lattice in enumerate(lattices) if n not in used]
        yield item, pixels


def _known(placed: Sequence[tuple[TagBoard, FloatArray]]) -> int:
    """Return the number of known corners of all boards."""
    return sum(int(np.count_nonzero(np.isfinite(pixels[..., 0]))) for _, pixels in placed)


def _or_lone_tags(image: GreyImage, tags: TagBoard, pixels: FloatArray) -> FloatArray:
    """Return the approximate corners `pixels` (R, C, 2) of a board, or those of its tags found by outlines, if more.

    Light that spreads by pixels separates tags from the squares between them, and leaves few saddles. An image without
    any saddle of the board is not searched for outlines: most of these show no board.
    """
    known = int(np.count_nonzero(np.isfinite(pixels[..., 0])))
    if not 0 < known < MIN_SEEN_AT_FIRST:
        return pixels
    alone = placed_tags(image, tags)
    return alone if np.count_nonzero(np.isfinite(alone[..., 0])) > known else pixels


def _confirmed(image: GreyImage, tags: TagBoard, seen: BoardDetection) -> bool:
    """Return whether most codes in a detection are like those of the board's tags at these places, which may be too
    blurred to be read one by one."""
    pixels = seen.lattice()
    quads = np.stack([pixels[::2, ::2], pixels[::2, 1::2], pixels[1::2, 1::2], pixels[1::2, ::2]], axis=2)
    whole = np.isfinite(quads).all(axis=(2, 3))
    excess = excess_likeness(image, quads[whole], tags.codes)
    own = excess[np.arange(len(excess)), 4 * np.flatnonzero(whole)]
    alike = own > LIKE_BEST_CODE * excess.max(axis=1, initial=0.0)
    return bool(2 * np.count_nonzero(alike) > np.count_nonzero(excess.any(axis=1)))


def _nearly_whole(tags: TagBoard, pixels: FloatArray, shape: tuple[int, ...]) -> bool:
    """Return whether enough corners (R, C, 2) are known to predict the others from them."""
    known = np.isfinite(pixels[..., 0])
    count, wanted = int(np.count_nonzero(known)), known.size
    if FIRST_SEEN * wanted > count >= MIN_SEEN_AT_FIRST:
        # Corners outside the image are not missed.
        all_seen = SmoothMap(tags.places[known], pixels[known]).at(tags.places.reshape(-1, 2)).pixels
        wanted = int(np.count_nonzero(((all_seen > 0.0) & (all_seen < np.array(shape[::-1]) - 1.0)).all(axis=1)))
    return bool(count >= max(MIN_SEEN_AT_FIRST, FIRST_SEEN * wanted))
