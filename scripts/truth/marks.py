"""Find a lattice of dark marks on a printed surface in an image, and compare it with the print."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray, Mat3, Pixels, Points
from rigkit.core.errors import DegenerateError

MIN_MARK_PX = 6.0
"""Smaller than this along their shorter side marks are specks."""
MIN_FILLED = 0.6
"""Marks fill this part of their minimal rectangle; digits do not."""
MAX_STEP_RATIO = 1.25
"""A neighbour is nearer than this many of the last steps in its direction."""
MAX_BEND_DEG = 15.0
"""By so much the line of marks may turn from one to the next."""
WIDER = 4
"""Pixels by which the window in which a mark is weighed is wider than the mark, on each side."""


@dataclass(frozen=True, eq=False, slots=True)
class Similarity:
    """b = scale * rotation @ a + translation."""

    scale: float
    rotation: Mat3
    translation_mm: FloatArray

    def apply(self, points: Points) -> Points:
        """Return points (N, 3) moved."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation_mm)


def fit_similarity(points: Points, to: Points) -> Similarity:
    """Return the similarity that moves points (N, 3) nearest to others (Umeyama 1991, eq. 40 to 42).

    Raises DegenerateError for fewer than three points or points on a line.
    """
    if len(points) < 3:
        raise DegenerateError(f"similarity: {len(points)} points; at least 3 are needed")
    a, b = points - points.mean(axis=0), to - to.mean(axis=0)
    U, size, Vt = np.linalg.svd(b.T @ a / len(a))
    if size[1] <= 1e-12 * size[0]:
        raise DegenerateError("similarity: the points lie on a line; give some beside it")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    rotation = (U * sign) @ Vt
    scale = float((size * sign).sum() / (a**2).sum(axis=1).mean())
    return Similarity(scale, rotation, to.mean(axis=0) - scale * rotation @ points.mean(axis=0))


def mark_lattice(image: NDArray[Any], start_px: FloatArray, rows: int) -> dict[tuple[int, int], FloatArray]:
    """Return the centres of dark marks on a bright surface by (column, row), counted from the mark nearest `start_px`.

    The mark at the start is (0, 0), on the first of `rows` rows; columns to its left are negative.
    """
    centres = _marks(image)
    first = int(np.argmin(np.linalg.norm(centres - start_px, axis=1)))
    down, across = (_nearest_along(centres, first, np.array(way)) for way in ([0.0, 1.0], [1.0, 0.0]))
    if down is None or across is None:
        raise DegenerateError(f"marks: the one near {start_px.tolist()} has no neighbours; give another start")
    found: dict[tuple[int, int], FloatArray] = {}
    top: dict[int, tuple[int, FloatArray]] = {}
    for sign in (1, -1):
        step = sign * (centres[across] - centres[first])
        column, at = 0, first
        top[0] = (first, centres[down] - centres[first])
        while (after := _next(centres, at, step)) is not None:
            step, at, column = centres[after] - centres[at], after, column + sign
            top[column] = (at, top[column - sign][1])
    for column, (at, step) in top.items():
        found[column, 0] = centres[at]
        for row in range(1, rows):
            after = _next(centres, at, step)
            if after is None:
                break
            step, at = centres[after] - centres[at], after
            found[column, row] = centres[at]
    return found


def lattice_affinities(
    marks1: dict[tuple[int, int], FloatArray], marks2: dict[tuple[int, int], FloatArray]
) -> tuple[list[tuple[int, int]], Pixels, Pixels, FloatArray]:
    """Return which marks both images have with two neighbours on each of four sides, their pixels, and A21 (N, 2, 2)
    there, from the differences along rows and columns, to fourth order. On a surface that bends, the nearest neighbours
    alone say a derivative wrong by a sixth of the third one times the square of their distance."""
    both = marks1.keys() & marks2.keys()
    arms = [(step * i, step * j) for i, j in ((1, 0), (0, 1)) for step in (-2, -1, 1, 2)]
    keys = sorted(k for k in both if all((k[0] + i, k[1] + j) in both for i, j in arms))
    if not keys:
        raise DegenerateError("marks: none is seen by both images with two neighbours on each side")
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
    frames = []
    for marks in (marks1, marks2):
        around = np.array([[marks[c + i, r + j] for i, j in arms] for c, r in keys]).reshape(-1, 2, 4, 2)
        frames.append(np.einsum("nkaq,a->nqk", around, weights))
    A21 = frames[1] @ np.linalg.inv(frames[0])
    return keys, np.array([marks1[k] for k in keys]), np.array([marks2[k] for k in keys]), A21


def _marks(image: NDArray[Any]) -> Pixels:
    """Return the centres (N, 2) of the dark marks on the largest bright surface: holes in it, weighed by how much
    darker than their surroundings their pixels are."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    _, bright = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(bright)
    surface = (labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))).astype(np.uint8)
    contours, hierarchy = cv2.findContours(surface, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    centres = []
    for contour, (_, _, _, outside) in zip(contours, hierarchy[0], strict=True):
        sides = cv2.minAreaRect(contour)[1]
        if outside < 0 or min(sides) < MIN_MARK_PX or cv2.contourArea(contour) < MIN_FILLED * sides[0] * sides[1]:
            continue
        x, y, width, height = cv2.boundingRect(contour)
        x, y = max(x - WIDER, 0), max(y - WIDER, 0)
        window = grey[y : y + height + 2 * WIDER, x : x + width + 2 * WIDER].astype(np.float64)
        edge = np.concatenate([window[0], window[-1], window[:, 0], window[:, -1]])
        dark = np.maximum(np.median(edge) - window, 0.0)
        # The noise of the paper weighs nothing.
        dark[dark < 0.2 * dark.max()] = 0.0
        rows, columns = np.indices(window.shape)
        centres.append([x + (dark * columns).sum() / dark.sum(), y + (dark * rows).sum() / dark.sum()])
    if not centres:
        raise DegenerateError("marks: there is no dark mark on a bright surface")
    return np.array(centres)


def _nearest_along(centres: Pixels, at: int, direction: FloatArray) -> int | None:
    """Return the nearest centre in a direction, None where there is none."""
    away = centres - centres[at]
    length = np.linalg.norm(away, axis=1)
    ahead = (length > 0.0) & (away @ direction > np.cos(np.deg2rad(MAX_BEND_DEG)) * length)
    return int(np.argmin(np.where(ahead, length, np.inf))) if ahead.any() else None


def _next(centres: Pixels, at: int, step: FloatArray) -> int | None:
    """Return the centre that follows after a step, None where the line ends."""
    after = _nearest_along(centres, at, step / np.linalg.norm(step))
    if after is None or np.linalg.norm(centres[after] - centres[at]) > MAX_STEP_RATIO * np.linalg.norm(step):
        return None
    return after
