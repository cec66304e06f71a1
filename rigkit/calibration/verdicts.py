"""What a person should know about a calibration, in sentences: what is wrong, how one can tell, what to do.

Every verdict starts with "good:", "look:" (worth a look) or "bad:". The limits are constants here; none depends on the
result that it judges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.arrays import FloatArray
from rigkit.calibration.result import Calibration
from rigkit.calibration.uncertainty import uncertainty_at_corners, uncertainty_map

__all__ = ["judge"]

FEW_IMAGES = 8
TILTED_DEG = 15.0
TILTED_VIEWS = 3
CELLS = (4, 3)
"""The image in columns x rows of cells, for coverage."""
CELL_CORNERS = 5
"""A cell with fewer corners than this is empty."""
BAD_VIEW = 2.5
"""A view whose median residual is this many times the usual one."""
PATTERN = 0.35
"""Correlation of residuals of neighbouring corners: noise has 0 (a fitted pose makes it slightly negative)."""
OVERFIT = 1.25
"""Held-out over training RMS."""
UNSURE_PX = 1.0
"""Worst-direction standard deviation of a projection, in the covered part of the image."""
ASPECT = 2e-3
"""Squares that are longer one way by this part are worth measuring again."""
OUTLIER_SHARE = 0.03
NAMES_U = ("left", "centre left", "centre right", "right")
NAMES_V = ("top", "middle", "bottom")


def judge(
    calibration: Calibration, also: Sequence[str] = (), *, at_corners_px: FloatArray | None = None
) -> tuple[str, ...]:
    """Return the verdicts, the headline first; `also` are verdicts found elsewhere, `at_corners_px` is what
    `uncertainty_at_corners` returns, where it is known already."""
    found = [
        *also,
        *_tilts(calibration),
        *_images(calibration),
        *_coverage(calibration),
        *_views(calibration),
        *_pattern(calibration),
        *_overfit(calibration),
        *_unsure(calibration, uncertainty_at_corners(calibration) if at_corners_px is None else at_corners_px),
        *_boards(calibration),
        *_outliers(calibration),
    ]
    if not calibration.convergence.converged:
        found.insert(0, f"bad: the solver did not converge ({calibration.convergence.reason}); add tilted views")
    return (_headline(calibration, found), *found)


def _headline(c: Calibration, found: list[str]) -> str:
    held = c.heldout_rms_px
    error = f"training RMS {c.rms_px:.3f} px" if held is None else f"held-out RMS {held:.3f} px"
    bad = sum(v.startswith("bad") for v in found)
    if bad:
        return f"bad: {error}, but {bad} of the remarks below must be dealt with first"
    return f"good: {error}" + (f"; {len(found)} remarks below" if found else "")


def _tilts(c: Calibration) -> list[str]:
    """A board that faces the camera says nothing about the focal length."""
    axes = np.array([v.cam_from_board.rotation[:, 2] for v in c.views])
    places = np.array([v.cam_from_board.translation_mm for v in c.views])
    facing = np.abs((axes * places).sum(axis=1)) / np.linalg.norm(places, axis=1)
    tilted = int((facing < np.cos(np.radians(TILTED_DEG))).sum())
    if tilted >= min(TILTED_VIEWS, len(c.views)):
        return []
    return [
        f"bad: the board is tilted by more than {TILTED_DEG:.0f} degrees in {tilted} of {len(c.views)} views only; "
        f"take at least {TILTED_VIEWS} with the board tilted by 20 to 50 degrees, about different axes"
    ]


def _images(c: Calibration) -> list[str]:
    count = len({v.image for v in c.views})
    if count >= FEW_IMAGES:
        return []
    return [f"look: {count} images; take at least {FEW_IMAGES}, better 15, so that errors can be told from lens"]


def _coverage(c: Calibration) -> list[str]:
    """Name the cells of the image that no board reached, where the lens has an image at all."""
    width, height = c.camera.size_px
    pixels = np.concatenate([v.pixels[v.kept] for v in c.views])
    size = np.array([width / CELLS[0], height / CELLS[1]])
    cell = np.clip((pixels / size).astype(np.int64), 0, np.array(CELLS) - 1)
    count = np.bincount(cell[:, 0] * CELLS[1] + cell[:, 1], minlength=CELLS[0] * CELLS[1]).reshape(CELLS)
    if count.min() >= CELL_CORNERS:
        return []
    u, v = np.meshgrid((np.arange(CELLS[0]) + 0.5) * size[0], (np.arange(CELLS[1]) + 0.5) * size[1], indexing="ij")
    rays, valid = c.camera.unproject(np.stack([u, v], axis=-1))
    empty = (count < CELL_CORNERS) & valid & (np.where(valid, rays[..., 2], -1.0) > np.cos(np.radians(95.0)))
    if not empty.any():
        return []
    names = [f"{NAMES_V[j]} {NAMES_U[i]}" for i, j in np.argwhere(empty)]
    return [f"look: no corners in the {', '.join(names)} of the image; hold the board there, tilted"]


def _views(c: Calibration) -> list[str]:
    # Medians over all corners: a view that is bad throughout has its worst corners among the outliers.
    if len(c.views) < 3:
        return []
    count = np.array([len(v.grid) for v in c.views])
    squared = np.full((len(count), int(count.max())), np.inf)
    squared[np.arange(squared.shape[1]) < count[:, None]] = np.nan_to_num(
        (np.concatenate([v.residuals_px for v in c.views]) ** 2).sum(axis=1)
    )
    squared.sort(axis=1)
    view = np.arange(len(count))
    middle = np.sqrt(0.5 * (squared[view, (count - 1) // 2] + squared[view, count // 2]))
    usual = max(float(np.median(middle)), np.finfo(float).tiny)
    return [
        f"look: image '{view.image}' has a median residual of {value:.3f} px, {value / usual:.1f} times the usual one; "
        "look whether the board or the camera moved, and retake it"
        for view, value in zip(c.views, middle, strict=True)
        if value > BAD_VIEW * usual
    ]


def _pattern(c: Calibration) -> list[str]:
    """Residuals of neighbours agree where a lens or a board is not what the model says."""
    grid = np.concatenate([v.grid for v in c.views])
    kept = np.concatenate([v.kept for v in c.views])
    view = np.repeat(np.arange(len(c.views)), [len(v.grid) for v in c.views])
    columns, rows = (grid.max(axis=0) + 1).tolist()
    lattice = np.full((len(c.views), rows, columns, 2), np.nan)
    lattice[view[kept], grid[kept, 1], grid[kept, 0]] = np.concatenate([v.residuals_px for v in c.views])[kept]
    products, power = 0.0, 0.0
    for a, b in ((lattice[:, :, 1:], lattice[:, :, :-1]), (lattice[:, 1:], lattice[:, :-1])):
        products += float(np.nansum(a * b))
        power += 0.5 * float(np.nansum(a**2 + b**2))
    if not power > 0.0 or products / power < PATTERN:
        return []
    return [
        f"look: residuals of neighbouring corners agree (correlation {products / power:.2f}): the lens model or the "
        'board\'s shape does not fit; try model = "auto", board_shape = "auto", and check that the board is flat'
    ]


def _overfit(c: Calibration) -> list[str]:
    if c.heldout_rms_px is None or c.heldout_rms_px <= OVERFIT * c.rms_px:
        return []
    return [
        f"look: held-out RMS is {c.heldout_rms_px / c.rms_px:.2f} times the training RMS: the images are too few for "
        "this model, or some image is unlike the others; take more"
    ]


def _unsure(c: Calibration, inside: FloatArray) -> list[str]:
    worst = float(np.nanmax(inside)) if np.isfinite(inside).any() else np.inf
    if worst <= UNSURE_PX:
        return []
    grid = uncertainty_map(c, grid=(12, 9))
    place = grid.pixels.reshape(-1, 2)[np.nanargmax(np.where(grid.valid, grid.worst_px, -1.0))]
    return [
        f"bad: the projection is uncertain by up to {worst:.1f} px (one standard deviation) where the boards were, "
        f"most in the image towards ({place[0]:.0f}, {place[1]:.0f}); take more views there, tilted"
    ]


def _boards(c: Calibration) -> list[str]:
    """What the solved shapes say: a bow, or squares longer one way than the other."""
    out = []
    for board in c.boards:
        if board.kind == "flat":
            continue
        extent = float(np.linalg.norm(np.ptp(board.points_mm, axis=0)))
        if board.bow_mm > 2e-3 * extent:
            out.append(
                f"look: board '{board.board_id}' departs from a plane by {board.bow_mm:.2f} mm; its shape is part of "
                "the solution, but a flat board is better"
            )
        if abs(board.aspect) > ASPECT:
            longer = "columns" if board.aspect > 0 else "rows"
            out.append(
                f"look: board '{board.board_id}' has squares {100 * abs(board.aspect):.2f} % longer along its {longer} "
                "than stated, against the other side; measure square_x_mm and square_y_mm again"
            )
    return out


def _outliers(c: Calibration) -> list[str]:
    share = len(c.outliers) / max(len(c.outliers) + c.corner_count, 1)
    if share <= OUTLIER_SHARE:
        return []
    return [f"look: {100 * share:.1f} % of the corners are outliers; check exposure, focus and motion blur"]
