"""Local polynomial fits to a lattice of corners: where the next corner is, which way the rows run, how they bend."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels.growth import FitRules, fit
from rigkit.kernels.lattice import line_gaps


class Prediction(NamedTuple):
    """How a corner is foretold from those around it.

    Attributes
    ----------
    degree : of the polynomial.
    ridge : as of `fit_cells`.
    """

    degree: int
    ridge: tuple[float, float]


STIFF, FLEXIBLE = Prediction(2, (0.02, 1.0)), Prediction(3, (1e-3, 1e-2))
"""One is steady with few neighbours, the other follows the rim of a fisheye."""


@dataclass(frozen=True, eq=False, slots=True)
class LocalFit:
    """Position as a polynomial of (column, row) around M cells; (M, 2) each, in px per cell (squared).

    Attributes
    ----------
    pixels : position at the cell itself.
    sides : (M, 2, 2) first derivatives, along the column direction and along the row direction.
    curvatures : (M, 2, 2) second derivatives likewise.
    support : (M,) number of corners behind the fit.
    gain : (M,) standard deviation of `pixels` for corners of standard deviation 1.
    """

    pixels: FloatArray
    sides: FloatArray
    curvatures: FloatArray
    support: FloatArray
    gain: FloatArray

    @property
    def along_column(self) -> FloatArray:
        return self.sides[:, 0]

    @property
    def along_row(self) -> FloatArray:
        return self.sides[:, 1]

    @property
    def curvature_column(self) -> FloatArray:
        return self.curvatures[:, 0]

    @property
    def curvature_row(self) -> FloatArray:
        return self.curvatures[:, 1]

    def of(self, chosen: BoolArray) -> LocalFit:
        """Return the same of the cells chosen (M,)."""
        return LocalFit(*(getattr(self, name)[chosen] for name in self.__slots__))

    def areas(self) -> FloatArray:
        """Return the areas (M,) of the cells, px^2, negative where they are folded over."""
        return _cross(*self.sides.transpose(1, 2, 0))

    def shorter_px(self) -> FloatArray:
        """Return the shorter sides (M,) of the cells, px."""
        return np.asarray(np.linalg.norm(self.sides, axis=2).min(axis=1))

    def cell_px(self) -> FloatArray:
        """Return the sides (M,) of squares as large as the cells, px, at least 1."""
        side: FloatArray = np.sqrt(np.maximum(self.areas(), 1.0))
        return side

    def curvature(self) -> FloatArray:
        """Return the curvature of the column and the row line at the cells, (M, 2) 1/px, positive towards +90 degrees.

        The direction of +90 degrees is that of growing angle from u to v.
        """
        (a, b), (c, d) = self.sides.T, self.curvatures.T
        curvature: FloatArray = (a * d - b * c).T / np.maximum((self.sides**2).sum(axis=2), 1e-12) ** 1.5
        return curvature

    def gaps(self) -> FloatArray:
        """Return how far the neighbouring column and row lines lie from those through the cells, (M, 2, 2) px.

        First index: the column line, the row line; second: before and after, in the direction of +90 degrees. A cell
        without sides has no neighbours: NaN.
        """
        return line_gaps(self.sides, self.curvatures)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross products of vectors (2, M)."""
    cross: FloatArray = a[0] * b[1] - a[1] * b[0]
    return cross


def fit_cells(
    lattice: FloatArray,
    cells: BoolArray,
    *,
    degree: int = 3,
    radius: int = 3,
    width: float = 2.0,
    ridge: tuple[float, float] = (1e-8, 1e-6),
    leave_out: bool = False,
) -> LocalFit:
    """Fit a polynomial of `degree` to the corners within `radius` of each of the `cells`.

    Parameters
    ----------
    lattice : (R, C, 2) pixels, NaN where unknown.
    cells : (R, C) bool, the M cells wanted, row by row.
    width : standard deviation in cells of the Gaussian weight.
    ridge : pull on the second and third derivatives, as variances of a corner (squared cells): keeps what few
        neighbours leave open from running wild.
    leave_out : ignore the corner of the cell itself, to predict it from its neighbours.
    """
    return _local_fit(fit(lattice, cells, _rules(degree, radius, leave_out, width, ridge)))


@functools.cache
def _rules(degree: int, radius: int, leave_out: bool, width: float, ridge: tuple[float, float]) -> FitRules:
    return FitRules(degree, radius, leave_out, width, ridge)


def _local_fit(rows: FloatArray) -> LocalFit:
    """Return the fit from `rows` (M, 12): the fields of `LocalFit` one after the other."""
    # By themselves in memory, as kernels take them.
    sides, curvatures = (np.ascontiguousarray(rows[:, k : k + 4]).reshape(-1, 2, 2) for k in (2, 6))
    return LocalFit(rows[:, :2], sides, curvatures, rows[:, 10], rows[:, 11])


def predicted(lattice: FloatArray, cells: BoolArray) -> LocalFit:
    """Return the fit that says where unknown corners (`cells`) are: of second degree and so damped that a few corners
    on one side are enough."""
    return fit_cells(lattice, cells, degree=2, ridge=(1e-3, 1.0))
