"""The kernels in tag_board.c, tag_rounds.c and tag_places.c: the fit of the corners of a board of tags, the rounds in
which it is added to, and where a lattice lies on it."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header
from rigkit.kernels.edges import FactorRules
from rigkit.kernels.surface import SURFACE_COLUMNS

_CONSTANTS = header().constants
CORNER_COLUMNS, TAG_MARKS, TAG_NUMBERS, MAP_KNOWN, MAP_BY_CAMERA = (
    _CONSTANTS[name] for name in ("CORNER_COLUMNS", "TAG_MARKS", "TAG_NUMBERS", "MAP_KNOWN", "MAP_BY_CAMERA")
)


@structure("tag_corner_rules_t")
class TagCornerRules(Struct):
    """The constants of `detection.tags.corners`."""


@structure("tag_board_t")
class TagsOfBoard(Struct):
    """What a kernel is told of a board of tags."""


@structure("tag_fit_t")
class _TagFit(Struct):
    """The fit of a board of tags in an image."""


class TagBoardFit:
    """The fit of the N corners of a board of tags in an image.

    Attributes
    ----------
    corners : (N, CORNER_COLUMNS) what is known of them, in the order of `detection.guided.board_guide.FITTED`; NaN
        where one is missing.
    """

    def __init__(self, image: GreyImage, tags: TagsOfBoard, rules: TagCornerRules, pixels: FloatArray) -> None:
        """Begin with corners (R, C, 2) roughly at `pixels`, NaN where unknown."""
        count = tags.count
        self.corners = np.full((count, CORNER_COLUMNS), np.nan)
        self.corners[:, :2] = pixels.reshape(-1, 2)
        self._numbers, self._base = np.zeros(TAG_NUMBERS), np.empty((count, SURFACE_COLUMNS))
        self._fit = _TagFit.of(
            board=tags,
            rules=rules,
            grey=image,
            corners=self.corners,
            marks=np.zeros((TAG_MARKS, count), np.uint8),
            base=self._base,
            curvature=np.full((count, 2), np.nan),
            numbers=self._numbers,
        )

    @property
    def mapped(self) -> bool:
        """Whether there is a map through the corners known now."""
        return bool(self._numbers[MAP_KNOWN])

    def set_base(self, rows: FloatArray | None) -> None:
        """Take a camera's map, rows (N, SURFACE_COLUMNS) of a `TagSurface`, to begin with; or none."""
        self._numbers[MAP_BY_CAMERA] = rows is not None
        if rows is not None:
            self._base[:] = rows

    def fit_all(self) -> None:
        """Fit all known corners and forget those that fail."""
        kernels().fit_tag_board(self._fit, np.nan)

    def fit_bent(self) -> None:
        """Fit those corners again whose lines bend otherwise than when they were fitted, if that is known better
        now."""
        kernels().refit_tag_corners(self._fit)

    def add(self, rounds: int, *, by_this_map: bool = False) -> bool:
        """Add missing corners in so many rounds at most, each foretold by the corners of the one before, or by the map
        of before the last fit of all; return whether there were any in the last round."""
        return bool(kernels().add_tag_corners(self._fit, rounds, by_this_map))

    def drop(self, rounds: int) -> bool:
        """Forget corners that lie where those around cannot have them, in so many rounds at most; return whether there
        were any in the last."""
        return bool(kernels().drop_tag_corners(self._fit, rounds))

    def sigma_factor(self, rules: FactorRules) -> float:
        """Return the factor for the sigmas of the corners that were fitted last together."""
        return float(kernels().tag_sigma_factor(self._fit, rules))

    def scatter(self, factor: float) -> float:
        """Return how far corners usually lie off where the others have them, in their sigmas times `factor`."""
        return float(kernels().tag_scatter(self._fit, factor))

    def put(self, *values: FloatArray) -> None:
        """Take what is known of all corners, an array (R, C) or (R, C, 2) for each of `corners`' columns."""
        self.corners[:] = np.concatenate([value.reshape(len(self.corners), -1) for value in values], axis=1)
        self._numbers[MAP_KNOWN] = False


def tag_heights(pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the longer of two sides of each tag whose corners are among `pixels` (R, C, 2), (R / 2, C / 2) px, and how
    far the end of the other lies from it; NaN where one of the four is missing."""
    heights: tuple[FloatArray, FloatArray] = kernels().tag_heights(pixels)
    return heights


def squares_of_lattice(pixels: FloatArray, odd: bool) -> tuple[FloatArray, IntArray]:
    """Return the squares of a lattice (R, C, 2) whose row and column together are odd, or even: corners (N, 4, 2) in
    order of growing angle from u to v, and the (column, row) (N, 2) of their first."""
    count, quads, cells = kernels().squares_of_lattice(pixels, odd)
    return quads[:count], cells[:count]


def vote_place(cells: IntArray, turns: IntArray, places: IntArray, size: tuple[int, int]) -> tuple[int, int, IntArray]:
    """Return what `detection.tags.placing.voted_place` does of a lattice of `size` (columns, rows)."""
    place = np.zeros(3, np.int64)
    votes = kernels().vote_place(cells, turns, places, *size, place)
    return int(votes), int(place[0]), place[1:]
