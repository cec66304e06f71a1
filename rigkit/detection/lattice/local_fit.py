"""Local polynomial fits to a lattice of corners: where the next corner is, which way the rows run, how they bend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.growth import FitRules, fit

__all__ = ["LocalFit", "fit_cells"]

POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
TERMS_OF_DEGREE = {1: 3, 2: 6, 3: 10}


@dataclass(frozen=True, eq=False, slots=True)
class LocalFit:
    """Position as a polynomial of (column, row) around M cells; (M, 2) each, in px per cell (squared).

    Attributes
    ----------
    pixels : position at the cell itself.
    sides : (M, 2, 2) first derivatives, along the column direction and along the row direction.
    bends : (M, 2, 2) second derivatives likewise.
    support : (M,) number of corners behind the fit.
    gain : (M,) standard deviation of `pixels` for corners of standard deviation 1.
    """

    pixels: FloatArray
    sides: FloatArray
    bends: FloatArray
    support: FloatArray
    gain: FloatArray

    @property
    def along_column(self) -> FloatArray:
        return self.sides[:, 0]

    @property
    def along_row(self) -> FloatArray:
        return self.sides[:, 1]

    @property
    def bend_column(self) -> FloatArray:
        return self.bends[:, 0]

    @property
    def bend_row(self) -> FloatArray:
        return self.bends[:, 1]

    def areas(self) -> FloatArray:
        """Return the areas (M,) of the cells, px^2, negative where they are folded over."""
        return _cross(*self.sides.transpose(1, 2, 0))

    def cell_px(self) -> FloatArray:
        """Return the sides (M,) of squares as large as the cells, px, at least 1."""
        side: FloatArray = np.sqrt(np.maximum(self.areas(), 1.0))
        return side

    def curvature(self) -> FloatArray:
        """Return the curvature of the column and the row line at the cells, (M, 2) 1/px, positive towards +90 degrees.

        The direction of +90 degrees is that of growing angle from u to v.
        """
        (a, b), (c, d) = self.sides.T, self.bends.T
        curvature: FloatArray = (a * d - b * c).T / np.maximum((self.sides**2).sum(axis=2), 1e-12) ** 1.5
        return curvature

    def gaps(self) -> FloatArray:
        """Return how far the neighbouring column and row lines lie from those through the cells, (M, 2, 2) px.

        First index: the column line, the row line; second: before and after, in the direction of +90 degrees.
        """
        (a, b), (c, d) = self.sides.transpose(1, 2, 0), self.bends.transpose(1, 2, 0)
        area, row, column = _cross(a, b), 0.5 * _cross(a, d), 0.5 * _cross(c, b)
        gaps = np.empty((2, 2, len(area)))
        np.subtract(area, row, out=gaps[0, 0])
        np.add(area, row, out=gaps[0, 1])
        np.add(area, column, out=gaps[1, 0])
        np.subtract(area, column, out=gaps[1, 1])
        np.abs(gaps, out=gaps)
        # A cell without sides has no neighbours: NaN.
        with np.errstate(invalid="ignore"):
            gaps[0] /= np.hypot(a[0], a[1])
            gaps[1] /= np.hypot(b[0], b[1])
        return gaps.transpose(2, 0, 1)


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
    library = kernels()
    if library is not None:
        rules = FitRules(degree, radius, leave_out, width, ridge)
        return _local_fit(fit(lattice, cells, rules))
    side = 2 * radius + 1
    step_r, step_c = (a.ravel() - radius for a in np.divmod(np.arange(side * side), side))
    powers = POWERS[: TERMS_OF_DEGREE[degree]]
    design = np.stack([step_c**i * step_r**j for i, j in powers], axis=-1).astype(np.float64)
    weight = np.exp(-0.5 * (step_c**2 + step_r**2) / width**2)
    if leave_out:
        weight[step_c**2 + step_r**2 == 0] = 0.0
    padded = np.pad(lattice, ((radius, radius), (radius, radius), (0, 0)), constant_values=np.nan)
    row, column = np.nonzero(cells)
    near = padded[row[:, None] + step_r + radius, column[:, None] + step_c + radius]
    known = np.isfinite(near[..., 0]) & (weight > 0.0)
    weights = np.where(known, weight, 0.0)
    near = np.where(known[..., None], near, 0.0)
    total = np.maximum(weights.sum(axis=1), 1e-12)
    centre = (weights[..., None] * near).sum(axis=1) / total[:, None]
    size = len(powers)
    products = (design[:, :, None] * design[:, None, :]).reshape(len(design), -1)
    normal = (weights @ products).reshape(-1, size, size)
    pull = np.array([(1e-12, 1e-9, ridge[0], ridge[1])[i + j] for i, j in powers])
    normal = normal + np.diag(pull)
    right = np.swapaxes(weights[..., None] * (near - centre[:, None]), 1, 2) @ design
    constant = np.zeros((len(row), size, 1))
    constant[:, 0] = 1.0
    solved = np.linalg.solve(normal, np.concatenate([np.swapaxes(right, 1, 2), constant], axis=2))
    solution = np.swapaxes(solved[..., :2], 1, 2)
    gain = np.sqrt(((weights * (solved[..., 2] @ design.T)) ** 2).sum(axis=1))
    zero = np.zeros((len(row), 2))
    bend_column, bend_row = (2.0 * solution[..., k] if degree > 1 else zero for k in (3, 5))
    position = solution[..., 0] + centre
    single = np.stack([known.sum(axis=1), gain], axis=1)
    return _local_fit(np.hstack([position, solution[..., 1], solution[..., 2], bend_column, bend_row, single]))


def _local_fit(rows: FloatArray) -> LocalFit:
    """Return the fit from `rows` (M, 12): the fields of `LocalFit` one after the other."""
    sides, bends = rows[:, 2:6].reshape(-1, 2, 2), rows[:, 6:10].reshape(-1, 2, 2)
    return LocalFit(rows[:, :2], sides, bends, rows[:, 10], rows[:, 11])
