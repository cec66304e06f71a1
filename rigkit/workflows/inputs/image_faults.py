"""Faults of a session's images that a calibration alone does not show, each looked for in a few of the images.

Interlaced: odd and even lines are of two moments. Black borders: a program undistorted or rectified the images. Where
one undistorts images of a lens with barrel distortion and keeps all of their content, the corners stay in place, and
black bulges in from the middle of the sides; the image circle of a fisheye lens is the reverse, and bars have the same
width everywhere. Wrong print: the border of tags or the size of markers is declared otherwise than printed, though
corners are found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.arrays import BoolArray, FloatArray, spread_indices
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.patterns.aprilgrid import MAX_BORDER, AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.fields import MAX_LINES, shift_between_fields
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.tags.printed import likeness_to_print
from rigkit.io.media.images import Image, read_image, to_grey

MAX_CHECKED = 4
"""Images checked, spread over the session: the board need not move in all of them, and a border is where all are
black."""

MIN_INTERLACED = 2
MIN_FIELD_SHIFT_PX = 0.2
"""Minimum shift between the two fields of an interlaced image. On 239 boards in REAL progressive images, 50 of them
degraded in other ways, the shift is at most 0.06 px (squares of 9 px); in an interlaced REAL one it is 0.37, in 14
whose odd lines were moved by 2.5 px rms 1.4 (median)."""

BLACK_LEVEL = 8
"""Largest grey level, of 255, of black: JPEG moves that of a border by a few levels."""
LINES_OF_SIDE = 65
"""Rows or columns, spread along each side, whose black ends are measured."""
ALONG_SIDE = (0.08, 0.92)
"""The part of the side along which they are spread: nearer to its ends a line runs in the borders of other sides."""
MIN_BULGE_PX, MAX_PART_OF_SIZE = 4.0, 0.3
"""Limits of the height of the bulge, the second as a part of the image's size."""
MIN_SHARE_OF_PARABOLA = 0.9
"""Part of the variance of the border's width along the side that a parabola explains. Undistorted images (SIMULATED,
Brown, k1 of -0.05 to -0.35, JPEG): 0.93 and more where the bulge is higher than 5 px; a rectangle over half of the
side: 0.77."""

BETTER_BORDER = 0.03
"""Smallest gain of the mean correlation of tags with their codes by another border. The right border gains 0.07 to 0.34
in an image (REAL, 2 sets, original, blurred by 2 px, with twice the light), so that the wrong one gains -0.07."""

MARKER_SIDES = np.arange(0.3, 0.96, 0.01)
"""Sides of markers that are tried, in squares."""

OFF_MARKER = 0.08
"""Difference of a marker's side from the declared one, in squares, from which it is reported: twice the largest one on
4 boards declared as printed (REAL, original, blurred by 2 px, with twice the light)."""


def _some_images(names: Sequence[str], images: Mapping[str, Path]) -> Iterator[tuple[int, Image]]:
    """Yield the indices of up to MAX_CHECKED of the `names`, spread over those that have a file, and these images;
    unreadable ones are skipped."""
    there = [k for k, name in enumerate(names) if name in images]
    for place in spread_indices(len(there), MAX_CHECKED).tolist():
        try:
            image = read_image(images[names[there[place]]])
        except InputError:
            # Corners are kept beside the session: the image itself may have gone bad since.
            continue
        yield there[place], image


def interlaced(calibration: Calibration, images: Mapping[str, Path]) -> list[Finding]:
    """Return a finding if `images` (files by name) are interlaced; unreadable ones are skipped."""
    if calibration.camera.size_px[1] > MAX_LINES:
        return []
    views, shifts = calibration.views, dict[str, float]()
    for k, image in _some_images([view.image for view in views], images):
        shifts[views[k].image] = abs(shift_between_fields(to_grey(image).astype(np.float64), views[k].pixels))
    shifted = {image: shift for image, shift in shifts.items() if shift > MIN_FIELD_SHIFT_PX}
    if len(shifted) < MIN_INTERLACED:
        return []
    name, most = max(shifted.items(), key=lambda one: one[1])
    return [
        Finding.look(
            f"images are interlaced: every second line is of another moment, in '{name}' shifted by {most:.1f} px "
            f"({len(shifted)} of {len(shifts)} images looked at)",
            "set the camera or the grabber to progressive, or hold board and camera still",
            name,
        )
    ]


def black_borders(calibration: Calibration, images: Mapping[str, Path]) -> list[Finding]:
    """Return a finding if `images` (files by name) have black borders like those of undistorted ones; unreadable
    ones are skipped."""
    names = list(dict.fromkeys(view.image for view in calibration.views))
    found = [_widths(grey_image(image)) for _, image in _some_images(names, images)]
    if len(found) < 2:
        return []
    bulges = [_bulge_px(width) for width in np.min(found, axis=0)]
    height = max(min(bulges[0], bulges[1]), min(bulges[2], bulges[3]))
    if not MIN_BULGE_PX <= height <= MAX_PART_OF_SIZE * min(calibration.camera.size_px):
        return []
    return [
        Finding.look(
            f"black bulges into the images from opposite sides, by {height:.0f} px: they seem undistorted or rectified "
            "already, perhaps with the parameters of another camera",
            "calibrate from the camera's own images if there are such; else apply no distortion to these again",
        )
    ]


def _widths(grey: GreyImage) -> FloatArray:
    """Return the widths (4, LINES_OF_SIDE) px of the black border at the left, right, top and bottom."""
    black = grey <= BLACK_LEVEL
    out = []
    for lines in (black, black.T):
        some = lines[(np.linspace(*ALONG_SIDE, LINES_OF_SIDE) * len(lines)).astype(int)]
        out += [_ends(some), _ends(some[:, ::-1])]
    return np.array(out)


def _ends(black: BoolArray) -> FloatArray:
    """Return how many pixels are black from the start of each line; none where all are."""
    return np.asarray(np.argmin(black, axis=1), dtype=np.float64)


def _bulge_px(width: FloatArray) -> float:
    """Return the height of the parabola that the border's width follows along a side, 0 if it follows none."""
    place = np.linspace(-1.0, 1.0, len(width))
    system = np.column_stack([np.ones_like(place), place, 1.0 - place**2])
    step = np.linalg.lstsq(system, width, rcond=None)[0]
    left, whole = float(((width - system @ step) ** 2).sum()), float(((width - width.mean()) ** 2).sum())
    return float(step[2]) if left <= (1.0 - MIN_SHARE_OF_PARABOLA) * whole and whole > 0.0 else 0.0


def wrong_print(views: Sequence[BoardView], images: Mapping[str, Path]) -> list[Finding]:
    """Return findings on boards whose tags or markers are printed otherwise than declared; unreadable `images` (files
    by name) are skipped."""
    out = []
    for board in {view.board.board_id: view.board for view in views}.values():
        prints = list(_prints(board))
        if prints:
            seen = list(_seen([view for view in views if view.board.board_id == board.board_id], images))
            likeness = [_mean_likeness(seen, one) for one in prints]
            out += _finding(board, prints[int(np.argmax(likeness))], max(likeness) - _mean_likeness(seen, board))
    return out


def _prints(board: Board) -> Iterator[Board]:
    pattern = board.pattern
    if isinstance(pattern, AprilGrid):
        for border in range(1, MAX_BORDER + 1):
            yield replace(board, pattern=replace(pattern, border=border))
    elif isinstance(pattern, Charuco):
        for side in MARKER_SIDES.tolist():
            yield replace(board, pattern=replace(pattern, marker_mm=side * min(board.squares_mm)))


def _seen(views: Sequence[BoardView], images: Mapping[str, Path]) -> Iterator[tuple[GreyImage, FloatArray]]:
    """Yield some images of a board's views with its corners (R, C, 2)."""
    for k, image in _some_images([view.image for view in views], images):
        view = views[k]
        lattice = np.full((view.board.rows, view.board.columns, 2), np.nan)
        lattice[view.grid[:, 1], view.grid[:, 0]] = view.pixels
        yield grey_image(image), lattice


def _mean_likeness(seen: Sequence[tuple[GreyImage, FloatArray]], board: Board) -> float:
    likeness = [likeness_to_print(image, lattice, board) for image, lattice in seen]
    marks = sum(map(len, likeness))
    return float(np.concatenate(likeness).mean()) if marks else 0.0


def _finding(declared: Board, seen: Board, gain: float) -> list[Finding]:
    own, other = declared.pattern, seen.pattern
    if isinstance(own, AprilGrid) and isinstance(other, AprilGrid) and gain > BETTER_BORDER:
        return [
            Finding.look(
                f"the tags of board '{declared.board_id}' have a border of {other.border} in the images, {own.border} "
                "is declared",
                f"set border = {other.border}",
            )
        ]
    if isinstance(own, Charuco) and isinstance(other, Charuco) and gain > 0.0:
        square = min(declared.squares_mm)
        if abs(other.marker_mm - own.marker_mm) > OFF_MARKER * square:
            return [
                Finding.look(
                    f"the markers of board '{declared.board_id}' have {other.marker_mm / square:.2f} of a square's "
                    f"side in the images, {own.marker_mm / square:.2f} is declared",
                    "measure a marker's black outline and correct marker_mm",
                )
            ]
    return []
