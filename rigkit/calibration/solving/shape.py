"""Board shapes as unknowns: flat, warped (a few parameters for each board), or every corner released.

A shape is linear in its unknowns, points = flat points + basis @ unknowns. Each unknown has a Gaussian prior with zero
mean, so that undetermined ones keep the board flat. `evidence` estimates the widths of the priors from the views.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Points

SHAPES = ("flat", "warp", "released")

ASPECT_SIGMA = 3e-3
"""Prior of the print's aspect ratio: paper feeds are right to a few per mille."""
SHEAR_SIGMA = 1e-3
"""Prior of the print's shear, rad."""
STRETCH_SIGMA = 2e-3
"""Prior of a stretch that varies over the print (a feed of varying speed), as a fraction of the board's half
diagonal."""
BOW_SIGMA = 1e-2
"""Prior of a bow, as a fraction of the board's half diagonal: weak, a board bent by more is visibly bent."""
RELEASED_SIGMA_XY = 6e-4
"""Initial prior of a released corner in the plane, as a fraction of the board's half diagonal (0.09 mm on 9x6 x
30 mm)."""
RELEASED_SIGMA_Z = 3e-3
"""Initial prior of a released corner out of the plane, same unit (0.4 mm on 9x6 x 30 mm)."""

WARP_UNKNOWNS = 11
"""Number of unknowns of a board's warp: aspect, shear, bows, stretches."""
BOWS, STRETCHES = np.arange(2, 5), np.arange(5, 11)
"""Indices of the unknowns with a common prior width."""
MIN_VIEWS = 3
"""A board in fewer views stays flat."""


NONE: IntArray = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False, slots=True)
class ShapeModel:
    """The board points as a linear function of the shape's unknowns.

    Attributes
    ----------
    kind : "flat", "warp" or "released".
    flat : (M, 3) mm, the declared boards.
    basis : (M, 3, B) mm per unknown of the warp; B = 0 for flat.
    sigma : prior standard deviation of each unknown: B of the warp, then three of each released corner, in mm.
    released : (K,) rows of the released corners, of all boards in at least MIN_VIEWS views.
    """

    kind: str
    flat: Points
    basis: FloatArray
    sigma: FloatArray
    released: IntArray

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return int(self.sigma.size)

    def points(self, unknowns: FloatArray) -> Points:
        """Return the board points, (M, 3) mm."""
        if not unknowns.size:
            return self.flat.copy()
        count = self.basis.shape[-1]
        points: Points = self.flat + self.basis @ unknowns[:count]
        points[self.released] += unknowns[count:].reshape(-1, 3)
        return points

    def richer(self, kind: str, observations: Observations, unknowns: FloatArray) -> tuple[ShapeModel, FloatArray]:
        """Return the model of a richer kind with the priors of this one, and its unknowns, the added ones zero."""
        shape = shape_model(kind, observations)
        sigma = np.concatenate([self.sigma, shape.sigma[self.count :]])
        return replace(shape, sigma=sigma), np.concatenate([unknowns, np.zeros(shape.count - self.count)])

    def held(self, unknowns: FloatArray) -> ShapeModel:
        """Return the model without unknowns, with the boards in the given shape."""
        return _rigid(self.points(unknowns))

    def with_corners_held(self, unknowns: FloatArray) -> ShapeModel:
        """Return the model in which released corners are held and only warps are unknown."""
        count = self.basis.shape[-1]
        flat = self.points(unknowns) - self.basis @ unknowns[:count]
        return ShapeModel("warp", flat, self.basis, self.sigma[:count], NONE)


def _rigid(points: Points) -> ShapeModel:
    return ShapeModel("flat", points, np.zeros((len(points), 3, 0)), np.zeros(0), NONE)


def shape_model(kind: str, observations: Observations) -> ShapeModel:
    """Return the shape model `kind` for the boards of the observations."""
    flat = observations.table()
    if kind == "flat":
        return _rigid(flat)
    warp = _warp(observations, flat)
    if kind == "warp":
        return warp
    # Released corners move relative to a warp: a bow costs a few numbers, not the prior of every corner.
    often = in_enough_views(observations)
    released = np.flatnonzero(np.repeat(often, np.diff(observations.first_row)))
    each = [flat[_rows(observations, board)] for board in np.flatnonzero(often).tolist()]
    sigma = np.concatenate([warp.sigma, *(np.tile(released_sigma(points), len(points)) for points in each)])
    return ShapeModel("released", flat, warp.basis, sigma, released)


def in_enough_views(observations: Observations) -> BoolArray:
    """Return which boards, (boards,), are in enough views to determine their shape (in one view a bow is a pose)."""
    return np.bincount(observations.board, minlength=len(observations.boards)) >= MIN_VIEWS


def warp_groups(observations: Observations) -> Iterator[IntArray]:
    """Yield the unknowns of the warp with a common prior width, board by board: bows, stretches."""
    for i in range(int(in_enough_views(observations).sum())):
        yield from (WARP_UNKNOWNS * i + part for part in (BOWS, STRETCHES))


def released_groups(observations: Observations, first: int) -> Iterator[IntArray]:
    """Yield the unknowns of the released corners, from index `first` on, with a common prior width: in the plane, and
    out of it. Border corners have widths of their own: paper curls there, and a detector sees one neighbour less."""
    for board in (b for b, often in zip(observations.boards, in_enough_views(observations), strict=True) if often):
        grid = board.grid()
        border = ((grid == 0) | (grid == np.array(board.size) - 1)).any(axis=1)
        for chosen in (border, ~border):
            corners = 3 * np.flatnonzero(chosen)[:, None]
            yield from (first + (corners + np.array(axes)).ravel() for axes in ((0, 1), (2,)))
        first += 3 * len(grid)


def _rows(observations: Observations, board: int) -> slice:
    return slice(int(observations.first_row[board]), int(observations.first_row[board + 1]))


def released_sigma(points: Points) -> FloatArray:
    """Return the initial prior standard deviation of a released corner, (3,) mm, from the flat corners of its board."""
    return _half_diagonal(points) * np.array([RELEASED_SIGMA_XY, RELEASED_SIGMA_XY, RELEASED_SIGMA_Z])


def _half_diagonal(points: Points) -> float:
    return 0.5 * float(np.linalg.norm(np.ptp(points[:, :2], axis=0)))


def _warp(observations: Observations, flat: Points) -> ShapeModel:
    often = np.flatnonzero(in_enough_views(observations))
    basis = np.zeros((len(flat), 3, WARP_UNKNOWNS * len(often)))
    sigma = [np.zeros(0)]
    for i, board in enumerate(often.tolist()):
        rows = _rows(observations, board)
        own = warp_of_board(flat[rows])
        basis[rows, :, WARP_UNKNOWNS * i : WARP_UNKNOWNS * (i + 1)] = own.basis
        sigma.append(own.sigma)
    return ShapeModel("warp", flat, basis, np.concatenate(sigma), NONE)


def warp_of_board(points: Points) -> ShapeModel:
    """Return the warp of a board with its corners at `points` (N, 3): aspect, shear, bow along x, bow along y, twist,
    and six of a stretch that varies over the print (in x and y, each quadratic in x and y). Bows are in mm at the
    centre, the twist at the corner, the stretch at the rim. An overall scale is excluded: it is equivalent to another
    distance."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    half = 0.5 * np.ptp(points, axis=0)
    x, y = ((points - centre)[:, :2]).T
    basis = np.zeros((len(points), 3, WARP_UNKNOWNS))
    basis[:, 0, 0], basis[:, 1, 0] = 0.5 * x, -0.5 * y
    basis[:, 0, 1], basis[:, 1, 1] = 0.5 * y, 0.5 * x
    x, y = x / half[0], y / half[1]
    basis[:, 2, 2], basis[:, 2, 3], basis[:, 2, 4] = 1.0 - x**2, 1.0 - y**2, x * y
    # Legendre polynomials, orthogonal to a shift of the board.
    stretch = np.stack([1.5 * x**2 - 0.5, x * y, 1.5 * y**2 - 0.5], axis=-1)
    basis[:, 0, 5:8] = basis[:, 1, 8:11] = stretch
    size = _half_diagonal(points)
    sigma = np.array([ASPECT_SIGMA, SHEAR_SIGMA, *[BOW_SIGMA * size] * 3, *[STRETCH_SIGMA * size] * 6])
    return ShapeModel("warp", points, basis, sigma, NONE)
