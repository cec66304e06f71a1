"""Where the rays of an image tile meet rectangles in space, and what they see there."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.synthetic.discs import MAX_CELL, MIN_CELL, covered_shares
from rigkit.synthetic.scene import Panel, PlacedBoard

Float32 = NDArray[np.float32]

NODES = 9
"""Chebyshev nodes a side on which a tile's rays are fitted: error below 1e-6 px for lenses with f >= 100 px."""
FAR_SQUARES = 1e4
"""Board coordinate given to rays that miss a board's plane."""
RIM_MARGIN = 0.1
"""Cosine by which the nodes must clear the lens's rim for a whole tile to be lit: they stop short of its edge."""
SMOOTH_DEPTH_RATIO = 0.5
"""Depth ratio over a tile above which x and y are fitted themselves: the fit's error is below 6 ** -NODES = 1e-7."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Surface:
    """A rectangle in the camera frame: `plane_from_ray` maps a ray to (x, y, 1) / range in squares."""

    plane_from_ray: FloatArray
    low: FloatArray
    high: FloatArray
    cells: tuple[int, int] | None
    """(columns, rows) of inner corners where there is a pattern to see."""
    white: float
    black: float
    first_black: bool = True
    distance_mm: float = field(default=0.0)
    marks: FloatArray | None = None
    """(M, 4) black rectangles on white squares: x, y, width, height in squares."""
    discs: FloatArray | None = None
    """(K, 3) discs: x, y, radius in mm."""
    squares_mm: tuple[float, float] = (1.0, 1.0)
    ground: tuple[FloatArray, FloatArray] | None = None
    """Lower and upper end, in squares, of the black ground of a print whose discs are white; None: black discs."""

    @property
    def printed(self) -> bool:
        """Whether there is a pattern to see."""
        return self.cells is not None or self.marks is not None or self.discs is not None


def board_surface(placed: PlacedBoard, cam_from_world: Rigid3) -> Surface:
    cam_from_board = cam_from_world @ placed.world_from_board
    board = placed.board
    low, high = placed.edge_squares()
    scale, ink = np.array(board.squares_mm), board.ink()
    # White circles lie on black ground on white paper; of all else black and white are exchanged, with the paper.
    discs = bool(len(ink.circles))
    white, black = (placed.black, placed.white) if ink.inverted and not discs else (placed.white, placed.black)
    # Behind the paper there is no pattern.
    front = float(cam_from_board.rotation[:, 2] @ cam_from_board.translation_mm) > 0.0
    centre = cam_from_board.apply(board.points()).mean(axis=0)
    return Surface(
        plane_from_ray=_plane_from_ray(cam_from_board, scale),
        low=low,
        high=high,
        cells=board.size if front and ink.first_black is not None else None,
        white=white,
        black=black,
        first_black=bool(ink.first_black) and placed.first_black,
        distance_mm=float(np.linalg.norm(centre)),
        marks=ink.rectangles / np.tile(scale, 2) if front and len(ink.rectangles) else None,
        discs=ink.circles if front and discs else None,
        squares_mm=board.squares_mm,
        ground=board.pattern.outline(*board.size) if front and ink.inverted and discs else None,
    )


def panel_surface(panel: Panel, cam_from_world: Rigid3) -> Surface:
    half = np.array([0.5, 0.5])
    scale = np.array([panel.width_mm, panel.height_mm])
    matrix = _plane_from_ray(cam_from_world @ panel.world_from_panel, scale)
    return Surface(
        plane_from_ray=matrix, low=-half, high=half, cells=None, white=panel.reflectance, black=panel.reflectance
    )


def _plane_from_ray(cam_from_plane: Rigid3, scale: FloatArray) -> FloatArray:
    """Return M with M @ ray ~ (x, y, 1), the third entry positive where the ray meets the plane in front."""
    rotation, translation = cam_from_plane.rotation, cam_from_plane.translation_mm
    forward = np.stack([rotation[:, 0] * scale[0], rotation[:, 1] * scale[1], translation], axis=1)
    if abs(np.linalg.det(forward)) < 1e-9 * scale.prod():
        # The camera lies in the plane: the rectangle is a line, nothing of it is seen.
        return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return np.asarray(np.linalg.inv(forward))


NOT_COVERED, PART, FULL = 0, 1, 2


class Chart:
    """Where the sub-samples of a tile meet a plane; polynomial where the lens is smooth, ray by ray at its rim."""

    def __init__(
        self, u: _Axis, v: _Axis, nodes: FloatArray, rays: tuple[FloatArray, BoolArray] | None, field_deg: float | None
    ) -> None:
        """Take the sub-samples' columns and rows, the rays at their nodes, and at the lens's rim the ray and the light
        of every sub-sample."""
        self.shape = (len(v.samples), len(u.samples))
        self.weight_v = v.weights
        self.weight_u = np.ascontiguousarray(u.weights.T)
        self.nodes = nodes
        self.rays: FloatArray | None = None
        self.lit: BoolArray | None = None
        if rays is not None:
            self.rays, self.lit = rays
        if field_deg is not None:
            self._limit(np.cos(np.radians(0.5 * field_deg)))
        self.dark = self.lit is not None and not self.lit.any()

    def _limit(self, cosine: float) -> None:
        """Darken what lies farther from the axis than the lens reaches."""
        if self.rays is None and self.nodes[..., 2].min() > cosine + RIM_MARGIN:
            return
        forward = self._interpolate(self.nodes[None, ..., 2])[0] if self.rays is None else self.rays[..., 2]
        with np.errstate(invalid="ignore"):
            inside = forward >= cosine
        if not inside.all():
            self.lit = inside if self.lit is None else self.lit & inside

    def cover(self, surface: Surface) -> int:
        """Say how much of the tile the rectangle may cover; errs towards a part."""
        if self.rays is not None:
            return PART
        plane = self.nodes @ surface.plane_from_ray.T
        front = plane[..., 2] > 1e-9
        if not front.any():
            return NOT_COVERED
        if not front.all():
            return PART
        xy = plane[..., :2] / plane[..., 2:]
        low, high = xy.min(axis=(0, 1)), xy.max(axis=(0, 1))
        # Chebyshev nodes stop short of the tile's border; half the range more is ample.
        pad = 0.5 * (high - low)
        if not ((high + pad >= surface.low) & (low - pad <= surface.high)).all():
            return NOT_COVERED
        inside = ((low - pad >= surface.low) & (high + pad <= surface.high)).all()
        return FULL if inside else PART

    def locate(self, matrix: FloatArray, rows: slice, columns: slice) -> FloatArray:
        """Return x and y in the plane for some rows and columns of sub-samples, (2, rows, columns).

        FAR where the plane is not met.
        """
        if self.rays is not None:
            return _divide(np.einsum("kc,vuc->kvu", matrix, self.rays[rows, columns]))
        plane = np.einsum("kc,ijc->kij", matrix, self.nodes)
        # The horizon is far: then x and y are polynomials themselves.
        smooth = plane[2].min() > SMOOTH_DEPTH_RATIO * plane[2].max()
        nodes = plane[:2] / plane[2] if smooth else plane
        out = self._interpolate(nodes, rows, columns)
        return out if smooth else _divide(out)

    def _interpolate(self, nodes: FloatArray, rows: slice = slice(None), columns: slice = slice(None)) -> FloatArray:
        """Return (k, rows, columns) from values at the nodes, (k, NODES, NODES)."""
        # einsum, not @: BLAS starts threads for matrices of this size, which cost far more than they gain.
        lines = np.einsum("vi,kij->kvj", self.weight_v[rows], nodes)
        return np.asarray(np.einsum("kvj,ju->kvu", lines, self.weight_u[:, columns]))


def charts_of(
    camera: Camera, columns: Sequence[FloatArray], rows: Sequence[FloatArray], field_deg: float | None
) -> Iterator[Chart]:
    """Return the charts of an image's tiles, row by row, from the columns u and the rows v of their sub-samples, px."""
    across, down = [_Axis.of(u) for u in columns], [_Axis.of(v) for v in rows]
    # The nodes of all tiles at once: a lens is asked many pixels as fast as few.
    rays, valid = _unproject(camera, *(np.concatenate([axis.nodes for axis in axes]) for axes in (across, down)))
    for i, v in enumerate(down):
        for k, u in enumerate(across):
            own = (slice(i * NODES, (i + 1) * NODES), slice(k * NODES, (k + 1) * NODES))
            each = None if valid[own].all() else _unproject(camera, u.samples, v.samples)
            yield Chart(u, v, np.ascontiguousarray(rays[own]), each, field_deg)


def _unproject(camera: Camera, u: FloatArray, v: FloatArray) -> tuple[FloatArray, BoolArray]:
    return camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))


def _divide(plane: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        front = plane[2] > 1e-9
        return np.where(front, plane[:2] / plane[2], FAR_SQUARES)


@dataclass(frozen=True, eq=False, slots=True)
class _Axis:
    """Sub-samples of a tile along an axis, nodes that span them, and the weights (samples, NODES) that interpolate."""

    samples: FloatArray
    nodes: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, samples: FloatArray) -> _Axis:
        """Lay Chebyshev nodes over the samples."""
        low, high = samples[0], samples[-1]
        angle = (2 * np.arange(NODES) + 1) * np.pi / (2 * NODES)
        nodes = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(angle)
        barycentric = (-1.0) ** np.arange(NODES) * np.sin(angle)
        distance = samples[:, None] - nodes
        exact = np.abs(distance) < 1e-9
        with np.errstate(divide="ignore"):
            terms = np.where(exact.any(axis=1, keepdims=True), exact, barycentric / distance)
        return cls(samples, nodes, terms / terms.sum(axis=1, keepdims=True))


def paint(fine: Float32, surface: Surface, chart: Chart, per_pixel: int) -> None:
    """Lay a rectangle and its pattern over `fine` in place."""
    every = slice(None, None, per_pixel)
    coarse_x, coarse_y = chart.locate(surface.plane_from_ray, every, every)
    box = _bounding_box(coarse_x, coarse_y, surface, per_pixel)
    if box is None:
        return
    axes = chart.locate(surface.plane_from_ray, *box).astype(np.float32)
    cells = [_cells(axis, per_pixel) for axis in axes]
    target = fine[box]
    sheet = [_inside(a, c, surface.low[k], surface.high[k]) for k, (a, c) in enumerate(zip(axes, cells, strict=True))]
    share = sheet[0] * sheet[1]
    target += share * (np.float32(surface.white) - target)
    if surface.cells is not None:
        _paint_squares(target, axes, cells, surface)
    if surface.marks is not None:
        _paint_marks(target, axes, cells, surface)
    if surface.discs is not None:
        _paint_discs(target, axes, cells, surface)


def _paint_squares(target: Float32, axes: Float32, cells: list[_Cells], surface: Surface) -> None:
    """Blacken every other square of a surface with inner corners in `target`."""
    (in_x, wave_x), (in_y, wave_y) = (
        _squares(a, c, count) for a, c, count in zip(axes, cells, surface.cells or (0, 0), strict=True)
    )
    # Both waves are -1 on the square before the first inner corner.
    wave_x *= wave_y
    if not surface.first_black:
        np.negative(wave_x, out=wave_x)
    wave_x += in_x * in_y
    wave_x *= np.float32(0.5 * (surface.black - surface.white))
    target += wave_x


def _paint_discs(target: Float32, axes: Float32, cells: list[_Cells], surface: Surface) -> None:
    """Paint the discs of a surface into `target`, on their ground."""
    discs = np.zeros((0, 3)) if surface.discs is None else surface.discs
    change = np.float32(surface.black - surface.white)
    if surface.ground is not None:
        low, high = surface.ground
        ground = [_inside(a, c, low[k], high[k]) for k, (a, c) in enumerate(zip(axes, cells, strict=True))]
        target += change * ground[0] * ground[1]
        change = -change
    target += change * covered_shares(axes, discs, surface.squares_mm)


def _paint_marks(target: Float32, axes: Float32, cells: list[_Cells], surface: Surface) -> None:
    """Blacken the rectangles of a surface in `target`; they touch, but do not overlap."""
    marks = np.zeros((0, 4)) if surface.marks is None else surface.marks
    per_pixel = cells[0].per_pixel
    least, most = (_of_pixels(axes, extent, per_pixel) for extent in (np.minimum, np.maximum))
    reach = [c.reach for c in cells]
    low, high = marks[:, :2] - reach, marks[:, :2] + marks[:, 2:] + reach
    seen = (high > least.min(axis=(1, 2))).all(axis=1) & (low < most.max(axis=(1, 2))).all(axis=1)
    for n in np.flatnonzero(seen):
        near = (most[0] > low[n, 0]) & (least[0] < high[n, 0]) & (most[1] > low[n, 1]) & (least[1] < high[n, 1])
        rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
        if not len(rows):
            continue
        # In whole pixels, as the cells' sides are.
        pixels = tuple(slice(k[0], k[-1] + 1) for k in (rows, columns))
        box = tuple(slice(k[0] * per_pixel, (k[-1] + 1) * per_pixel) for k in (rows, columns))
        across, down = (
            _inside(axes[k][box], cells[k].of(pixels), marks[n, k], marks[n, k] + marks[n, k + 2]) for k in (0, 1)
        )
        target[box] += np.float32(surface.black - surface.white) * across * down


def _of_pixels(axes: Float32, extent: np.ufunc, per_pixel: int) -> Float32:
    """Return the least or the most of every pixel's sub-samples."""
    across = functools.reduce(extent, [axes[..., k::per_pixel] for k in range(per_pixel)])
    return np.asarray(functools.reduce(extent, [across[:, k::per_pixel] for k in range(per_pixel)]))


def _bounding_box(cx: FloatArray, cy: FloatArray, surface: Surface, per_pixel: int) -> tuple[slice, slice] | None:
    """Return the sub-samples of a tile that can meet the rectangle, in whole pixels, or None.

    `cx`, `cy` : where the first sub-sample of every pixel meets the plane.
    """
    if min(cx.shape) < 2:
        return (slice(None), slice(None))
    # A rectangle narrower than a pixel falls between the corners: look a pixel further along each axis.
    step_x, step_y = (np.hypot(*np.gradient(c)) for c in (cx, cy))
    near = (
        (cx >= surface.low[0] - step_x)
        & (cx <= surface.high[0] + step_x)
        & (cy >= surface.low[1] - step_y)
        & (cy <= surface.high[1] + step_y)
    )
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    if not len(rows):
        return None
    # _cells needs two pixels along each axis.
    v, u = (slice(max(int(k[0]) - 1, 0) * per_pixel, (int(k[-1]) + 2) * per_pixel) for k in (rows, columns))
    return (v, u)


@dataclass(frozen=True, eq=False, slots=True)
class _Cells:
    """How far a coordinate of the plane moves across the sub-samples' cells of each pixel, constant within a pixel.

    A cell is a parallelogram to the coordinate: the sum of two boxes, one from its side along u and one from that
    along v. Only so do the cells' shares of an edge's two sides add up, whatever the edge's direction.
    """

    wide: Float32
    """(rows, columns) of pixels: the longer of the two boxes."""
    narrow: Float32
    per_pixel: int
    reach: float
    """No cell extends further from its middle."""

    def of(self, pixels: tuple[slice, ...]) -> _Cells:
        return _Cells(self.wide[pixels], self.narrow[pixels], self.per_pixel, self.reach)

    def beyond(self, distance: Float32) -> Float32:
        """Return the share of each cell beyond an edge less 1/2, from the middles' distances (rows, columns) from it.

        The integral of a trapezoid: it rises over the narrow box, is flat, and falls over the narrow box.
        """
        out = np.copysign(np.float32(0.5), distance)
        far = np.abs(distance)
        row, column = np.divmod(np.flatnonzero(far < self.reach), distance.shape[1])
        pixel = row // self.per_pixel * self.wide.shape[1] + column // self.per_pixel
        wide, narrow = self.wide.ravel()[pixel], self.narrow.ravel()[pixel]
        far = far[row, column]
        slope = np.clip(far - np.float32(0.5) * (wide - narrow), np.float32(0.0), narrow)
        share = np.minimum(far, np.float32(0.5) * (wide + narrow)) - slope * slope / (np.float32(2.0) * narrow)
        out[row, column] = np.copysign(share / wide, out[row, column])
        return np.asarray(out)


def _cells(axis: Float32, per_pixel: int) -> _Cells:
    down, right = np.gradient(axis[::per_pixel, ::per_pixel])
    sides = np.abs(np.stack([down, right])) / np.float32(per_pixel)
    boxes = np.clip(sides, MIN_CELL, MAX_CELL).astype(np.float32)
    wide, narrow = boxes.max(axis=0), boxes.min(axis=0)
    return _Cells(wide, narrow, per_pixel, 0.5 * float((wide + narrow).max()))


def _inside(axis: Float32, cells: _Cells, low: float, high: float) -> Float32:
    """Return the share of each cell with low <= axis <= high."""
    if axis.min() - cells.reach > low and axis.max() + cells.reach < high:
        return np.ones((1, 1), dtype=np.float32)
    share = cells.beyond(np.minimum(np.float32(high) - axis, axis - np.float32(low)))
    share += np.float32(0.5)
    return share


def _squares(axis: Float32, cells: _Cells, count: int) -> tuple[Float32, Float32]:
    """Return, averaged over each cell, the indicator of -1 <= axis <= count and the wave within it.

    The wave is +1 on [0, 1), changes sign at every inner corner 0 .. count - 1, and is 0 outside [-1, count].
    A cell is narrower than a square, so it meets one edge at most.
    """
    inside = _inside(axis, cells, -1.0, float(count))
    # Triangle wave: 0 at every corner, slope +-1 there, positive on [0, 1).
    wave = (axis - np.float32(0.5)) * np.float32(0.5)
    wave -= np.rint(wave)
    np.abs(wave, out=wave)
    wave *= np.float32(-2.0)
    wave += np.float32(0.5)
    wave = cells.beyond(wave)
    wave *= np.float32(2.0)
    if inside.size > 1:
        last = np.float32(1.0 if count % 2 else -1.0)
        wave = np.where(axis < -0.5, -inside, np.where(axis > count - 0.5, last * inside, wave))
    return inside, wave
