"""Findings about the boards from their solved shapes: bent, stretched, or not as declared."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.cameras.base import Camera
from rigkit.core.findings import Finding
from rigkit.core.patterns.aprilgrid import AprilGrid

ASPECT = 2e-3
"""Relative difference of the squares' sides from which they should be measured again."""
BOW = 2e-3
"""Deviation from a plane, as a part of the board's extent, from which it is reported."""
OFF_SPACING = 0.01
"""Deviation of the gap between tags, as a part of a tag's side, from which it is reported: a ruler's error is half a
millimetre of 50. A REAL board of 88 mm tags shows 0.001 at most, however it is declared; the declaration of another
print is wrong by 0.05."""

MIN_WITHOUT_ROWS = 3
"""Smallest number of images with a row of a board that is seen in none, from which that is reported: a cover or glare
hides it in one or two."""


def diagnose_boards(c: Calibration, provided: str, *, sure: bool) -> Iterator[Finding]:
    """Yield findings about the boards: rows that are never seen and, where their shape was solved for, that.

    `provided` is the condition added to a finding about the squares' aspect ratio. That is omitted unless the lens is
    `sure`: otherwise it is correlated with the ratio of the focal lengths.
    """
    for board in c.boards:
        name = f"board '{board.board_id}'"
        yield from _unseen_rows(name, board, c.camera, c.views)
        if board.kind == "flat":
            continue
        extent = float(np.linalg.norm(np.ptp(board.points_mm, axis=0)))
        if board.bow_mm > BOW * extent:
            yield Finding.look(
                f"{name} is not flat: up to {board.bow_mm:.2f} mm off a plane",
                "its shape is solved for, but glue it to something flat: it may bend differently next time",
            )
        if sure and abs(board.aspect) > ASPECT:
            longer, other = ("x", "y") if board.aspect > 0 else ("y", "x")
            word = board.board.pattern.size_word
            yield Finding.look(
                f"{name} has {word}s {100 * abs(board.aspect):.2f} % longer in {longer} relative to {other} than "
                f"declared{provided}",
                f"measure {word}_x_mm and {word}_y_mm again",
            )
        yield from _spacing(name, board)


def _unseen_rows(name: str, board: BoardShape, camera: Camera, views: Sequence[ViewResult]) -> Iterator[Finding]:
    """Yield a finding where no image shows the first or last rows of a board with marks, though they would be in
    several: fewer are printed than declared. Other numbers of columns, or of rows of a chessboard, fit no corners."""
    declared = board.declared
    views = [view for view in views if view.board_id == board.board_id]
    if declared is None or not declared.identified or not views:
        return
    seen = np.concatenate([view.grid[:, 1] for view in views])
    first, last = int(seen.min()), int(seen.max())
    per = declared.pattern.points_per_count
    unseen = declared.grid()[(declared.grid()[:, 1] < first) | (declared.grid()[:, 1] > last)]
    if len(unseen) < per * declared.columns:
        return
    count = 0
    for view in views:
        pixels, valid = camera.project(view.cam_from_board.apply(declared.points(unseen)))
        count += bool((valid & camera.on_image(pixels)).all())
    if count < MIN_WITHOUT_ROWS:
        return
    size = f"{declared.columns // per} x {{}} {declared.pattern.count_word}"
    yield Finding.look(
        f"{name} is seen as {size.format((last - first + per) // per)} in {len(views)} images, "
        f"{size.format(declared.rows // per)} are declared: {count} images would show the others",
        f"count the rows on the board; correct rows = {declared.rows // per} unless something hides them",
    )


def _spacing(name: str, board: BoardShape) -> Iterator[Finding]:
    """Yield a finding where the gap between tags differs from the declared one: the solved shape absorbs that, but
    lengths in mm are wrong."""
    pattern = None if board.declared is None else board.declared.pattern
    if board.declared is None or not isinstance(pattern, AprilGrid):
        return
    lattice = board.points_mm.reshape(board.declared.rows, board.declared.columns, 3)
    # Sides of tags and gaps between them alternate along both axes; a single tag has no gap.
    steps = [np.linalg.norm(np.diff(lattice, axis=axis), axis=-1) for axis in (1, 0)]
    sides = np.concatenate([steps[0][:, ::2].ravel(), steps[1][::2].ravel()])
    gaps = np.concatenate([steps[0][:, 1::2].ravel(), steps[1][1::2].ravel()])
    if not len(gaps):
        return
    found = float(gaps.mean() / sides.mean())
    if abs(found - pattern.spacing) > OFF_SPACING:
        yield Finding.look(
            f"{name} has spacing = {found:.2f}, {pattern.spacing:g} is declared: its lengths in mm and those of all "
            "poses are wrong",
            "measure a tag's side and the gap, correct tag_mm and spacing, and calibrate again",
        )
