"""The part of an image to which a whole board is fitted: its pixels, and the surroundings of the board."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_model import END_SIGMAS, MIN_REACH, WINDOW_REACH
from rigkit.kernels.boards import Picture

NO_END = 10.0
"""Number of further squares assumed where squares continue."""


@dataclass(frozen=True, eq=False, slots=True)
class Surroundings:
    """The surroundings of a board's corners, before the first and beyond the last ones along columns and along rows.

    Attributes
    ----------
    outer : (2, 2) width of the outer squares, in squares; infinite if further squares may follow.
    reach : (2, 2) distance beyond the corners up to which pixels are used, in squares.
    holes : (R, C) missing corners, near which no pixels are used.
    """

    outer: FloatArray
    reach: FloatArray
    holes: BoolArray

    @staticmethod
    def paper(size: tuple[int, int]) -> Surroundings:
        """Return the surroundings of a whole board of R x C corners on paper."""
        return Surroundings(np.ones((2, 2)), np.full((2, 2), WINDOW_REACH), np.zeros(size, np.bool_))

    @staticmethod
    def read(outer: FloatArray, pixels: FloatArray, blur: float, holes: BoolArray) -> Surroundings:
        """Return the surroundings of a lattice (R, C, 2) from the widths `outer` (R, C, 4) of outer squares (NaN:
        none).

        Their order is that of `edge_model.NEIGHBOUR_LINES`: above, below, right, left.
        """
        sides = outer[:, 0, 3], outer[:, -1, 2], outer[0, :, 0], outer[-1, :, 1]
        steps = np.diff(pixels[:, :2], axis=1), np.diff(pixels[:, -2:], axis=1), np.diff(pixels[:2], axis=0)
        gaps = [float(np.median(np.linalg.norm(step, axis=2))) for step in (*steps, np.diff(pixels[-2:], axis=0))]
        wide, reach = np.full(4, np.inf), np.full(4, WINDOW_REACH)
        for k, side in enumerate(sides):
            seen = np.isfinite(side)
            if 2 * np.count_nonzero(seen) >= len(side):
                wide[k] = np.median(side[seen])
            else:
                reach[k] = np.clip(1.0 - END_SIGMAS * blur / gaps[k], MIN_REACH, WINDOW_REACH)
        return Surroundings(wide.reshape(2, 2), reach.reshape(2, 2), holes)

    def of(self, rows: slice, columns: slice) -> Surroundings:
        """Return the surroundings of some rows and columns; inside the board squares continue."""
        outer, reach = self.outer.copy(), self.reach.copy()
        for axis, (part, count) in enumerate(zip((columns, rows), self.holes.shape[::-1], strict=True)):
            for end, inner in enumerate((part.start > 0, part.stop < count)):
                if inner:
                    outer[axis, end], reach[axis, end] = np.inf, WINDOW_REACH
        return Surroundings(outer, reach, self.holes[rows, columns])


@dataclass(frozen=True, eq=False, slots=True)
class BoardWindow:
    """The part of the image to which a board is fitted, in pixels that are means of `scale` x `scale` image pixels.

    Attributes
    ----------
    grey : (H, W), inside : (H, W) whether a pixel is within the image.
    first : (2,) centre of the first pixel, in the image.
    surroundings, ends : of the board; (2, 2) positions of its ends, squares.
    """

    grey: Picture
    inside: BoolArray
    scale: int
    first: FloatArray
    surroundings: Surroundings
    ends: FloatArray

    @staticmethod
    def around(
        image: GreyImage, pixels: FloatArray, scale: int, margin: int, surroundings: Surroundings
    ) -> BoardWindow | None:
        """Return the window around corners (R, C, 2); None if it is far larger than the image."""
        outer = extended(pixels, 1).reshape(-1, 2)
        low, high = np.floor(outer.min(axis=0)) - margin, np.ceil(outer.max(axis=0)) + margin
        height, width = image.shape
        if not (np.isfinite(low + high).all() and (high - low < 2.0 * max(height, width)).all()):
            return None
        (left, top), (wide, tall) = low.astype(int).tolist(), (-(-(high - low) // scale)).astype(int).tolist()
        grey, inside = np.zeros((2, tall * scale, wide * scale), np.float32)
        rows, columns = slice(max(top, 0), top + len(grey)), slice(max(left, 0), left + grey.shape[1])
        part = image[rows, columns]
        down, over = rows.start - top, columns.start - left
        here = slice(down, down + len(part)), slice(over, over + part.shape[1])
        grey[here], inside[here] = part, 1.0
        if scale > 1:
            grey, inside = (cv2.resize(plane, (wide, tall), interpolation=cv2.INTER_AREA) for plane in (grey, inside))
        # Continuing squares extend beyond the window.
        beyond = np.where(np.isfinite(surroundings.outer), surroundings.outer, NO_END)
        last = np.array(pixels.shape[1::-1]) - 1.0
        ends = np.stack([-beyond[:, 0], last + beyond[:, 1]], axis=1)
        first = np.array([left, top]) + 0.5 * (scale - 1.0)
        return BoardWindow(np.asarray(grey), np.asarray(inside) > 0.999, scale, first, surroundings, ends)

    def used(self, places: FloatArray, blur: float) -> BoolArray:
        """Return which pixels (H, W), at board positions `places` (H, W, 2), show only the board."""
        reach, holes = self.surroundings.reach, self.surroundings.holes
        last = np.array(holes.shape[::-1]) - 1.0
        with np.errstate(invalid="ignore"):
            used = self.inside & ((places > -reach[:, 0]) & (places < last + reach[:, 1])).all(axis=2)
        if holes.any():
            column, row = (
                np.rint(np.nan_to_num(places)).astype(np.int64).clip(0, last.astype(np.int64)).transpose(2, 0, 1)
            )
            hidden = holes[row, column] & used
            away = cv2.distanceTransform((~hidden).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            near = (np.abs(places - np.stack([column, row], axis=2)) < MIN_REACH).all(axis=2)
            used &= ~hidden & ((away > END_SIGMAS * blur) | near)
        return used


def extended(pixels: FloatArray, rings: int) -> FloatArray:
    """Return the lattice (R, C, 2) extrapolated by `rings` of corners.

    Steps between corners are extrapolated geometrically as complex numbers, so that no step reverses.
    """
    lattice = pixels[..., 0] + 1j * pixels[..., 1]
    for _ in range(rings):
        for axis in (0, 1):
            lattice = np.moveaxis(_longer(np.moveaxis(lattice, axis, 0)), 0, axis)
    return np.stack([lattice.real, lattice.imag], axis=2)


def _longer(lattice: np.ndarray) -> np.ndarray:
    """Return complex positions (R, C) with a row added on both sides."""
    steps = np.diff(lattice, axis=0)
    before, after = _next(steps[0], steps[1]), _next(steps[-1], steps[-2])
    return np.concatenate([(lattice[0] - before)[None], lattice, (lattice[-1] + after)[None]])


def _next(last: np.ndarray, one_before: np.ndarray) -> np.ndarray:
    """Return the next complex step; the last one again if positions of a wrong lattice coincide."""
    return np.asarray(np.divide(last**2, one_before, out=last.copy(), where=one_before != 0.0))
