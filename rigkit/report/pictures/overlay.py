"""Detected corners drawn over their image."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.detections import BoardDetection

OVERLAY_COLOURS = ((230, 60, 50), (40, 160, 70), (50, 90, 230), (230, 150, 20), (160, 60, 200), (20, 170, 190))
"""RGB colours of the boards in turn."""

FRACTION_BITS = 4
"""Fractional bits of OpenCV's drawing coordinates."""


def draw_boards(image: NDArray[np.generic], detections: Sequence[BoardDetection]) -> NDArray[np.uint8]:
    """Return `image` ((H, W) or (H, W, 3) RGB, 8 or 16 bits) with the grids of `detections`, as (H, W, 3) RGB uint8.

    Rows are thicker than columns, the first corner has a ring, an arrow points along the first row, and each board is
    labelled with its id (or number) and its number of corners.
    """
    canvas = _canvas(image)
    width = max(1, round(min(canvas.shape[:2]) / 600))
    for number, found in enumerate(detections):
        colour = OVERLAY_COLOURS[number % len(OVERLAY_COLOURS)]
        lattice = found.lattice()
        _segments(canvas, lattice[:, :-1], lattice[:, 1:], colour, width + 1)
        _segments(canvas, lattice[:-1], lattice[1:], colour, width)
        first = found.pixels[0]
        cv2.circle(canvas, _fixed(first), (6 * width) << FRACTION_BITS, colour, width + 1, cv2.LINE_AA, FRACTION_BITS)
        if len(found.pixels) > 1:
            cv2.arrowedLine(
                canvas, _fixed(first), _fixed(found.pixels[1]), colour, 2 * width, cv2.LINE_AA, FRACTION_BITS, 0.3
            )
        label = f"{found.board_id or number + 1}: {len(found.grid)} of {found.columns}x{found.rows}"
        font = (cv2.FONT_HERSHEY_SIMPLEX, 0.5 * width)
        (length, height), below = cv2.getTextSize(label, *font, width)
        corner = found.pixels.min(axis=0) - 8 * width
        # The label is inside the image, on a white plate.
        place = (max(2, min(int(corner[0]), canvas.shape[1] - length - 2)), max(14 * width, int(corner[1])))
        plate = ((place[0] - 2, place[1] - height - 2), (place[0] + length + 2, place[1] + below))
        cv2.rectangle(canvas, *plate, (255, 255, 255), cv2.FILLED)
        cv2.putText(canvas, label, place, *font, colour, width, cv2.LINE_AA)
    return canvas


def _canvas(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    array = np.asarray(image)
    if array.dtype != np.uint8:
        brightest = max(float(np.quantile(array[::8, ::8], 0.999)), 1.0)
        array = np.clip(array * (255.0 / brightest), 0, 255).astype(np.uint8)
    if array.ndim == 2:
        array = np.repeat(array[..., None], 3, axis=2)
    return np.array(array[..., :3], dtype=np.uint8, order="C")


def _segments(
    canvas: NDArray[np.uint8],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    colour: tuple[int, int, int],
    width: int,
) -> None:
    both = np.stack([start.reshape(-1, 2), end.reshape(-1, 2)], axis=1)
    both = both[np.isfinite(both).all(axis=(1, 2))]
    fixed = np.round(both * (1 << FRACTION_BITS)).astype(np.int32)
    cv2.polylines(canvas, list(fixed), False, colour, width, cv2.LINE_AA, FRACTION_BITS)


def _fixed(pixel: NDArray[np.float64]) -> tuple[int, int]:
    return (round(float(pixel[0]) * (1 << FRACTION_BITS)), round(float(pixel[1]) * (1 << FRACTION_BITS)))
