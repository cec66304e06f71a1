"""The search of an image for grids of circles: blobs, their lattices, and the grids that these are a part of."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rigkit.detection.circles.blobs import DUPLICATE, Blobs, find_blobs
from rigkit.detection.circles.find import MIN_CIRCLES, grid_of, is_large_enough
from rigkit.detection.circles.grid import CircleGrid
from rigkit.detection.saddles.response import GreyImage

if TYPE_CHECKING:
    from rigkit.detection.circles.lattices import LabelledBlobs


def find_grids(grey: GreyImage) -> list[CircleGrid]:
    """Return the grids of circles in `grey`, the largest first."""
    return CircleSearch(grey).grids()


class CircleSearch:
    """A search of an image that may be repeated more thoroughly; results that do not change are kept."""

    def __init__(self, grey: GreyImage) -> None:
        self.grey = grey
        self._blobs: dict[bool, Blobs] = {}
        self._lattices: dict[bool, list[LabelledBlobs]] = {}
        self._seen: list[tuple[Blobs, bool, CircleGrid | None]] = []

    def grids(self, min_circles: int = MIN_CIRCLES, *, quick: bool = False, coarse: bool = False) -> list[CircleGrid]:
        """Return the grids of at least `min_circles`, the largest first.

        `quick`: from blobs only, each fitted once. `coarse`: not those of small circles (`find_blobs`).
        """
        seen = self.seen(quick=quick, coarse=coarse)
        found = [grid for grid in seen if len(grid) >= min_circles and grid.evidence.convincing]
        return sorted(found, key=lambda grid: -len(grid))

    def seen(self, *, quick: bool = False, coarse: bool = False, whole: bool = False) -> list[CircleGrid]:
        """Return all lattices, or those that are `whole`, that may be grids, with their evidence."""
        out = []
        for found in self._labelled(coarse=coarse):
            if whole and not found.whole:
                continue
            own = self._blobs[coarse].chosen(found.index)
            earlier = [grid for blobs, fast, grid in self._seen if fast == quick and _same(blobs, own)]
            grid = earlier[0] if earlier else grid_of(self.grey, own, found, quick=quick)
            if not earlier:
                self._seen.append((own, quick, grid))
            if grid is not None:
                out.append(grid)
        return out

    def _labelled(self, *, coarse: bool) -> list[LabelledBlobs]:
        # scipy's graphs are imported here because they slow down the start of rigkit by a quarter.
        from rigkit.detection.circles.lattices import blob_lattices

        if coarse not in self._lattices:
            blobs = find_blobs(self.grey, coarse=coarse, known=None if coarse else self._blobs.get(True))
            self._blobs[coarse] = blobs
            self._lattices[coarse] = [found for found in blob_lattices(blobs) if is_large_enough(found.label)]
        return self._lattices[coarse]


def _same(blobs: Blobs, others: Blobs) -> bool:
    """Return whether two lattices are of the same circles, whose places on two levels differ by parts of a pixel."""
    from scipy.spatial import cKDTree

    if len(blobs) != len(others):
        return False
    distance, _ = cKDTree(others.pixels).query(blobs.pixels)
    return bool((distance < DUPLICATE * blobs.radius_px()).all())
