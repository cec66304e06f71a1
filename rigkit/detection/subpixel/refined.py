"""Lattices with what the sub-pixel fit says of their corners."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.lattice.lattice import Lattice, padded, turned
from rigkit.detection.subpixel.resampled import Resampled


@dataclass(frozen=True, eq=False, slots=True)
class RefinedLattice:
    """A lattice with what the fit says of each corner, (R, C) each and NaN where unknown.

    Attributes
    ----------
    lattice : the corners.
    sigma_px, blur_px : predicted standard deviation, width of the edges.
    residual, noise : RMS of what the fit leaves and of the part of it that is noise, grey levels.
    scatter : factor by which `sigma_px` was raised, because the corners scatter about the lattice by so much more than
        the noise in the image explains.
    correlated : the same, because neighbouring pixels share noise (`correlation.sigma_factors`).
    picture : what its corners were placed in, where that is not the image itself.
    """

    lattice: Lattice
    sigma_px: FloatArray
    blur_px: FloatArray
    residual: FloatArray
    noise: FloatArray
    _: KW_ONLY
    scatter: float = 1.0
    correlated: float = 1.0
    picture: Resampled | None = None

    @property
    def worst_sigma_px(self) -> FloatArray:
        """(R, C) standard deviation if all that the fit leaves were noise: large for what is no chessboard."""
        # Of few pixels, those with mirror images may have more noise than all of them have residuals.
        worst: FloatArray = self.sigma_px * np.maximum(self.residual / self.noise, 1.0)
        return worst

    @property
    def relative_residual(self) -> FloatArray:
        """(R, C) residual in parts of the contrast."""
        relative: FloatArray = self.residual / self.lattice.contrast
        return relative

    def of(self, lattice: Lattice) -> RefinedLattice:
        """Return this with `lattice` instead of its own, which has the same corners, or more of them."""
        return self._of(lattice, self._values())

    def without(self, drop: BoolArray) -> RefinedLattice:
        """Return this with the corners `drop` (R, C) forgotten."""
        rest = (np.where(drop, np.nan, values) for values in self._values())
        return self._of(self.lattice.without(drop), rest)

    def cut(self, rows: slice, columns: slice) -> RefinedLattice:
        """Return the part of `rows` and `columns`."""
        rest = (values[rows, columns] for values in self._values())
        return self._of(self.lattice.cut(rows, columns), rest)

    def padded(self, rows: tuple[int, int], columns: tuple[int, int]) -> RefinedLattice:
        """Return this with so many empty rows and columns before and after."""
        rest = (padded(values, rows, columns) for values in self._values())
        return self._of(self.lattice.padded(rows, columns), rest)

    def turned(self, quarter_turns: int) -> RefinedLattice:
        """Return this numbered from another corner, as `Lattice.turned`."""
        if quarter_turns % 4 == 0:
            return self
        rest = (turned(values, quarter_turns) for values in self._values())
        return self._of(self.lattice.turned(quarter_turns), rest)

    def filled(self, other: RefinedLattice) -> RefinedLattice:
        """Return this with the corners of `other`, of the same size, where it has none."""
        known = self.lattice.known
        pairs = zip(self._values(), other._values(), strict=True)
        scatter = max(self.scatter, other.scatter)
        rest = (np.where(known, *pair) for pair in pairs)
        return replace(self._of(self.lattice.filled(other.lattice), rest), scatter=scatter)

    def within(self, picture: Resampled) -> RefinedLattice:
        """Return this as it lies in `picture`, a part of the image."""
        return self._moved(picture.of(self.lattice.pixels), 1.0 / picture.sigma_factor, None)

    def out_of(self, picture: Resampled) -> RefinedLattice:
        """Return this, which lies in `picture`, as it lies in the image."""
        return self._moved(picture.back(self.lattice.pixels), picture.sigma_factor, picture)

    def _moved(self, pixels: FloatArray, factor: float, picture: Resampled | None) -> RefinedLattice:
        lattice = replace(self.lattice, pixels=pixels)
        sigma_px, blur_px = factor * self.sigma_px, factor * self.blur_px
        return replace(self, lattice=lattice, sigma_px=sigma_px, blur_px=blur_px, picture=picture)

    def _values(self) -> tuple[FloatArray, ...]:
        return (self.sigma_px, self.blur_px, self.residual, self.noise)

    def _of(self, lattice: Lattice, values: Iterable[FloatArray]) -> RefinedLattice:
        """Return this of another lattice, with `values` as `_values`."""
        # `replace` takes twice as long.
        return RefinedLattice(lattice, *values, scatter=self.scatter, correlated=self.correlated, picture=self.picture)
