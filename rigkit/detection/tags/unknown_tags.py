"""AprilGrids that nobody has described: family, border, numbering, counts and spacing from what is read."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.detections import grid_turned
from rigkit.core.patterns.aprilgrid import MAX_BORDER, TAG_FAMILIES, AprilGrid
from rigkit.core.patterns.aruco import marker_count
from rigkit.detection.lattice.lattice import Lattice, build_lattices
from rigkit.detection.lattice.links import LENGTH_RATIO, find_links
from rigkit.detection.saddles.response import GreyImage, pyramid
from rigkit.detection.saddles.saddle import find_corners
from rigkit.detection.tags.codes import Codes, TagCode, homographies, read_tags

WIDEST_RATIO = 8.0
"""A tag's side over the gap, or the other way round, at most."""

MIN_TAGS_READ = 3
"""Tags of one family in a lattice: one may be chance among thousands of codes."""


@dataclass(eq=False, slots=True)
class TagSightings:
    """The tags of all images.

    Attributes
    ----------
    images : indices of those that show tags.
    kinds : (family, border) -> sum of likenesses.
    tags : of each lattice with tags the kind, number (N,), place (N, 2) in tags with the tags upright as OpenCV has
        them, and how far a neighbour's first corner lies, in sides of a tag.
    """

    images: list[int] = field(default_factory=list)
    kinds: Counter[tuple[str, int]] = field(default_factory=Counter)
    tags: list[tuple[tuple[str, int], IntArray, IntArray, FloatArray]] = field(default_factory=list)

    def look(self, index: int, image: GreyImage) -> bool:
        """Read the tags of an image; say whether there are some."""
        levels = pyramid(image)
        corners, _ = find_corners(levels)
        lattices = build_lattices(corners, find_links(corners, levels[0], LENGTH_RATIO * WIDEST_RATIO))
        seen = [self._read(image, lattice) for lattice in lattices if lattice.count >= 4 * MIN_TAGS_READ]
        if any(seen):
            self.images.append(index)
        return any(seen)

    def _read(self, image: GreyImage, lattice: Lattice) -> bool:
        corners = lattice.pixels
        quads = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2)
        row, column = np.nonzero(np.isfinite(quads).all(axis=(2, 3)) & (lattice.signs()[:-1, :-1] < 0.0))
        quads = quads[row, column]
        best: tuple[float, tuple[str, int], TagCode] | None = None
        for family, dictionary in TAG_FAMILIES.items():
            every = np.arange(marker_count(dictionary))
            for border in range(1, MAX_BORDER + 1):
                codes = read_tags(image, quads, Codes.of(AprilGrid(1.0, family, border, numbering="opencv"), every))
                total = float(codes.likeness[codes.read].sum())
                if np.count_nonzero(codes.read) >= MIN_TAGS_READ and (best is None or total > best[0]):
                    best = total, (family, border), codes
        if best is None:
            return False
        total, kind, codes = best
        turn = int(np.bincount(codes.turns[codes.read], minlength=4).argmax())
        own = codes.read & (codes.turns == turn)
        if np.count_nonzero(own) < MIN_TAGS_READ:
            return False
        columns, rows = lattice.size
        cells = grid_turned(np.stack([column, row], axis=-1)[own], (columns - 1, rows - 1), -turn)
        self.kinds[kind] += total  # type: ignore[assignment]
        self.tags.append((kind, codes.number[own], cells // 2, _steps(quads[own], np.stack([column, row], -1)[own])))
        return True


def _steps(quads: FloatArray, cells: IntArray) -> FloatArray:
    """Return how far along its row the first corner of the tag beside each lies, in sides of a tag (K,)."""
    place = {tuple(cell): k for k, cell in enumerate(cells.tolist())}
    inverse = np.linalg.inv(homographies(quads))
    out = []
    for (column, row), k in place.items():
        other = place.get((column + 2, row))
        if other is not None:
            # Seen from both tags, perspective beyond the homography of either cancels.
            there = inverse[k] @ [*quads[other][0], 1.0]
            back = inverse[other] @ [*quads[k][0], 1.0]
            out.append(0.5 * (there[0] / there[2] - back[0] / back[2]))
    return np.array(out)


def guessed_grid(seen: TagSightings) -> Board | None:
    """Return the AprilGrid that most tags are of, with tags of 1 mm; None where none is told."""
    if not seen.tags:
        return None
    family, border = seen.kinds.most_common(1)[0][0]
    own = [(numbers, cells, steps) for kind, numbers, cells, steps in seen.tags if kind == (family, border)]
    across, down = Counter[int](), Counter[int]()
    for numbers, cells, _ in own:
        at = {tuple(cell): int(number) for cell, number in zip(cells.tolist(), numbers, strict=True)}
        for (column, row), number in at.items():
            for step, votes in (((1, 0), across), ((0, 1), down)):
                other = at.get((column + step[0], row + step[1]))
                if other is not None:
                    votes[other - number] += 1
    if not across or not down:
        return None
    columns = abs(down.most_common(1)[0][0])
    # Upright as OpenCV draws tags, Kalibr's boards stand on their heads.
    numbering = "opencv" if across.most_common(1)[0][0] > 0 else "kalibr"
    every = np.unique(np.concatenate([numbers for numbers, _, _ in own]))
    if columns < 1:
        return None
    # Boards are numbered from 0, or one after the other.
    first = int(every[0]) // columns * columns
    rows = (int(every[-1]) - first) // columns + 1
    spacing = round(float(np.median(np.concatenate([steps for _, _, steps in own]))) - 1.0, 2)
    if spacing <= 0.0:
        return None
    pattern = AprilGrid(spacing, family, border, first, numbering)
    return Board("board", 2 * columns, 2 * rows, 1.0, 1.0, pattern=pattern)
