"""The kernels in painting.c: rendering of rectangles into the sub-samples of a tile, and their reduction to pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

TILE_NODES, NOT_COVERED, COVERED_PARTLY, COVERED_WHOLLY = (
    header().constants[name] for name in ("TILE_NODES", "NOT_COVERED", "COVERED_PARTLY", "COVERED_WHOLLY")
)

Float32 = NDArray[np.float32]


@structure("tile_t")
class PaintedTile(Struct):
    """The sub-samples of `synthetic.raycast.Chart`."""

    @classmethod
    def of_rays(
        cls, weights_v: FloatArray, weights_u: FloatArray, nodes: FloatArray, rays: FloatArray | None, per_pixel: int
    ) -> PaintedTile:
        """Return a tile with weights (rows, TILE_NODES) and (TILE_NODES, columns); `rays` (rows, columns, 3), None:
        they are interpolated from those at the `nodes` (TILE_NODES, TILE_NODES, 3)."""
        given_rays = np.empty((0, weights_u.shape[1], 3)) if rays is None else rays
        return cls.of(weights_v=weights_v, weights_u=weights_u, nodes=nodes, rays=given_rays, per_pixel=per_pixel)


@structure("surface_t")
class PaintedSurface(Struct):
    """The rectangle of a `synthetic.raycast.Surface`."""


def tile_cover(tile: PaintedTile, surface: PaintedSurface) -> int:
    """Return whether the rectangle covers the tile, one of the three constants; in doubt COVERED_PARTLY."""
    return int(kernels().tile_cover(tile, surface))


def paint_surface(fine: Float32, tile: PaintedTile, surface: PaintedSurface) -> None:
    """Render a rectangle and its pattern into the sub-samples `fine` (rows, columns) of a tile, IN PLACE."""
    if not kernels().paint_surface(fine, tile, surface):
        raise MemoryError("no memory for the sub-samples of a tile")


def reduce_tile(fine: Float32, kernel: Float32, per_pixel: int, shape: tuple[int, int]) -> Float32:
    """Return the pixels (height, width = `shape`) of sub-samples `fine`: along each axis the `kernel` is applied from
    `per_pixel` times the pixel's index on."""
    return np.asarray(kernels().reduce_tile(fine, kernel, per_pixel, *shape))
