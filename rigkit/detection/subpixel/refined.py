"""Lattices with the results of the sub-pixel fit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.lattice.lattice import Lattice, padded, turned
from rigkit.detection.subpixel.resampled import Resampled


@dataclass(frozen=True, eq=False, slots=True)
class RefinedLattice:
    """A lattice with the fit's results per corner, (R, C) each, NaN where unknown.

    Attributes
    ----------
    lattice : the corners.
    sigma_px, blur_px : predicted standard deviation, and s of the edges.
    residual, noise : rms residual of the fit and of its part that is noise, grey levels.
    scatter : factor by which `sigma_px` was raised because the corners scatter about the lattice by more than noise.
    correlated : factor of `sigma_px` due to correlated noise of neighbouring pixels (`correlation.board_factors`).
    picture : the resampled part of the image in which the corners were fitted; None: the image itself.
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
        """(R, C) standard deviation if all residuals were noise: large for other patterns than chessboards."""
        # With few pixels the noise may exceed the residual.
        worst: FloatArray = self.sigma_px * np.maximum(self.residual / self.noise, 1.0)
        return worst

    @property
    def relative_residual(self) -> FloatArray:
        """(R, C) residual over contrast."""
        relative: FloatArray = self.residual / self.lattice.contrast
        return relative

    def of(self, lattice: Lattice) -> RefinedLattice:
        """Return the results with another `lattice`, which has the same corners or more."""
        return self._of(lattice, self._values())

    def without(self, drop: BoolArray) -> RefinedLattice:
        """Return the lattice without the corners `drop` (R, C)."""
        rest = (np.where(drop, np.nan, values) for values in self._values())
        return self._of(self.lattice.without(drop), rest)

    def cut(self, rows: slice, columns: slice) -> RefinedLattice:
        """Return the part of `rows` and `columns`."""
        rest = (values[rows, columns] for values in self._values())
        return self._of(self.lattice.cut(rows, columns), rest)

    def trimmed(self) -> RefinedLattice:
        """Return the lattice without empty outer rows and columns."""
        return self.cut(*self.lattice.extent)

    def padded(self, rows: tuple[int, int], columns: tuple[int, int]) -> RefinedLattice:
        """Return the lattice with numbers of empty rows and columns added before and after."""
        rest = (padded(values, rows, columns) for values in self._values())
        return self._of(self.lattice.padded(rows, columns), rest)

    def turned(self, quarter_turns: int) -> RefinedLattice:
        """Return the lattice numbered from another corner, as `Lattice.turned`."""
        if quarter_turns % 4 == 0:
            return self
        rest = (turned(values, quarter_turns) for values in self._values())
        return self._of(self.lattice.turned(quarter_turns), rest)

    def filled(self, other: RefinedLattice) -> RefinedLattice:
        """Return the lattice with missing corners taken from `other`, of the same size."""
        known = self.lattice.known
        pairs = zip(self._values(), other._values(), strict=True)
        scatter = max(self.scatter, other.scatter)
        rest = (np.where(known, *pair) for pair in pairs)
        return replace(self._of(self.lattice.filled(other.lattice), rest), scatter=scatter)

    def within(self, picture: Resampled) -> RefinedLattice:
        """Return the lattice in pixels of `picture`, a resampled part of the image."""
        return self._moved(picture.of(self.lattice.pixels), 1.0 / picture.sigma_factor, None)

    def out_of(self, picture: Resampled) -> RefinedLattice:
        """Return the lattice, which is in pixels of `picture`, in pixels of the image."""
        return self._moved(picture.back(self.lattice.pixels), picture.sigma_factor, picture)

    def _moved(self, pixels: FloatArray, factor: float, picture: Resampled | None) -> RefinedLattice:
        lattice = replace(self.lattice, pixels=pixels)
        sigma_px, blur_px = factor * self.sigma_px, factor * self.blur_px
        return replace(self, lattice=lattice, sigma_px=sigma_px, blur_px=blur_px, picture=picture)

    def _values(self) -> tuple[FloatArray, ...]:
        return (self.sigma_px, self.blur_px, self.residual, self.noise)

    def _of(self, lattice: Lattice, values: Iterable[FloatArray]) -> RefinedLattice:
        """Return another lattice with results `values`, in the order of `_values`."""
        # `replace` takes twice as long.
        return RefinedLattice(lattice, *values, scatter=self.scatter, correlated=self.correlated, picture=self.picture)
