"""The corners of an image on all levels of its pyramid, and those sets of them in which lattices are searched."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rigkit.detection.lattice.lattice import MIN_ROWS
from rigkit.detection.saddles.response import GreyImage, Level, enlarged_level, pyramid
from rigkit.detection.saddles.saddle import Corners, Saddles, dense, each_once, find_corners, joined, with_finer

FINE_CORNERS = 9
"""Fewest saddles, and corners at twice the resolution, in 3 x 3 cells (`saddle.dense`) of a board whose squares are too
small for the finest level: it has 12 there or more, of which a quarter may be missed. In 100 RENDERED images of 4 and 8
MP with squares of 5 to 12 px, foreshortened up to twice, none of 80 boards is lost; 15 saddles lose four of 56."""


@dataclass(frozen=True, eq=False, slots=True)
class SearchedImage:
    """An image in grey levels, the finest level of its pyramid, the levels searched, and the corners found in them.

    If `enlarged`, the first of the levels has twice the resolution of the finest one of the pyramid.
    """

    grey: GreyImage
    finest: Level
    levels: list[Level]
    corners: Corners
    saddles: Saddles
    enlarged: bool = False

    @classmethod
    def of(cls, grey: GreyImage) -> SearchedImage:
        levels = pyramid(grey)
        return cls(grey, levels[0], levels, *find_corners(levels))

    def with_enlarged(self) -> SearchedImage:
        """Return this with the corners at twice the resolution, for small squares and narrow white lines beside
        markers."""
        level = enlarged_level(self.grey)
        # Enlargement by interpolation does not make edges sharper.
        finest = level if level.scale >= 1.0 else self.finest
        return SearchedImage(self.grey, finest, [level, *self.levels], *with_finer(level, self.saddles), enlarged=True)

    def with_fine_squares(self) -> SearchedImage | None:
        """Return `with_enlarged` with those corners that are as dense as those of squares too small for the finest
        level; None if there are none."""
        level = self.levels[0]
        if not dense(self.saddles.points[0], level, FINE_CORNERS).any():
            return None
        enlarged = self.with_enlarged()
        fine = dense(enlarged.corners.pixels, level, FINE_CORNERS)
        return replace(enlarged, corners=enlarged.corners.of(fine)) if fine.any() else None

    def coarser(self, without: int) -> SearchedImage | None:
        """Return the corners of the coarser levels only, `without` the finest ones; None if there are too few.

        With saturation or thin print bright squares merge at the corners, with spreading ink dark ones. The borders of
        the quadrants are then off the lines, by an angle that decreases with the radius of the ring. Since dots look
        like squares on coarser levels, lattices are tested on the finest one.
        """
        corners = each_once(self.saddles.by_level[without:])
        if len(corners) < MIN_ROWS**2:
            return None
        return replace(self, levels=self.levels[without:], corners=corners)

    def with_smeared(self) -> SearchedImage:
        """Return this with the corners that only motion blur explains added."""
        return replace(self, corners=joined([self.corners, self.saddles.smeared]))
