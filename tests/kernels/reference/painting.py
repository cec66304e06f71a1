"""The kernels of painting.c in numpy: rectangles painted into all sub-samples of a tile, these reduced to pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.kernels.painting import COVERED_PARTLY, COVERED_WHOLLY, NOT_COVERED, Float32
from rigkit.synthetic.raycast import Chart, Surface

FAR_SQUARES = 1e4
"""Board coordinate given to rays that miss a board's plane."""
SMOOTH_DEPTH_RATIO = 0.5
"""Depth ratio over a tile above which x and y are interpolated themselves."""
MIN_CELL, MAX_CELL = 1e-6, 2.0
"""A cell's side, in squares or panel sides."""


def reduced(fine: Float32, kernel: Float32, per_pixel: int, shape: tuple[int, int]) -> FloatArray:
    """Return the pixels (height, width = `shape`) of sub-samples."""
    down, across = (np.zeros((count, size)) for count, size in zip(shape, fine.shape, strict=True))
    for matrix in (down, across):
        for pixel, row in enumerate(matrix):
            row[pixel * per_pixel : pixel * per_pixel + len(kernel)] = kernel
    return np.asarray(down @ fine @ across.T)


def paint(fine: Float32, surface: Surface, chart: Chart, per_pixel: int) -> None:
    """Lay a rectangle and its pattern over `fine` in place."""
    axes = locate(chart, surface.plane_from_ray).astype(np.float32)
    cells = [Cells.of(axis, per_pixel) for axis in axes]
    share = _within(axes, cells, surface.low, surface.high)
    fine += share * (np.float32(surface.white) - fine)
    change = np.float32(surface.black - surface.white)
    if surface.cells is not None:
        (in_x, wave_x), (in_y, wave_y) = (
            _squares(a, c, count) for a, c, count in zip(axes, cells, surface.cells, strict=True)
        )
        # Both waves are -1 on the square before the first inner corner.
        sign = np.float32(1.0 if surface.first_black else -1.0)
        fine += np.float32(0.5) * change * (sign * wave_x * wave_y + in_x * in_y)
    for mark in () if surface.marks is None else surface.marks:
        fine += change * _within(axes, cells, mark[:2], mark[:2] + mark[2:])
    if surface.discs is not None:
        if surface.ground is not None:
            fine += change * _within(axes, cells, *surface.ground)
            change = -change
        fine += change * _covered_shares(axes, surface.discs, surface.squares_mm)


def cover(surface: Surface, chart: Chart) -> int:
    """Return how much of the tile the rectangle may cover; errs towards a part."""
    if chart.rays is not None:
        return COVERED_PARTLY
    plane = chart.nodes @ surface.plane_from_ray.T
    front = plane[..., 2] > 1e-9
    if not front.all():
        return COVERED_PARTLY if front.any() else NOT_COVERED
    xy = plane[..., :2] / plane[..., 2:]
    low, high = xy.min(axis=(0, 1)), xy.max(axis=(0, 1))
    pad = 0.5 * (high - low)
    if not ((high + pad >= surface.low) & (low - pad <= surface.high)).all():
        return NOT_COVERED
    wholly = ((low - pad >= surface.low) & (high + pad <= surface.high)).all()
    return COVERED_WHOLLY if wholly else COVERED_PARTLY


def locate(chart: Chart, matrix: FloatArray) -> FloatArray:
    """Return x and y in the plane of all sub-samples, (2, rows, columns), FAR where the plane is not met."""
    if chart.rays is not None:
        return _divide(np.einsum("kc,vuc->kvu", matrix, chart.rays))
    plane = np.einsum("kc,ijc->kij", matrix, chart.nodes)
    # The horizon is far: then x and y are polynomials themselves.
    smooth = plane[2].min() > SMOOTH_DEPTH_RATIO * plane[2].max()
    out = np.asarray(chart.v.weights @ (plane[:2] / plane[2] if smooth else plane) @ chart.u.across)
    return out if smooth else _divide(out)


def _divide(plane: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        front = plane[2] > 1e-9
        return np.where(front, plane[:2] / plane[2], FAR_SQUARES)


@dataclass(frozen=True, eq=False, slots=True)
class Cells:
    """How far a coordinate of the plane moves across the cell of each sub-sample, constant within a pixel.

    A cell is a parallelogram to the coordinate: the sum of two boxes, one from its side along u and one from that
    along v. Only so do the cells' shares of an edge's two sides add up, whatever the edge's direction.
    """

    wide: Float32
    """(rows, columns) of sub-samples: the longer of the two boxes."""
    narrow: Float32

    @classmethod
    def of(cls, axis: Float32, per_pixel: int) -> Cells:
        slopes = np.array(np.gradient(axis[::per_pixel, ::per_pixel]), np.float32) / np.float32(per_pixel)
        return cls.of_sides(np.clip(np.kron(slopes, np.ones((per_pixel, per_pixel), np.float32)), -MAX_CELL, MAX_CELL))

    @classmethod
    def of_sides(cls, sides: Float32) -> Cells:
        boxes = np.maximum(np.abs(sides), MIN_CELL).astype(np.float32)
        return cls(boxes.max(axis=0), boxes.min(axis=0))

    def beyond(self, distance: Float32) -> Float32:
        """Return the share of each cell beyond an edge less 1/2, from the middles' distances (rows, columns) from it.

        The integral of a trapezoid: it rises over the narrow box, is flat, and falls over the narrow box.
        """
        far = np.abs(distance)
        slope = np.clip(far - 0.5 * (self.wide - self.narrow), 0.0, self.narrow)
        share = (np.minimum(far, 0.5 * (self.wide + self.narrow)) - slope * slope / (2.0 * self.narrow)) / self.wide
        return np.asarray(np.copysign(share, distance), np.float32)


def _within(axes: Float32, cells: list[Cells], low: FloatArray, high: FloatArray) -> Float32:
    """Return the share of each cell in a rectangle."""
    shares = [
        np.float32(0.5) + c.beyond(np.minimum(np.float32(high[k]) - a, a - np.float32(low[k])))
        for k, (a, c) in enumerate(zip(axes, cells, strict=True))
    ]
    return np.asarray(shares[0] * shares[1])


def _squares(axis: Float32, cells: Cells, count: int) -> tuple[Float32, Float32]:
    """Return, averaged over each cell, the indicator of -1 <= axis <= count and the wave within it.

    The wave is +1 on [0, 1), changes sign at every inner corner 0 .. count - 1, and is 0 outside [-1, count].
    A cell is narrower than a square, so it meets one edge at most.
    """
    inside = np.float32(0.5) + cells.beyond(np.minimum(np.float32(count) - axis, axis - np.float32(-1.0)))
    # Triangle wave: 0 at every corner, slope +-1 there, positive on [0, 1).
    wave = (axis - np.float32(0.5)) * np.float32(0.5)
    wave = 2.0 * cells.beyond(np.float32(0.5) - np.float32(2.0) * np.abs(wave - np.rint(wave)))
    last = np.float32(1.0 if count % 2 else -1.0)
    return inside, np.where(axis < -0.5, -inside, np.where(axis > count - 0.5, last * inside, wave))


def _covered_shares(axes: Float32, discs: FloatArray, squares_mm: tuple[float, float]) -> Float32:
    """Return (rows, columns) the share of each cell that `discs` (K, 3), x, y and radius in mm, cover.

    They do not overlap. A cell is a parallelogram; to a disc's edge, taken as straight within it, it is the sum of two
    boxes.
    """
    x, y = (axis * np.float32(side) for axis, side in zip(axes, squares_mm, strict=True))
    slopes = [
        [np.clip(slope, -MAX_CELL, MAX_CELL) * np.float32(side) for slope in np.gradient(axis)]
        for axis, side in zip(axes, squares_mm, strict=True)
    ]
    out = np.zeros(x.shape, np.float32)
    for u, v, radius in discs.astype(np.float32):
        from_centre = np.maximum(np.hypot(x - u, y - v), np.float32(1e-9))
        sides = np.stack([((x - u) * sx + (y - v) * sy) / from_centre for sx, sy in zip(*slopes, strict=True)])
        out = np.maximum(out, np.float32(0.5) + Cells.of_sides(sides).beyond(radius - from_centre))
    return out
