"""Intersect the rays of an image tile with rectangles in space."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.painting import TILE_NODES as NODES
from rigkit.kernels.painting import PaintedSurface, PaintedTile
from rigkit.synthetic.scene import Panel, PlacedBoard

RIM_MARGIN = 0.1
"""Margin in cosine of the nodes to the lens's rim for a whole tile to be inside: nodes do not reach the tile's edge."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Surface:
    """A rectangle in the camera frame: `plane_from_ray` maps a ray to (x, y, 1) / range in squares."""

    plane_from_ray: FloatArray
    low: FloatArray
    high: FloatArray
    cells: tuple[int, int] | None
    """(columns, rows) of inner corners if a chessboard is visible."""
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
    """Lower and upper end, in squares, of the black background of white discs; None: black discs."""

    @property
    def printed(self) -> bool:
        """Whether a pattern is visible."""
        return self.cells is not None or self.marks is not None or self.discs is not None

    def for_kernel(self) -> PaintedSurface:
        """Return the surface in the form of the kernel."""
        columns, rows = self.cells or (0, 0)
        marks, discs = (np.zeros((0, n)) if a is None else a for a, n in ((self.marks, 4), (self.discs, 3)))
        ground = np.zeros((0, 2, 2)) if self.ground is None else np.array([self.ground])
        return PaintedSurface.of(
            plane_from_ray=self.plane_from_ray,
            ends=np.array([self.low, self.high], np.float64),
            marks=marks,
            discs=discs,
            ground=ground,
            columns=columns,
            rows=rows,
            first_black=self.first_black,
            white=self.white,
            black=self.black,
            width_mm=self.squares_mm[0],
            height_mm=self.squares_mm[1],
        )


def board_surface(placed: PlacedBoard, cam_from_world: Rigid3) -> Surface:
    cam_from_board = cam_from_world @ placed.world_from_board
    board = placed.board
    low, high = placed.edge_squares()
    scale, ink = np.array(board.squares_mm), board.ink()
    # Inverted circles have a black background on white paper; other inverted patterns invert the paper as well.
    discs = bool(len(ink.circles))
    white, black = (placed.black, placed.white) if ink.inverted and not discs else (placed.white, placed.black)
    # The back of the paper has no pattern.
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
        # The camera is in the plane, and the rectangle invisible.
        return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return np.asarray(np.linalg.inv(forward))


class Chart:
    """The rays of a tile's sub-samples: interpolated by polynomials, or computed one by one at the lens's rim."""

    def __init__(
        self,
        u: _Axis,
        v: _Axis,
        nodes: FloatArray,
        rays: tuple[FloatArray, BoolArray] | None,
        field_deg: float | None,
        per_pixel: int,
    ) -> None:
        """Take the sub-samples' columns and rows, the rays at their nodes, and at the lens's rim every sub-sample's ray
        and whether it is inside."""
        self.shape = (len(v.samples), len(u.samples))
        self.u, self.v, self.nodes = u, v, nodes
        self.rays: FloatArray | None = None
        self.lit: BoolArray | None = None
        if rays is not None:
            self.rays, self.lit = rays
        if field_deg is not None:
            self._limit(np.cos(np.radians(0.5 * field_deg)))
        self.dark = self.lit is not None and not self.lit.any()
        self.tile = PaintedTile.of_rays(v.weights, u.across, nodes, self.rays, per_pixel)

    def _limit(self, cosine: float) -> None:
        """Darken sub-samples outside of the lens's field of view."""
        if self.rays is None and self.nodes[..., 2].min() > cosine + RIM_MARGIN:
            return
        forward = self._interpolate(self.nodes[..., 2]) if self.rays is None else self.rays[..., 2]
        with np.errstate(invalid="ignore"):
            inside = forward >= cosine
        if not inside.all():
            self.lit = inside if self.lit is None else self.lit & inside

    def _interpolate(self, nodes: FloatArray) -> FloatArray:
        """Return (rows, columns) from values at the nodes, (NODES, NODES)."""
        # einsum, not @: BLAS starts threads for matrices of this size, which is slower.
        return np.asarray(np.einsum("vj,ju->vu", np.einsum("vi,ij->vj", self.v.weights, nodes), self.u.across))


def charts_of(
    camera: Camera,
    columns: Sequence[FloatArray],
    rows: Sequence[FloatArray],
    field_deg: float | None,
    per_pixel: int,
) -> Iterator[Chart]:
    """Yield the charts of an image's tiles, row by row, from the columns u and the rows v of their sub-samples, px."""
    across, down = [_Axis.of(u) for u in columns], [_Axis.of(v) for v in rows]
    # One call for the nodes of all tiles is faster.
    rays, valid = _unproject(camera, *(np.concatenate([axis.nodes for axis in axes]) for axes in (across, down)))
    for i, v in enumerate(down):
        for k, u in enumerate(across):
            own = (slice(i * NODES, (i + 1) * NODES), slice(k * NODES, (k + 1) * NODES))
            each = None if valid[own].all() else _unproject(camera, u.samples, v.samples)
            yield Chart(u, v, np.ascontiguousarray(rays[own]), each, field_deg, per_pixel)


def _unproject(camera: Camera, u: FloatArray, v: FloatArray) -> tuple[FloatArray, BoolArray]:
    return camera.unproject(np.stack(np.meshgrid(u, v), axis=-1))


@dataclass(frozen=True, eq=False, slots=True)
class _Axis:
    """Sub-samples of a tile along an axis, Chebyshev nodes, and the interpolation weights (samples, NODES); `across` is
    their transpose."""

    samples: FloatArray
    nodes: FloatArray
    weights: FloatArray
    across: FloatArray

    @classmethod
    def of(cls, samples: FloatArray) -> _Axis:
        """Return the axis with Chebyshev nodes over the samples."""
        low, high = samples[0], samples[-1]
        angle = (2 * np.arange(NODES) + 1) * np.pi / (2 * NODES)
        nodes = 0.5 * (low + high) + 0.5 * (high - low) * np.cos(angle)
        barycentric = (-1.0) ** np.arange(NODES) * np.sin(angle)
        distance = samples[:, None] - nodes
        exact = np.abs(distance) < 1e-9
        with np.errstate(divide="ignore"):
            terms = np.where(exact.any(axis=1, keepdims=True), exact, barycentric / distance)
        weights = terms / terms.sum(axis=1, keepdims=True)
        return cls(samples, nodes, weights, np.ascontiguousarray(weights.T))
