"""Affinely resampled parts of an image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.saddles.response import FloatImage, GreyImage

MARGIN_CELLS = 3.0
"""Margin of the resampled part around the corners, in squares."""

DRAWN_EVERY_PX = 2.0
"""Largest distance of sample positions, px of the image, before averaging: blurred images have no finer detail."""

MAX_RESAMPLED = 1.6e7
"""Largest number of samples; of boards that need more (blurred, over 30 megapixels) they are further apart."""


@dataclass(frozen=True, eq=False, slots=True)
class Resampled:
    """A part of an image, resampled: its pixel is `matrix` @ pixel + `offset`.

    Attributes
    ----------
    grey : grey levels 0..255.
    matrix, offset : (2, 2) and (2,).
    radius_px : pixels further from a corner are not used to place it.
    """

    grey: FloatImage
    matrix: FloatArray
    offset: FloatArray
    radius_px: float

    @property
    def sigma_factor(self) -> float:
        """Standard deviation per axis (rms) in the image for a standard deviation of 1 in both directions here."""
        return float(np.linalg.norm(np.linalg.inv(self.matrix)) / np.sqrt(2.0))

    def of(self, pixels: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of this part for `pixels` of the image."""
        return np.asarray(pixels @ self.matrix.T + self.offset)

    def back(self, pixels: FloatArray) -> FloatArray:
        """Return the pixels (..., 2) of the image for `pixels` of this part."""
        return np.asarray((pixels - self.offset) @ np.linalg.inv(self.matrix).T)


def resampled(image: GreyImage, lattice: Lattice, matrix: FloatArray, radius_px: float) -> Resampled | None:
    """Return the part of `image` around `lattice`, transformed by `matrix`; None if it is too large."""
    corners = lattice.pixels[lattice.known] @ matrix.T
    side = float(np.median(np.linalg.norm(fit_cells(lattice.pixels, lattice.known).sides @ matrix.T, axis=2)))
    low = np.floor(corners.min(axis=0) - MARGIN_CELLS * side)
    size = np.ceil(corners.max(axis=0) + MARGIN_CELLS * side - low).astype(int) + 1
    count = float(np.prod(size, dtype=np.float64))
    if not 0.0 < count < MAX_RESAMPLED:
        return None
    # Supersampling, then means.
    fine = int(min(np.ceil(1.0 / (DRAWN_EVERY_PX * np.linalg.svd(matrix)[1].min())), np.sqrt(MAX_RESAMPLED / count)))
    # Only the part that is sampled is converted.
    reached = (np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) * size + low) @ np.linalg.inv(matrix).T
    first = np.floor(reached.min(axis=0)).clip(0, np.array(image.shape[::-1]) - 2).astype(int)
    end = np.ceil(reached.max(axis=0)).astype(int) + 2
    seen = image[first[1] : max(end[1], first[1] + 2), first[0] : max(end[0], first[0] + 2)].astype(np.float32)
    # The centre of a pixel is the centre of its finer pixels.
    there = np.column_stack([fine * matrix, fine * (matrix @ first - low) + 0.5 * (fine - 1.0)])
    columns, rows = (size * fine).tolist()
    drawn = cv2.warpAffine(seen, there, (columns, rows), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    grey = cv2.resize(drawn, size.tolist(), interpolation=cv2.INTER_AREA) if fine > 1 else drawn
    return Resampled(np.asarray(grey, np.float32), matrix, -low, radius_px)
