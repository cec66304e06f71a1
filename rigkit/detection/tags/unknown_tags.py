"""Unknown AprilGrids: family, border, numbering, size and spacing, from the tags read in images.

Tags are read in the squares of lattices of corners, or, if an image has no such lattice, as lone quadrilaterals.
Several boards are distinguished by their numbers: tags of one lattice are of one board.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.detections import grid_turned
from rigkit.core.patterns.aprilgrid import MAX_BORDER, MAX_SPACING, TAG_FAMILIES, AprilGrid
from rigkit.core.patterns.aruco import dictionary_modules, marker_count, smallest_dictionary
from rigkit.detection.lattice.lattice import Lattice, build_lattices
from rigkit.detection.lattice.links import LENGTH_RATIO, find_links
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.searched_image import SearchedImage
from rigkit.detection.tags.codes import Codes, TagCode, read_tags, transferred
from rigkit.detection.tags.module_size import module_size
from rigkit.detection.tags.placing import squares_of
from rigkit.detection.tags.quads import quadrilaterals
from rigkit.detection.tags.unknown_charuco import DICTIONARIES, MIN_CODES_READ, MIN_SHARE_FITTING, laid_out
from rigkit.kernels.surface import maps_of_quads

WIDEST_RATIO = 8.0
"""Largest ratio of a tag's side to the gap, or of the gap to the side."""

MAX_LONE_STEP = 3.0
"""Largest distance from one lone tag to the next, in sides of a tag: `AprilGrid.spacing` is at most 2."""

OFF_EDGE, OFF_BORDER = 0.25, 0.6
"""Largest difference of outlines from a tag's printed side, in modules, for which they determine the spacing (at most
0.19 in REAL images, 0.4 to 2 if light or ink spreads by 1 to 3 px); and of the printed side from that with a border of
whole modules. Sides of adjacent borders differ by two modules: with a larger difference the next border is possible
(those images have 0.0 to 0.7 with light, up to 1.6 with much ink)."""

OFF_TAG_PLACE = 0.2
"""Largest distance of a tag from its place predicted by an adjacent one, in steps."""

APRIL_TAGS = tuple((family, border) for family in TAG_FAMILIES for border in range(1, MAX_BORDER + 1))
ARUCO_TAGS = tuple((dictionary, 1) for dictionary in DICTIONARIES if dictionary not in TAG_FAMILIES.values())
"""Families that may occur, with the modules of their borders."""

Family: TypeAlias = tuple[str, int]
"""Family and modules of the border."""

Kind: TypeAlias = tuple[str, int, bool]
"""Family, modules of the border, whether tags are without squares between their corners."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _SeenTags:
    """Tags of one lattice, or adjacent lone tags.

    Attributes
    ----------
    image : index.
    numbers : (N,)
    places : (N, 2) in tags relative to any of them, with tags upright as in OpenCV.
    steps : (K,) all distances of adjacent tags, in sides of a tag.
    edges_moved : light or ink has moved the edges of tags, so that `steps` are accurate to some hundredths only.
    border_ambiguous : the border may be another one.
    """

    image: int
    kind: Kind
    numbers: IntArray
    places: IntArray
    steps: FloatArray
    edges_moved: bool = False
    border_ambiguous: bool = False

    def numbering(self) -> tuple[int, int, IntArray] | None:
        """Return the increments of numbers along a row and down a column, and the indices (N,) of the tags with these;
        None if adjacent tags do not determine them."""
        across, down = Counter[int](), Counter[int]()
        at = {tuple(place): int(number) for place, number in zip(self.places.tolist(), self.numbers, strict=True)}
        for (column, row), number in at.items():
            for beside, votes in (((column + 1, row), across), ((column, row + 1), down)):
                if beside in at:
                    votes[at[beside] - number] += 1
        if not across or not down:
            return None
        step, line = across.most_common(1)[0][0], down.most_common(1)[0][0]
        # With tags upright as in OpenCV, Kalibr's boards are upside down: numbers increase to the left, and down.
        if abs(step) != 1 or line < 1:
            return None
        first = self.numbers - step * self.places[:, 0] - line * self.places[:, 1]
        values, votes_of = np.unique(first, return_counts=True)
        return step, line, np.flatnonzero(first == values[votes_of.argmax()])


NumberedTags: TypeAlias = tuple[_SeenTags, int, int, IntArray]
"""Tags with the result of `_SeenTags.numbering`."""


@dataclass(eq=False, slots=True)
class TagObservations:
    """The tags of all images, `seen`, and the sum of correlations by kind, `kinds`. Inverted tags are white on
    black."""

    families: tuple[Family, ...] = APRIL_TAGS
    inverted: bool = False
    kinds: Counter[Kind] = field(default_factory=Counter)
    seen: list[_SeenTags] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Number of tags in all images."""
        return sum(len(item.numbers) for item in self.seen)

    def look(self, index: int, image: GreyImage) -> bool:
        """Read the tags of an image; return whether there are any."""
        grey = 255 - image if self.inverted else image
        seen = SearchedImage.of(grey)
        # Where light or ink spreads, tags and the squares between them touch on coarser levels only.
        for k in range(len(seen.levels)):
            at = seen.coarser(k) if k else seen
            if at is None:
                break
            lattices = build_lattices(at.corners, find_links(at.corners, at.levels[0], LENGTH_RATIO * WIDEST_RATIO))
            found = [self._read(index, grey, lattice) for lattice in lattices if lattice.count >= 4 * MIN_CODES_READ]
            if any(found):
                return True
        return self.read_lone_tags(index, image)

    def _read(self, index: int, image: GreyImage, lattice: Lattice) -> bool:
        quads, squares = squares_of(lattice, dark=True)
        return any(
            self._keep_numbered(index, lattice.size, quads, squares, *read)
            for read in _read_kinds(image, quads, self.families)
        )

    def _keep_numbered(
        self, index: int, size: tuple[int, int], quads: FloatArray, squares: IntArray, family: Family, codes: TagCode
    ) -> bool:
        """Return whether the tags of one family in a lattice have numbers of a board; if so, keep them."""
        turn = int(np.bincount(codes.turns[codes.read], minlength=4).argmax())
        own = codes.read & (codes.turns == turn)
        # Every number occurs once on a board; random codes in similar squares are the same ones.
        if np.count_nonzero(np.unique(codes.number[own], return_counts=True)[1] == 1) < MIN_CODES_READ:
            return False
        columns, rows = size
        cells = grid_turned(squares[own], (columns - 1, rows - 1), -turn)
        upright, places = np.roll(quads[own], -turn, axis=1), cells // 2
        seen = _SeenTags(
            image=index, kind=(*family, False), numbers=codes.number[own], places=places, steps=_steps(upright, places)
        )
        numbering = seen.numbering()
        # With small families random codes are read in most squares, but not with consecutive numbers.
        if numbering is None or len(numbering[2]) < max(MIN_CODES_READ, MIN_SHARE_FITTING * len(seen.numbers)):
            return False
        self._keep(seen, codes)
        return True

    def read_lone_tags(self, index: int, image: GreyImage) -> bool:
        """Read the lone tags of an image, without squares between their corners; return whether there are any."""
        grey = 255 - image if self.inverted else image
        quads = quadrilaterals(grey)
        return any(self._keep_lone_tags(index, grey, quads, *read) for read in _read_kinds(grey, quads, self.families))

    def _keep_lone_tags(self, index: int, image: GreyImage, quads: FloatArray, family: Family, codes: TagCode) -> bool:
        """Return whether adjacent lone tags of one family have numbers of a board; if so, keep them."""
        # The same tag is found several times: at the outer and at the inner border.
        order = np.flatnonzero(codes.read)[np.argsort(-codes.likeness[codes.read], kind="stable")]
        own = order[np.unique(codes.number[order], return_index=True)[1]]
        upright = quads[own[:, None], (codes.turns[own, None] + np.arange(4)) % 4]
        shown = False
        for members, places in _adjacent_tags(upright):
            seen = _SeenTags(
                image=index,
                kind=(*family, True),
                numbers=codes.number[own[members]],
                places=places,
                steps=_steps(upright[members], places),
            )
            numbering = seen.numbering()
            # Random codes do not have consecutive numbers.
            if numbering is not None and len(numbering[2]) >= MIN_CODES_READ:
                self._keep(self._as_printed(image, seen, upright[members]), codes)
                shown = True
        return shown

    def _as_printed(self, image: GreyImage, seen: _SeenTags, upright: FloatArray) -> _SeenTags:
        """Return lone tags, with corners `upright` (N, 4, 2), with the border and steps as printed."""
        family = seen.kind[0]
        bits = dictionary_modules(TAG_FAMILIES.get(family, family))[seen.numbers]
        size = module_size(image, upright, bits, float(np.median(seen.steps))) if len(seen.steps) else None
        if size is None:
            return seen
        sides = {border: bits.shape[1] + 2.0 * border for name, border in self.families if name == family}
        border = min(sides, key=lambda one: abs(sides[one] - size.side))
        edges_moved = abs(size.outline - sides[border]) > OFF_EDGE
        return replace(
            seen,
            kind=(family, border, not size.squares),
            steps=seen.steps * size.outline / sides[border] if edges_moved else seen.steps,
            edges_moved=edges_moved,
            border_ambiguous=len(sides) > 1 and abs(size.side - sides[border]) > OFF_BORDER,
        )

    def _keep(self, seen: _SeenTags, codes: TagCode) -> None:
        self.kinds[seen.kind] += float(codes.likeness[codes.read].sum())  # type: ignore[assignment]
        self.seen.append(seen)


def _read_kinds(image: GreyImage, quads: FloatArray, families: Sequence[Family]) -> Iterator[tuple[Family, TagCode]]:
    """Yield the families, with their borders, of which tags are read in quadrilaterals, and what is read, by decreasing
    total correlation."""
    read = []
    for family, border in families:
        pattern = AprilGrid(1.0, family, border, numbering="opencv")
        codes = read_tags(image, quads, Codes.of(pattern, np.arange(marker_count(pattern.dictionary))))
        if np.count_nonzero(codes.read) >= MIN_CODES_READ:
            read.append(((family, border), codes))
    yield from sorted(read, key=lambda one: -float(one[1].likeness[one[1].read].sum()))


def _steps(upright: FloatArray, places: IntArray) -> FloatArray:
    """Return the steps (K,) between adjacent tags with corners (N, 4, 2) at `places` (N, 2), in sides of a tag.

    The cross-ratio of the four corners on a line of two tags, with a step of t sides, is t^2 / (t^2 - 1): it needs no
    extrapolation of a small tag's homography.
    """
    at = {tuple(place): k for k, place in enumerate(places.tolist())}
    lines = []
    for (column, row), k in at.items():
        # Corners are in the order (0,0) (1,0) (1,1) (0,1).
        for beside, edges in (((column + 1, row), ((0, 1), (3, 2))), ((column, row + 1), ((0, 3), (1, 2)))):
            if beside in at:
                lines += [upright[[k, k, at[beside], at[beside]], [*edge, *edge]] for edge in edges]
    if not lines:
        return np.zeros(0)
    a, b, c, d = np.array(lines).transpose(1, 0, 2)

    def length(one: FloatArray, other: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(one - other, axis=1))

    ratio = length(a, c) * length(b, d) / np.maximum(length(b, c) * length(a, d), 1e-9)
    ratio = ratio[ratio > 1.0]
    return np.sqrt(ratio / (ratio - 1.0))


def _adjacent_tags(quads: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield groups of upright tags with corners (N, 4, 2) in rows and columns: their indices (M,), and their places
    (M, 2) in steps."""
    inverse = np.asarray(np.linalg.inv(maps_of_quads(quads)), np.float64)
    middle = quads.mean(axis=1)
    offset = np.stack([transferred(inverse[k : k + 1], middle)[0] for k in range(len(quads))]) - 0.5
    # The mean of both predictions: perspective beyond the homography of either cancels.
    offset = 0.5 * (offset - np.swapaxes(offset, 0, 1))
    distance = np.linalg.norm(offset, axis=2) + np.where(np.eye(len(quads)) > 0.0, np.inf, 0.0)
    step = float(np.median(distance.min(axis=1)))
    if not 1.0 < step < MAX_LONE_STEP:
        return
    place = np.rint(offset / step).astype(np.int64)
    near = (np.abs(offset / step - place) < OFF_TAG_PLACE).all(axis=2) & (np.abs(place).sum(axis=2) == 1)
    yield from laid_out(near, place)


@dataclass(frozen=True, eq=False, slots=True)
class GuessedGrid:
    """An AprilGrid found in images.

    Attributes
    ----------
    board : with tags of 1 mm.
    images : indices of the images with it.
    edges_moved : light or ink has moved the edges of its tags in all of them: its spacing is known to some hundredths.
    other_border : this board with another border, if it fits as well.
    """

    board: Board
    images: tuple[int, ...]
    edges_moved: bool = False
    other_border: Board | None = None


def guessed_grids(seen: TagObservations) -> list[GuessedGrid]:
    """Return the AprilGrids of the most frequent kind, by decreasing number of tags."""
    if not seen.seen:
        return []
    kind = seen.kinds.most_common(1)[0][0]
    groups: list[NumberedTags] = []
    for item in seen.seen:
        numbering = item.numbering() if item.kind == kind else None
        if numbering is not None and len(numbering[2]) >= MIN_CODES_READ:
            groups.append((item, *numbering))
    out = []
    for cluster in _of_one_board(groups):
        # Light and ink do not move corners between squares.
        sure = [group for group in cluster if not group[0].edges_moved]
        board = _board_of(cluster, kind, _steps_of(sure or cluster), seen.inverted)
        if board is not None:
            tags = sum(len(own) for *_, own in cluster)
            images = tuple(sorted({item.image for item, *_ in cluster}))
            other_border = None if any(not item.border_ambiguous for item, *_ in cluster) else _of_other_border(board)
            out.append((tags, GuessedGrid(board, images, not sure, other_border)))
    return [grid for _, grid in sorted(out, key=lambda found: -found[0])]


def _steps_of(groups: Sequence[NumberedTags]) -> FloatArray:
    return np.concatenate([item.steps for item, *_ in groups])


def _of_other_border(board: Board) -> Board | None:
    """Return the board with the other border whose modules have the same size and distance to those of the next tag;
    None if its tags would overlap, or if none has so wide a gap."""
    pattern = board.pattern
    assert isinstance(pattern, AprilGrid)
    border = MAX_BORDER + 1 - pattern.border
    bits = dictionary_modules(pattern.dictionary).shape[1]
    spacing = (1.0 + pattern.spacing) * (bits + 2 * pattern.border) / (bits + 2 * border) - 1.0
    if not 0.0 < round(spacing, 2) <= MAX_SPACING:
        return None
    return replace(board, pattern=replace(pattern, border=border, spacing=round(spacing, 2)))


def _of_one_board(groups: Sequence[NumberedTags]) -> list[list[NumberedTags]]:
    """Return the groups of tags by boards: groups that count alike and whose ranges of numbers overlap are of one
    board."""
    clusters: list[tuple[int, list[NumberedTags]]] = []
    for group in sorted(groups, key=lambda group: (*group[1:3], int(group[0].numbers[group[3]].min()))):
        numbers = group[0].numbers[group[3]]
        if clusters and clusters[-1][1][0][1:3] == group[1:3] and int(numbers.min()) <= clusters[-1][0]:
            last, members = clusters.pop()
            clusters.append((max(last, int(numbers.max())), [*members, group]))
        else:
            clusters.append((int(numbers.max()), [group]))
    return [members for _, members in clusters]


def _board_of(cluster: Sequence[NumberedTags], kind: Kind, steps: FloatArray, inverted: bool) -> Board | None:
    """Return the board, with tags of 1 mm, of a cluster of groups with `steps` (K,) from tag to tag; None if there is
    no valid one."""
    family, border, alone = kind
    step, columns = cluster[0][1:3]
    own = [(item.numbers[which], item.places[which]) for item, _, _, which in cluster]
    # The number of the first column, modulo the columns, is known from groups as wide as the board.
    wide = [(n, p) for n, p in own if np.ptp(p[:, 0]) + 1 == columns]
    firsts = Counter(int((n - (step * p[:, 0] - (step * p[:, 0]).min()))[0]) % columns for n, p in wide)
    remainder = firsts.most_common(1)[0][0] if firsts else 0
    least, most = (int(f([f(n) for n, _ in own])) for f in (np.min, np.max))
    first = max(least - (least - remainder) % columns, 0)
    spacing = round(float(np.median(steps)) - 1.0, 2) if len(steps) else 0.0
    if not 0.0 < spacing <= MAX_SPACING:
        return None
    numbering = "opencv" if step > 0 else "kalibr"
    rows = (most - first) // columns + 1
    if first + columns * rows > marker_count(TAG_FAMILIES.get(family, family)):
        return None
    family = smallest_dictionary(family, first + columns * rows)
    pattern = AprilGrid(spacing, family, border, first, numbering, corner_squares=not alone, inverted=inverted)
    return Board("board", 2 * columns, 2 * rows, 1.0, 1.0, pattern=pattern)
