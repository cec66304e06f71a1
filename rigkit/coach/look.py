"""Evaluation of one frame: the board in it, and whether the image is sharp, still and well exposed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.calibration.views.usable import views_of_image
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import grey_image

MAX_EDGE_PX = 4.0
"""Wider edges are blurred: by defocus, or by motion."""
STILL_SHARE = 0.0015
"""Largest motion since the last look of a board that is held still, as a part of the image's width."""
MIN_BOARD_CONTRAST = 30.0
"""Least difference between white and black squares, in grey levels of 255."""
MAX_CLIPPED = 0.2
"""Largest part of the board's pixels that may be saturated."""
MAX_SAMPLED_PIXELS = 60_000
"""Most pixels of the board used to estimate exposure and sharpness."""
DARK_AND_BRIGHT = (5.0, 95.0)
STEEPEST = 99.0
"""Percentiles of grey levels for black and white, and of gradients for the edges."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class FrameObservation:
    """What a frame shows.

    Attributes
    ----------
    size_px : (width, height) of the frame.
    view : the largest board in it; None where there is none.
    edge_px : width of its edges.
    moved_px : median displacement of its corners since the last look; None where it was not seen then.
    contrast, clipped : difference of grey levels between black and white, and the part that is saturated.
    """

    size_px: tuple[int, int]
    view: BoardView | None
    edge_px: float = 0.0
    moved_px: float | None = None
    contrast: float = 0.0
    clipped: float = 0.0

    @property
    def sharp(self) -> bool:
        return self.edge_px <= MAX_EDGE_PX

    @property
    def still(self) -> bool:
        return self.moved_px is not None and self.moved_px <= STILL_SHARE * self.size_px[0]

    @property
    def exposed(self) -> bool:
        return self.contrast >= MIN_BOARD_CONTRAST and self.clipped <= MAX_CLIPPED

    def as_photo(self) -> FrameObservation:
        """Return the observation of a single photo, of which the board counts as held still."""
        return self if self.view is None else replace(self, moved_px=0.0)

    def shown(self) -> dict[str, Any]:
        """Return the part of the page's state about it."""
        return {
            "size_px": self.size_px,
            "corners": [] if self.view is None else np.round(self.view.pixels, 1).tolist(),
            "edge_px": round(self.edge_px, 2),
            "moved_px": None if self.moved_px is None else round(self.moved_px, 2),
            "contrast": round(self.contrast, 1),
            "seen": self.view is not None,
            "sharp": self.sharp,
            "still": self.still,
            "exposed": self.exposed,
        }

    @property
    def complaint(self) -> str:
        """What is wrong with the image of the board that is seen, in words; "" where nothing is."""
        if self.contrast < MIN_BOARD_CONTRAST:
            return "more light"
        if self.clipped > MAX_CLIPPED:
            return "less light: the white is too bright"
        if not self.still:
            return "hold still"
        return "" if self.sharp else "not sharp: hold still, or farther away"


def observe_frame(
    image: NDArray[Any],
    boards: Sequence[Board],
    name: str,
    last: FrameObservation | None = None,
    *,
    shrink: int = 1,
    quick: bool = False,
    camera: str | None = None,
) -> FrameObservation:
    """Return what a frame shows, `last` being the previous observation. Detection in an image reduced by `shrink`, or
    `quick`, takes less time and is less accurate. Parts of boards are named by the frame's `name`, and by its `camera`
    where there are several."""
    size_px = (int(image.shape[1]), int(image.shape[0]))
    smaller = (
        image
        if shrink == 1
        else cv2.resize(image, None, fx=1.0 / shrink, fy=1.0 / shrink, interpolation=cv2.INTER_AREA)
    )
    views, _ = views_of_image(name, detect_boards(smaller, boards, quick=quick), boards, camera)
    if not views:
        return FrameObservation(size_px=size_px, view=None)
    view = max(views, key=lambda v: len(v.grid))
    if shrink > 1:
        full = np.clip((view.pixels + 0.5) * shrink - 0.5, -0.5, np.array(size_px) - 0.5)
        view = replace(view, pixels=full, sigma_px=shrink * view.sigma_px)
    low, high = np.floor(view.pixels.min(axis=0)), np.ceil(view.pixels.max(axis=0))
    cut = image[int(max(low[1], 0)) : int(high[1]) + 1, int(max(low[0], 0)) : int(high[0]) + 1]
    top = 255.0 if image.dtype == np.uint8 else float(np.iinfo(image.dtype).max)
    part = np.asarray(grey_image(cut), dtype=np.float32) * np.float32(255.0 / top)
    every = 1 + int(np.sqrt(part.size / MAX_SAMPLED_PIXELS))
    dark, bright = np.percentile(part[::every, ::every], DARK_AND_BRIGHT)
    # Central differences at a part of the pixels.
    inner = part[1:-1:every, 1:-1:every]
    rows, columns = inner.shape
    across = part[1:-1:every, 2::every][:, :columns] - part[1:-1:every, :-2:every][:, :columns]
    down = part[2::every, 1:-1:every][:rows] - part[:-2:every, 1:-1:every][:rows]
    steepest = float(np.percentile(0.5 * np.hypot(across, down), STEEPEST)) if inner.size else 0.0
    return FrameObservation(
        size_px=size_px,
        view=view,
        edge_px=float(bright - dark) / max(steepest, 1e-6),
        moved_px=_median_displacement_px(view, last),
        contrast=float(bright - dark),
        clipped=float((part[::every, ::every] >= 254.0).mean()),
    )


def _median_displacement_px(view: BoardView, last: FrameObservation | None) -> float | None:
    """Return the median displacement, px, of the corners also seen by the last look."""
    if last is None or last.view is None or last.view.board.board_id != view.board.board_id:
        return None
    before = {(int(c), int(r)): p for (c, r), p in zip(last.view.grid, last.view.pixels, strict=True)}
    displacements: list[FloatArray] = [
        p - before[int(c), int(r)]
        for (c, r), p in zip(view.grid, view.pixels, strict=True)
        if (int(c), int(r)) in before
    ]
    return float(np.median(np.linalg.norm(displacements, axis=1))) if displacements else None
