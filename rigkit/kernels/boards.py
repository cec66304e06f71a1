"""The kernels in board_places.c, boards.c and board_changes.c: the image model of a whole board and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.kernels import kernels

Picture = NDArray[np.float32]
"""(H, W), or several of them."""


@dataclass(frozen=True, eq=False, slots=True)
class Blocks:
    """Derivatives of an image by N blocks of unknowns, which are zero outside a box each.

    Attributes
    ----------
    boxes : (N, 4) first column and row, last column and row; empty if the last is before the first.
    starts : (N,) index in `data` of the derivatives by the block's first unknown, row by row; those by others follow.
    each : number of unknowns per block.
    data : the derivatives.
    """

    boxes: IntArray
    starts: IntArray
    each: int
    data: Picture

    @staticmethod
    def empty(boxes: IntArray, each: int) -> Blocks:
        """Return blocks with uninitialised derivatives in the `boxes`."""
        sizes = areas(boxes)
        return Blocks(boxes, each * (np.cumsum(sizes) - sizes), each, np.empty(each * int(sizes.sum()), np.float32))


def areas(boxes: IntArray) -> IntArray:
    """Return the numbers of pixels in `boxes` (N, 4)."""
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2] + 1, 0)
    return np.asarray(sides[:, 0] * sides[:, 1], np.int64)


def board_places(coefficients: FloatArray, box: tuple[int, int, int, int], around: float) -> FloatArray:
    """Return the board positions (H, W, 2) of pixels along columns and rows, from the first node; NaN off the board.

    Parameters
    ----------
    coefficients : (R + 2, C + 2, 2) of a cubic B-spline through the pixels of R x C nodes.
    box : first column and row in the image, width and height.
    around : margin around the bounding box of a square's corners in which it is sought, in sides of the box.
    """
    rows, columns = coefficients.shape[0] - 2, coefficients.shape[1] - 2
    return np.asarray(kernels().board_places(coefficients, rows, columns, *box, around))


def board_picture(
    places: FloatArray, size: tuple[int, int], ends: FloatArray, paper: FloatArray, sharp_px: float, planes: int = 11
) -> Picture:
    """Return the model image of a board of R x C corners, `size`, blurred by `sharp_px`, and its derivatives as planes
    (11, H, W) (api.h: BOARD_PLANES); with `planes` 1 the image only.

    `ends` (2, 2): first and last end along columns and along rows, in squares; `paper` (4,) brightness beyond each of
    these, where that of squares is 1 and -1.
    """
    return np.asarray(kernels().board_picture(places, *size, ends, paper, sharp_px, planes))


def sheet_places(
    places: FloatArray, first: FloatArray, each: int, corners: BoolArray, reach: FloatArray
) -> tuple[Picture, BoolArray]:
    """Return columns and rows (2, H, W) of board positions `places` (H, W, 2) on a sheet that begins at `first` (2,)
    and has `each` x `each` samples per square, and which (2, H, W) are nearest to one of the `corners` (2, R, C) and
    within `reach` (2,) of it along columns and rows."""
    found: tuple[Picture, BoolArray] = kernels().sheet_places(places, corners, first, each, reach)
    return found


@dataclass(frozen=True, eq=False, slots=True)
class Shares:
    """Interpolation weights of the nodes of a grid at each pixel.

    Attributes
    ----------
    size : rows and columns of the grid.
    nodes : (H, W, 2) first node along columns and rows with a weight.
    weights : (H, W, 2, 4) of four nodes from the first.
    boxes : (R * C, 4) bounding boxes of the pixels with a weight of each node, with a margin.
    """

    size: tuple[int, int]
    nodes: NDArray[np.int32]
    weights: Picture
    boxes: IntArray

    @staticmethod
    def at(
        places: FloatArray, size: tuple[int, int], *, spacing: float, beyond: float, cubic: bool, margin: int
    ) -> Shares:
        """Return the weights at `places` (H, W, 2), in squares, of nodes that are `spacing` squares apart.

        Interpolation is `cubic` or linear; up to `beyond` squares beyond the nodes it is extrapolated linearly.
        """
        return Shares(size, *kernels().board_shares(places, *size, spacing, beyond, cubic, margin))

    def interpolated(self, values: FloatArray) -> Picture:
        """Return `values` (K, R, C) at the nodes, interpolated at the pixels (K, H, W)."""
        return np.asarray(kernels().board_values(self.nodes, self.weights, values))


def move_blocks(shares: Shares, slopes: Picture, weight: Picture, taps: Picture) -> Blocks:
    """Return the derivatives of a blurred image by moves of R x C corners along u and v, times `weight` (H, W).

    `slopes` (2, H, W) are the derivatives of the sharp image along u and v, `taps` (2 K + 1,) the blur kernel, which
    the margin of the boxes of `shares` accommodates.
    """
    blocks = Blocks.empty(shares.boxes, 2)
    room = int(areas(blocks.boxes).max(initial=1))
    kernels().move_blocks(
        *(shares.nodes, shares.weights, *shares.size, slopes, weight, taps, len(taps) // 2),
        *(blocks.boxes, blocks.starts, room, blocks.data),
    )
    return blocks


def share_blocks(shares: Shares, planes: Picture) -> Blocks:
    """Return the derivatives of the products of `planes` (K, H, W) and interpolated values by the values at the
    nodes."""
    blocks = Blocks.empty(shares.boxes, len(planes))
    room = int(areas(blocks.boxes).max(initial=1))
    kernels().share_blocks(
        *(shares.nodes, shares.weights, *shares.size, planes, blocks.boxes, blocks.starts, room, blocks.data)
    )
    return blocks


def block_products(groups: Sequence[Blocks], rest: Picture) -> tuple[FloatArray, FloatArray]:
    """Return the normal matrix (U, U) of the unknowns of all groups, in order, and the products (U,) with `rest`."""
    boxes = np.concatenate([group.boxes for group in groups])
    before = np.cumsum([0, *(len(group.data) for group in groups)])
    starts = np.concatenate([group.starts + at for group, at in zip(groups, before, strict=False)])
    each = np.concatenate([np.full(len(group.boxes), group.each, np.int64) for group in groups])
    data = np.concatenate([group.data for group in groups])
    products: tuple[FloatArray, FloatArray] = kernels().block_products(
        boxes, starts, each, np.cumsum(each) - each, data, rest, int(each.sum())
    )
    return products
