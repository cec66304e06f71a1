"""The brightness around a chessboard corner as a model of eleven parameters.

    I(p) = (1 + g . (p - c)) (a + b S(d1 / s) S(d2 / s))

with d1, d2 the distances of pixel p from the two lines through the corner, a and b brightness and half contrast, g the
gradient of the light. S is the step of an edge as a Gaussian lens and the square of a pixel blur it, of standard
deviation s together. The lines have curvatures, so that a fisheye's bent rows do not pull the corner aside. Parameters:
corner (2), angles of the lines (2), s, a, b, g (2), curvatures (2).

The corner of a square that stands alone, on the sides n1 and n2 (+1, -1) of the lines, has S1 S2 + n2 S1 + n1 S2 in
place of S1 S2, and 4 b is its contrast.

The model is symmetric about the corner but for curvature and light, so what it gets wrong otherwise (the shape of the
blur, sharpening) does not move the corner; but it adds to the residuals, and so to the predicted sigma.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray

TAIL_SIGMAS = 3.0
"""An edge is felt so far away, s: the edges of the neighbouring lines are reckoned with where they are nearer."""

PIXEL_KURTOSIS = -1.0 / 120.0
"""Fourth cumulant of a uniform distribution of width 1: of a pixel's square along its sides, px^4."""

SHARP_BLUR_PX = 0.6
"""Below this s the pixel's square shows: a series in its cumulants would be wrong by half a grey level at s = 0.4."""

WINDOW_REACH = 0.5
"""Pixels are used up to this from the corner along the sides of its cell: the windows of neighbouring corners meet and
do not overlap, so that every pixel is used and the errors of neighbours are independent."""

NEAR_SIGMAS, NEAR_PX = 3.0, 1.5
"""Pixels are used so near to one of the lines (s and px added up): those beyond only repeat how bright squares are."""

END_SIGMAS = 2.5
MIN_REACH = 0.25
"""Where the lattice ends, what lies behind the next line is not known: paper, a narrow margin, another square. Pixels
nearer to that line, s, are left out, but never those so near to the corner, in parts of the way to that line."""

PAPER_SIGMAS = 0.0
"""The same where it is known how bright it is beyond: the model holds as far as the line."""


NEIGHBOUR_LINES = ((-1, 0), (1, 0), (0, 1), (0, -1))
"""Where, in rows and columns, the lines before and after line 1 and line 2 have their corners."""


@dataclass(frozen=True, eq=False, slots=True)
class Geometry:
    """What the lattice says of N corners.

    Attributes
    ----------
    sides : (N, 2, 2) the cell's sides along column and row, px: directions of line 1 and 2, and the window.
    curvature : (N, 2) of the two lines, 1/px, positive towards +90 degrees.
    gaps : (N, 2, 2) distance of the neighbouring lines before and after line 1 and line 2 (along +90 degrees), px.
    ends : (N, 2, 2) whether the lattice has no corner on that line beside this one.
    reach : (N, 2, 2) how far the window goes towards that line, in sides of the cell, at most
        WINDOW_REACH; None: by rule.
    paper : (N, 2, 2) how bright it is beyond that line, relative to the corner's mean and in units of the model's b;
        NaN where squares go on there, or where it is not known. None: everywhere.
    tilts : (N, 2, 2) by how much that line is turned against this one, towards +90 degrees, rad; None: nowhere.
    window_blur : (N,) s that windows are made for: a smaller one where other things are near the lines. None:
        the expected one.
    single : (N, 2) of the corner of one square alone, on which side of line 1 and 2 that lies, +1 towards +90 degrees
        or -1; 0 where four squares meet. None: everywhere.
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
        """Return that of the corners `which` (N,)."""
        optional = {"reach": self.reach, "paper": self.paper, "tilts": self.tilts, "single": self.single}
        optional["window_blur"] = self.window_blur
        known = {name: part[which] for name, part in optional.items() if part is not None}
        return Geometry(self.sides[which], self.curvature[which], self.gaps[which], self.ends[which], **known)


def tilted(geometry: Geometry, cells: BoolArray) -> Geometry:
    """Return the `geometry` of the `cells` (R, C) of a lattice with `tilts`, and `gaps` beside the corner itself.

    The gaps are those at the neighbouring corners, which lie aslant. Beyond the ends of the lattice its lines go on
    turning as they do on the other side.
    """
    sides = np.full((cells.shape[0] + 2, cells.shape[1] + 2, 2, 2), np.nan)
    row, column = np.nonzero(cells)
    length = np.sqrt((geometry.sides**2).sum(axis=2, keepdims=True))
    # Neighbours that fell together have no direction.
    own = geometry.sides / np.where(length > 0.0, length, np.nan)
    sides[1:-1, 1:-1][cells] = own
    tilts = np.empty(geometry.gaps.shape)
    for k, ((down, right), line) in enumerate(zip(NEIGHBOUR_LINES, (0, 0, 1, 1), strict=True)):
        there, here = sides[row + 1 + down, column + 1 + right, line], own[:, line]
        tilts[:, line, k % 2] = here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]
    tilts = np.where(np.isnan(tilts), -tilts[:, :, ::-1], tilts)
    tilts[np.isnan(tilts)] = 0.0
    # How far along line 1 and 2 the corner after, along row and column, lies.
    aslant = (geometry.sides[:, ::-1] * own).sum(axis=2) * (1.0, -1.0)
    return replace(geometry, gaps=geometry.gaps - tilts * aslant[:, :, None], tilts=tilts)


def ends_of(known: BoolArray, cells: BoolArray) -> BoolArray:
    """Return the `ends` (M, 2, 2) of the `cells` of a lattice whose corners (R, C) are `known`."""
    ends = np.ones((*known.shape, 4), np.bool_)
    unknown = ~known
    ends[1:, :, 0], ends[:-1, :, 1] = unknown[:-1], unknown[1:]
    ends[:, :-1, 2], ends[:, 1:, 3] = unknown[:, 1:], unknown[:, :-1]
    return ends[cells].reshape(-1, 2, 2)
