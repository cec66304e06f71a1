"""The kernels in tag_board.c, tag_rounds.c and tag_places.c: the fit of the corners of a board of tags, the addition of
missed corners, and the position of a lattice on the board."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, make_struct, structure
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
    """The properties of a board of tags."""


class TagBoardFit:
    """The fit of the N corners of a board of tags in an image.

    Attributes
    ----------
    corners : (N, CORNER_COLUMNS) results per corner, in the order of `detection.guided.board_guide.FITTED`; NaN for
        missing corners.
    """

    def __init__(self, image: GreyImage, tags: TagsOfBoard, rules: TagCornerRules, pixels: FloatArray) -> None:
        """Start with approximate corners `pixels` (R, C, 2), NaN where unknown."""
        count = tags.count
        self.corners = np.full((count, CORNER_COLUMNS), np.nan)
        self.corners[:, :2] = pixels.reshape(-1, 2)
        self._numbers, self._base = np.zeros(TAG_NUMBERS), np.empty((count, SURFACE_COLUMNS))
        self._fit = make_struct(
            "tag_fit_t",
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
        """Set the initial map, rows (N, SURFACE_COLUMNS) of a `TagSurface` from a camera, or none."""
        self._numbers[MAP_BY_CAMERA] = rows is not None
        if rows is not None:
            self._base[:] = rows

    def fit_all(self) -> None:
        """Fit all known corners and drop those that fail."""
        kernels().fit_tag_board(self._fit, np.nan)

    def fit_bent(self) -> None:
        """Fit those corners again for which a better estimate of the curvature of their lines is known now."""
        kernels().refit_tag_corners(self._fit)

    def add(self, rounds: int, *, by_this_map: bool = False) -> bool:
        """Add missing corners in at most `rounds` rounds, predicted by the corners known before each of them, or by the
        map before the last fit of all corners; return whether any were added."""
        return bool(kernels().add_tag_corners(self._fit, rounds, by_this_map))

    def drop(self, rounds: int) -> bool:
        """Drop corners that contradict their neighbours in at most `rounds` rounds; return whether any were dropped."""
        return bool(kernels().drop_tag_corners(self._fit, rounds))

    def sigma_factor(self, rules: FactorRules) -> float:
        """Return the factor of the sigmas of the corners of the last common fit."""
        return float(kernels().tag_sigma_factor(self._fit, rules))

    def scatter(self, factor: float) -> float:
        """Return the typical distance of corners from their predictions, in their sigmas times `factor`."""
        return float(kernels().tag_scatter(self._fit, factor))

    def put(self, *values: FloatArray) -> None:
        """Set all columns of `corners` from arrays (R, C) or (R, C, 2)."""
        self.corners[:] = np.concatenate([value.reshape(len(self.corners), -1) for value in values], axis=1)
        self._numbers[MAP_KNOWN] = False


def tag_heights(pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the longer of two sides of each tag with corners in `pixels` (R, C, 2), (R / 2, C / 2) px, and the
    distance of the end of the other side from it; NaN if one of the four corners is missing."""
    heights: tuple[FloatArray, FloatArray] = kernels().tag_heights(pixels)
    return heights


def squares_of_lattice(pixels: FloatArray, odd: bool) -> tuple[FloatArray, IntArray]:
    """Return the squares of a lattice (R, C, 2) whose row plus column is odd, or even: corners (N, 4, 2) in the order
    of increasing angle from u to v, and (column, row) (N, 2) of the first."""
    count, quads, cells = kernels().squares_of_lattice(pixels, odd)
    return quads[:count], cells[:count]


def vote_place(cells: IntArray, turns: IntArray, places: IntArray, size: tuple[int, int]) -> tuple[int, int, IntArray]:
    """See `detection.tags.placing.voted_place`; `size` is (columns, rows) of the lattice."""
    place = np.zeros(3, np.int64)
    votes = kernels().vote_place(cells, turns, places, *size, place)
    return int(votes), int(place[0]), place[1:]
