"""Score detections against exact corners: errors, recall, complete boards, false boards, wrong indices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from detection_bench.scenes import BenchScene
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels
from rigkit.core.detections import BoardDetection

FOUND_PX = 1.0
"""A corner counts as found within this distance of the truth."""
FALSE_SHARE = 0.5
"""A board of which fewer corners than this share are true corners is a false one."""
FRAME_PX = 4.0
"""Corners nearer to the frame than this need not be found: not all of their surroundings is in the image."""

_QUARTER = np.array([[0, -1], [1, 0]])


@dataclass(frozen=True, eq=False, slots=True)
class FoundBoard:
    """One board as a detector returned it.

    Attributes
    ----------
    pixels : (N, 2)
    grid : (N, 2) columns and rows, or None where the detector gives no order.
    sigma_px : (N,) predicted standard deviation per axis, or None.
    """

    pixels: Pixels
    grid: IntArray | None = None
    sigma_px: FloatArray | None = None

    @classmethod
    def of(cls, detection: BoardDetection) -> FoundBoard:
        return cls(detection.pixels, detection.grid, detection.sigma_px)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Score:
    """Counts and errors, of one image or of many added up.

    Attributes
    ----------
    corners, found : corners that had to be found, and those that were.
    boards, complete : boards in the images, and those of which one found board has all corners that had to be found.
    split : boards that came back in several pieces.
    false_boards, wrong_indices : found boards that are none; corners that are none, or whose place in the grid
        contradicts that of the rest of their board.
    errors_px : (N, 2) found minus true position of the corners found.
    sigma_px : (N,) predicted by the detector, NaN where it predicts none.
    """

    corners: int
    found: int
    boards: int
    complete: int
    split: int
    false_boards: int
    wrong_indices: int
    errors_px: FloatArray
    sigma_px: FloatArray

    @property
    def recall(self) -> float:
        """Share of the corners found; NaN where there were none."""
        return self.found / self.corners if self.corners else float("nan")

    @property
    def rms_px(self) -> float:
        """Root mean square distance (2-D) of the corners found from the truth; NaN where none was found."""
        return float(np.sqrt((self.errors_px**2).sum(axis=1).mean())) if len(self.errors_px) else float("nan")

    @property
    def worst_px(self) -> float:
        """Largest distance of a corner found from the truth; NaN where none was found."""
        return float(np.linalg.norm(self.errors_px, axis=1).max()) if len(self.errors_px) else float("nan")

    @property
    def actual_over_predicted(self) -> float:
        """Root mean square of the errors in units of the predicted sigma; NaN where none is predicted."""
        if not len(self.errors_px) or not np.isfinite(self.sigma_px).all():
            return float("nan")
        return float(np.sqrt(((self.errors_px / self.sigma_px[:, None]) ** 2).mean()))

    @classmethod
    def sum(cls, scores: Sequence[Score]) -> Score:
        """Add up."""
        every = (_EMPTY, *scores)
        return cls(
            corners=sum(s.corners for s in every),
            found=sum(s.found for s in every),
            boards=sum(s.boards for s in every),
            complete=sum(s.complete for s in every),
            split=sum(s.split for s in every),
            false_boards=sum(s.false_boards for s in every),
            wrong_indices=sum(s.wrong_indices for s in every),
            errors_px=np.concatenate([s.errors_px for s in every]),
            sigma_px=np.concatenate([s.sigma_px for s in every]),
        )


_EMPTY = Score(
    corners=0,
    found=0,
    boards=0,
    complete=0,
    split=0,
    false_boards=0,
    wrong_indices=0,
    errors_px=np.zeros((0, 2)),
    sigma_px=np.zeros(0),
)


def score(scene: BenchScene, found: Sequence[FoundBoard]) -> Score:
    """Hold the boards `found` in the image of a scene against its truth.

    A found board belongs to the true board on which most of its corners lie. Corners beside an occluder or at the frame
    (`BenchScene.clear`, FRAME_PX) need not be found and are not judged.
    """
    truth = scene.truth()
    if not truth:
        return replace(_EMPTY, false_boards=len(found))
    pixels = np.concatenate([t.pixels for t in truth])
    grid = np.concatenate([t.grid for t in truth])
    owner = np.repeat(np.arange(len(truth)), [len(t.grid) for t in truth])
    limit = np.array(scene.camera.size_px) - 1.0 - FRAME_PX
    due = np.concatenate(scene.clear()) & ((pixels > FRAME_PX) & (pixels < limit)).all(axis=1)
    tree = cKDTree(pixels)
    hits: list[tuple[int, BoolArray]] = []
    errors, sigmas, false_boards, wrong = [], [], 0, 0
    for board in found:
        distance, nearest = tree.query(board.pixels)
        near = distance < FOUND_PX
        if not near.any() or near.mean() < FALSE_SHARE:
            false_boards += 1
            continue
        mine = int(np.bincount(owner[nearest[near]]).argmax()) if board.grid is not None else -1
        good = near & ((owner[nearest] == mine) | (mine < 0))
        judged = due[nearest]
        if board.grid is not None:
            good &= _in_place(board.grid, grid[nearest], good)
        wrong += int((judged & ~good).sum())
        hit = np.zeros(len(pixels), bool)
        hit[nearest[good]] = True
        # Without a grid a board is what most of its corners lie on, all the same.
        hits.append((int(np.bincount(owner[nearest[near]]).argmax()), hit))
        counted = good & judged
        errors.append((board.pixels - pixels[nearest])[counted])
        sigmas.append(np.full(int(counted.sum()), np.nan) if board.sigma_px is None else board.sigma_px[counted])
    pieces = np.bincount([k for k, _ in hits], minlength=len(truth)) if hits else np.zeros(len(truth), int)
    every = np.any([h for _, h in hits], axis=0) if hits else np.zeros(len(pixels), bool)
    complete = [any(h[due & (owner == k)].all() for _, h in hits) for k in range(len(truth))]
    return Score(
        corners=int(due.sum()),
        found=int((every & due).sum()),
        boards=len(truth),
        complete=sum(complete),
        split=int((pieces > 1).sum()),
        false_boards=false_boards,
        wrong_indices=wrong,
        errors_px=np.concatenate([np.zeros((0, 2)), *errors]),
        sigma_px=np.concatenate([np.zeros(0), *sigmas]),
    )


def _in_place(grid: IntArray, true_grid: IntArray, good: BoolArray) -> BoolArray:
    """Return which corners (N,) lie in the grid as most of the `good` ones do: one quarter turn and shift for all."""
    best = np.zeros(len(grid), bool)
    turned = np.asarray(grid)
    for _ in range(4):
        shift = true_grid - turned
        values, count = np.unique(shift[good], axis=0, return_counts=True)
        agree = (shift == values[count.argmax()]).all(axis=1)
        best = agree if (agree & good).sum() > (best & good).sum() else best
        turned = turned @ _QUARTER.T
    return best
