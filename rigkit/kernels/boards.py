"""The kernels in board_places.c, boards.c and board_changes.c: the picture of a whole board, and what moves corners."""

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
    """What a picture changes by with each of N blocks of unknowns, which is nothing beyond a box.

    Attributes
    ----------
    boxes : (N, 4) the first column and row of each, and the last ones; without pixels where these are before the first.
    starts : (N,) where in `data` the changes by its first unknown begin, row by row; those of others follow.
    each : unknowns of every block.
    data : the changes.
    """

    boxes: IntArray
    starts: IntArray
    each: int
    data: Picture

    @staticmethod
    def empty(boxes: IntArray, each: int) -> Blocks:
        """Return blocks with room for the changes in the `boxes`."""
        sizes = areas(boxes)
        return Blocks(boxes, each * (np.cumsum(sizes) - sizes), each, np.empty(each * int(sizes.sum()), np.float32))


def areas(boxes: IntArray) -> IntArray:
    """Return the numbers of pixels in `boxes` (N, 4)."""
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2] + 1, 0)
    return np.asarray(sides[:, 0] * sides[:, 1], np.int64)


def board_places(coefficients: FloatArray, box: tuple[int, int, int, int], around: float) -> FloatArray:
    """Return the places (H, W, 2) along columns and rows, from the first node, NaN where no square is seen.

    Parameters
    ----------
    coefficients : (R + 2, C + 2, 2) of a cubic B-spline through the pixels of R x C nodes.
    box : first column and row of the picture in the image, its width and height.
    around : squares are looked for so far beside the box of their corners, in sides of that.
    """
    rows, columns = coefficients.shape[0] - 2, coefficients.shape[1] - 2
    return np.asarray(kernels().board_places(coefficients, rows, columns, *box, around))


def board_picture(
    places: FloatArray, size: tuple[int, int], ends: FloatArray, paper: FloatArray, sharp_px: float, planes: int = 11
) -> Picture:
    """Return the planes (11, H, W) of the picture of a board of R x C corners, `size`, blurred by `sharp_px` (api.h:
    BOARD_PLANES); or, of these `planes`, 1, the picture alone.

    `ends` (2, 2): where, in squares, it begins and ends along columns and along rows; `paper` (4,) what is beyond each
    of these, where squares are 1 and -1.
    """
    return np.asarray(kernels().board_picture(places, *size, ends, paper, sharp_px, planes))


def sheet_places(
    places: FloatArray, first: FloatArray, each: int, corners: BoolArray, reach: FloatArray
) -> tuple[Picture, BoolArray]:
    """Return columns and rows (2, H, W) of `places` (H, W, 2) on a sheet of `each` x `each` samples a square that
    begins at `first` (2,), and (2, H, W) which are nearest to one of the `corners` (2, R, C) and within `reach` (2,) of
    it along columns and rows."""
    found: tuple[Picture, BoolArray] = kernels().sheet_places(places, corners, first, each, reach)
    return found


@dataclass(frozen=True, eq=False, slots=True)
class Shares:
    """How much of the nodes of a grid there is at each pixel.

    Attributes
    ----------
    size : rows and columns of the grid.
    nodes : (H, W, 2) the first node along columns and rows of which there is some.
    weights : (H, W, 2, 4) of four nodes from that.
    boxes : (R * C, 4) of the pixels with some of each node, and a margin.
    """

    size: tuple[int, int]
    nodes: NDArray[np.int32]
    weights: Picture
    boxes: IntArray

    @staticmethod
    def at(
        places: FloatArray, size: tuple[int, int], *, spacing: float, beyond: float, cubic: bool, margin: int
    ) -> Shares:
        """Return those at `places` (H, W, 2), in squares, of nodes that are `spacing` squares apart.

        Between nodes the shares are those of a cubic, or of a straight line; up to `beyond` squares beyond the nodes
        the last two go on on a straight line.
        """
        return Shares(size, *kernels().board_shares(places, *size, spacing, beyond, cubic, margin))

    def interpolated(self, values: FloatArray) -> Picture:
        """Return `values` (K, R, C) at the nodes as pictures (K, H, W)."""
        return np.asarray(kernels().board_values(self.nodes, self.weights, values))


def move_blocks(shares: Shares, slopes: Picture, weight: Picture, taps: Picture) -> Blocks:
    """Return how a blurred picture changes as each of R x C corners moves along u and v, times `weight` (H, W).

    `slopes` (2, H, W) are those of the sharp picture along u and v, `taps` (2 K + 1,) the blur, for which the boxes of
    `shares` have their margin.
    """
    blocks = Blocks.empty(shares.boxes, 2)
    room = int(areas(blocks.boxes).max(initial=1))
    kernels().move_blocks(
        *(shares.nodes, shares.weights, *shares.size, slopes, weight, taps, len(taps) // 2),
        *(blocks.boxes, blocks.starts, room, blocks.data),
    )
    return blocks


def share_blocks(shares: Shares, planes: Picture) -> Blocks:
    """Return how a picture changes with values at nodes, that are interpolated and times `planes` (K, H, W)."""
    blocks = Blocks.empty(shares.boxes, len(planes))
    room = int(areas(blocks.boxes).max(initial=1))
    kernels().share_blocks(
        *(shares.nodes, shares.weights, *shares.size, planes, blocks.boxes, blocks.starts, room, blocks.data)
    )
    return blocks


def block_products(groups: Sequence[Blocks], rest: Picture) -> tuple[FloatArray, FloatArray]:
    """Return the products (U, U) of the changes by the unknowns of the groups, in order, and those with `rest`."""
    boxes = np.concatenate([group.boxes for group in groups])
    before = np.cumsum([0, *(len(group.data) for group in groups)])
    starts = np.concatenate([group.starts + at for group, at in zip(groups, before, strict=False)])
    each = np.concatenate([np.full(len(group.boxes), group.each, np.int64) for group in groups])
    data = np.concatenate([group.data for group in groups])
    products: tuple[FloatArray, FloatArray] = kernels().block_products(
        boxes, starts, each, np.cumsum(each) - each, data, rest, int(each.sum())
    )
    return products
