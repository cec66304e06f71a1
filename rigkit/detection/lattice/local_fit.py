"""Local polynomial fits to a lattice of corners: positions of predicted corners, directions and curvature of rows."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels.growth import FitRules, fit
from rigkit.kernels.lattice import line_gaps


class Prediction(NamedTuple):
    """Parameters of the prediction of a corner from its neighbours.

    Attributes
    ----------
    degree : of the polynomial.
    ridge : as of `fit_cells`.
    """

    degree: int
    ridge: tuple[float, float]


STIFF, FLEXIBLE = Prediction(2, (0.02, 1.0)), Prediction(3, (1e-3, 1e-2))
"""STIFF is stable with few neighbours, FLEXIBLE follows the rows at the rim of a fisheye. They are the keywords of
`fit_cells`: `**STIFF._asdict()`."""

PREDICTION_WIDTH = 1.3
"""Standard deviation of the Gaussian weight of predictions of uncertain corners, cells."""

MIN_PREDICTING, MIN_PREDICTORS = 3, 6
"""Smallest number of corners of a prediction: a plane needs three; six determine the curvatures."""


@dataclass(frozen=True, eq=False, slots=True)
class LocalFit:
    """Position as a polynomial of (column, row) around M cells; (M, 2) each, in px per cell (squared).

    Attributes
    ----------
    pixels : position at the cell itself.
    sides : (M, 2, 2) first derivatives, along the column direction and along the row direction.
    curvatures : (M, 2, 2) second derivatives likewise.
    support : (M,) number of corners of the fit.
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
        """Return the fits of the cells chosen (M,)."""
        return LocalFit(*(getattr(self, name)[chosen] for name in self.__slots__))

    def areas(self) -> FloatArray:
        """Return the areas (M,) of the cells, px^2, negative if they are folded over."""
        a, b = self.sides.transpose(1, 2, 0)
        return np.asarray(a[0] * b[1] - a[1] * b[0])

    def shorter_px(self) -> FloatArray:
        """Return the shorter sides (M,) of the cells, px."""
        return np.asarray(np.linalg.norm(self.sides, axis=2).min(axis=1))

    def cell_px(self) -> FloatArray:
        """Return the square roots (M,) of the areas of the cells, px, at least 1."""
        return np.asarray(np.sqrt(np.maximum(self.areas(), 1.0)))

    def curvature(self) -> FloatArray:
        """Return the curvature of the column and the row line at the cells, (M, 2) 1/px, positive towards +90 degrees.

        The direction of +90 degrees is that of growing angle from u to v.
        """
        (a, b), (c, d) = self.sides.T, self.curvatures.T
        curvature: FloatArray = (a * d - b * c).T / np.maximum((self.sides**2).sum(axis=2), 1e-12) ** 1.5
        return curvature

    def gaps(self) -> FloatArray:
        """Return the distances (M, 2, 2), px, of the neighbouring column and row lines from those through the cells.

        First index: the column line, the row line; second: before and after, in the direction of +90 degrees. NaN for a
        cell whose sides are zero.
        """
        return line_gaps(self.sides, self.curvatures)


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
    cells : (R, C) bool, the M cells to be fitted, row by row.
    width : standard deviation in cells of the Gaussian weight.
    ridge : regularisation of the second and third derivatives, as variances of a corner (squared cells), for cells
        with few neighbours.
    leave_out : ignore the corner of the cell itself, to predict it from its neighbours.
    """
    return _local_fit(fit(lattice, cells, _rules(degree, radius, leave_out, width, ridge)))


@functools.cache
def _rules(degree: int, radius: int, leave_out: bool, width: float, ridge: tuple[float, float]) -> FitRules:
    return FitRules(degree, radius, leave_out, width, ridge)


def _local_fit(rows: FloatArray) -> LocalFit:
    """Return the fit from `rows` (M, 12): the fields of `LocalFit` one after the other."""
    # Contiguous, as kernels require.
    sides, curvatures = (np.ascontiguousarray(rows[:, k : k + 4]).reshape(-1, 2, 2) for k in (2, 6))
    return LocalFit(rows[:, :2], sides, curvatures, rows[:, 10], rows[:, 11])


def predicted(lattice: FloatArray, cells: BoolArray) -> LocalFit:
    """Return the fit that predicts unknown corners (`cells`), of degree 2 and damped for few neighbours on one side."""
    return fit_cells(lattice, cells, degree=2, ridge=(1e-3, 1.0))
