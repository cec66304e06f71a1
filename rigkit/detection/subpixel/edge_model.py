"""A model of the brightness around a chessboard corner, with eleven parameters.

    I(p) = (1 + g . (p - c)) (a + b S(d1 / s) S(d2 / s))

with d1, d2 the distances of pixel p from the two lines through the corner, a and b mean brightness and half contrast, g
the gradient of the light. S is a step edge blurred by a Gaussian lens and the square pixel, with a total standard
deviation s. The lines are curved, since the bent rows of a fisheye would otherwise bias the corner. Parameters: corner
(2), angles of the lines (2), s, a, b, g (2), curvatures (2).

For the corner of an isolated square, on the sides n1 and n2 (+1, -1) of the lines, S1 S2 is replaced by S1 S2 + n2 S1 +
n1 S2, and the contrast is 4 b.

Except for curvature and light the model is symmetric about the corner. Other model errors (the shape of the blur,
sharpening) therefore do not bias the corner, but increase the residuals and thus the predicted sigma.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray

TAIL_SIGMAS = 3.0
"""Reach of an edge's blur, in s: beyond, its light is below a 700th. Edges of neighbouring lines within it are part of
the model."""

PIXEL_KURTOSIS = -1.0 / 120.0
"""Fourth cumulant of a uniform distribution of width 1, that of a pixel's square along its sides, px^4."""

SHARP_BLUR_PX = 0.6
"""Below this s the square of the pixel is modelled exactly: the series in its cumulants is wrong by half a grey level
at s = 0.4."""

WINDOW_REACH = 0.5
"""Half size of the window in sides of the cell: windows of neighbouring corners touch but do not overlap, so that every
pixel is used and the errors of neighbours are independent."""

NEAR_PX = 1.5
"""Largest distance of used pixels from one of the lines, in px beyond TAIL_SIGMAS: others carry no information on the
corner."""

END_SIGMAS = 2.5
MIN_REACH = 0.25
"""At the border of the lattice the image beyond the next line is unknown (paper, a narrow margin, another square).
Pixels closer than END_SIGMAS to that line are not used, except those within MIN_REACH of the distance to it."""

PAPER_SIGMAS = 0.0
"""As END_SIGMAS if the brightness beyond the line is known: all pixels up to the line are used."""


NEIGHBOUR_LINES = ((-1, 0), (1, 0), (0, 1), (0, -1))
"""Offsets, in rows and columns, of the corners on the lines before and after line 1 and line 2."""


@dataclass(frozen=True, eq=False, slots=True)
class Geometry:
    """The geometry of N corners from the lattice.

    Attributes
    ----------
    sides : (N, 2, 2) sides of the cell along column and row, px: directions of line 1 and 2, and size of the window.
    curvature : (N, 2) of the two lines, 1/px, positive towards +90 degrees.
    gaps : (N, 2, 2) distance of the neighbouring lines before and after line 1 and line 2 (along +90 degrees), px.
    ends : (N, 2, 2) whether the lattice has no neighbouring corner on that line.
    reach : (N, 2, 2) extent of the window towards that line, in sides of the cell, at most WINDOW_REACH; None: the
        default.
    paper : (N, 2, 2) brightness beyond that line, relative to the corner's mean and in units of the model's b; NaN if
        squares continue, or if it is unknown. None: all NaN.
    tilts : (N, 2, 2) angle between that line and the line through this corner, towards +90 degrees, rad; None: 0.
    window_blur : (N,) s for which windows are made, smaller if there are other structures near the lines. None: the
        expected s.
    single : (N, 2) for the corner of an isolated square, its side of line 1 and 2, +1 towards +90 degrees or -1; 0
        where four squares meet. None: all 0.
    """

    sides: FloatArray
    curvature: FloatArray
    gaps: FloatArray
    ends: BoolArray
    _: KW_ONLY
    reach: FloatArray | None = None
    paper: FloatArray | None = None
    tilts: FloatArray | None = None
    single: FloatArray | None = None
    window_blur: FloatArray | None = None

    def of(self, which: BoolArray) -> Geometry:
        """Return the geometry of the corners `which` (N,)."""
        optional = {"reach": self.reach, "paper": self.paper, "tilts": self.tilts, "single": self.single}
        optional["window_blur"] = self.window_blur
        known = {name: part[which] for name, part in optional.items() if part is not None}
        return Geometry(self.sides[which], self.curvature[which], self.gaps[which], self.ends[which], **known)


def tilted(geometry: Geometry, cells: BoolArray) -> Geometry:
    """Return the `geometry` of the `cells` (R, C) of a lattice with `tilts`, and with `gaps` along the corner's normal.

    The given gaps refer to the neighbouring corners, which are at an angle. Beyond the ends of the lattice the tilts of
    the opposite side are extrapolated.
    """
    sides = np.full((cells.shape[0] + 2, cells.shape[1] + 2, 2, 2), np.nan)
    row, column = np.nonzero(cells)
    length = np.sqrt((geometry.sides**2).sum(axis=2, keepdims=True))
    # Coincident neighbours have no direction.
    own = geometry.sides / np.where(length > 0.0, length, np.nan)
    sides[1:-1, 1:-1][cells] = own
    tilts = np.empty(geometry.gaps.shape)
    for k, ((down, right), line) in enumerate(zip(NEIGHBOUR_LINES, (0, 0, 1, 1), strict=True)):
        there, here = sides[row + 1 + down, column + 1 + right, line], own[:, line]
        tilts[:, line, k % 2] = here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]
    tilts = np.where(np.isnan(tilts), -tilts[:, :, ::-1], tilts)
    tilts[np.isnan(tilts)] = 0.0
    # Offset along line 1 and 2 of the next corner along row and column.
    aslant = (geometry.sides[:, ::-1] * own).sum(axis=2) * (1.0, -1.0)
    return replace(geometry, gaps=geometry.gaps - tilts * aslant[:, :, None], tilts=tilts)


def ends_of(known: BoolArray, cells: BoolArray) -> BoolArray:
    """Return the `ends` (M, 2, 2) of the `cells` of a lattice whose corners (R, C) are `known`."""
    ends = np.ones((*known.shape, 4), np.bool_)
    unknown = ~known
    ends[1:, :, 0], ends[:-1, :, 1] = unknown[:-1], unknown[1:]
    ends[:, :-1, 2], ends[:, 1:, 3] = unknown[:, 1:], unknown[:, :-1]
    return ends[cells].reshape(-1, 2, 2)
