"""Images of one camera of which some were rotated by 180 degrees, or mirrored, by a program.

Image viewers apply the EXIF orientation; conferencing programs mirror. Such an image is of the same lens with the
principal point reflected at the image centre, and a mirrored image shows a mirrored board. The only unknown is which
images were flipped. Each image is tested: with lens and board shape held, does it fit better unchanged or flipped back?
Then lens and board shape are solved for again. This needs no two clusters of principal points, which few images, or
boards that compensate by their tilt, do not show clearly. Images that were cropped on opposite sides have reflected
principal points, too: that is said beside it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.assemble import with_solution
from rigkit.calibration.diagnosis.two_kinds import ImageScores
from rigkit.calibration.diagnosis.view_evidence import ViewEvidence, columns_of
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.poses import START_TOLERANCE, refine_poses
from rigkit.calibration.solving.solver import solve
from rigkit.calibration.solving.state import State, evaluate, weighted_squares
from rigkit.calibration.views.flips import FLIP_SIGNS
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import image_center
from rigkit.core.arrays import BoolArray, IntArray
from rigkit.core.findings import Finding

TOLERANCE = 1e-4
"""Relative cost at which the solver stops: if flipping is the cause, the cost falls by a factor."""
MAX_STILL_SHIFTED = 0.2
"""Part of the squares that a shift between images explains after flipping back, over that explained by flipping back.
Uniformly distributed shifts split into two groups leave a third, normally distributed ones more than half; REAL
sessions of which half was turned leave 0.003 to 0.1."""
MIN_LEAD = 6.0
"""Difference of the Bayesian information criterion of flipped images to that of none: strong evidence (Kass and
Raftery, "Bayes factors", J. Am. Stat. Assoc. 90, 1995)."""
ROUNDS = 4
"""Maximal number of rounds in which images change sides."""
MIN_FIRST_GAIN = 0.1
"""Part of the squares that flipping views back must explain, with lens and boards held, before it is solved for: 0.4 to
0.6 for REAL and SIMULATED sessions with every fourth image mirrored, 0 to 0.01 for the unchanged sessions."""
MAX_OFF_CENTRE = 0.04
"""Distance of the principal point from the image centre, as a part of the longer side, from which images were rather
cropped than flipped: that of REAL lenses is 0.001 to 0.035 (camodocal, bouguet). It decides which is said first."""
MIN_CROP = 0.01
"""Part of the longer side that a crop takes at least, to be said at all."""


@dataclass(frozen=True, eq=False, slots=True)
class _FlippedBack:
    """Observations with the images of the views `at` (V,) flipped back in one `way`, their solution, and its sum of
    squares."""

    way: str
    at: BoolArray
    observations: Observations
    state: State
    squares: float


def flipped_images(
    calibration: Calibration,
    evidence: ViewEvidence,
    observations: Observations,
    fit: Fit,
    *,
    shifted: bool = True,
) -> Finding | None:
    """Return a finding where some of the images were rotated by 180 degrees or mirrored, else None.

    `evidence` is the `view_evidence` of the calibration; `shifted` says whether two clusters of
    principal points are possible.
    """
    before = float(weighted_squares(fit.state, observations, fit.weight(observations)).sum())
    split = _split_of_shifts(evidence, len(observations.views)) if shifted else None
    tried = [
        _alternated(way, at, turns, observations, fit, before)
        for way in _possible_ways(observations)
        for at, turns in _initial_flips(way, split, observations, fit)
    ]
    if not tried or not before > 0.0:
        return None
    back = min(tried, key=lambda one: one.squares)
    back = replace(back, observations=_with_views(back.observations))
    residuals = evaluate(back.state, back.observations)
    solved = with_solution(calibration, back.observations, back.state, residuals, fit.kept)
    now = evidence.again(solved)
    return None if now is None else _finding_of(back, before, now)


def _split_entropy(second: BoolArray) -> float:
    """Return twice the entropy of a split into two kinds that both occur (V,), which is added to an information
    criterion: the kind of each image is estimated from the same residuals."""
    part = float(second.mean())
    return float(-2.0 * len(second) * (part * np.log(part) + (1.0 - part) * np.log1p(-part)))


def _possible_ways(observations: Observations) -> list[str]:
    """Return the flips after which the boards are still found: mirrored markers and tags cannot be read."""
    readable = not any(board.pattern.identified for board in observations.boards)
    return [way for way, signs in FLIP_SIGNS.items() if readable or math.prod(signs) > 0.0]


def _split_of_shifts(evidence: ViewEvidence, count: int) -> BoolArray | None:
    """Return which of `count` views are of one of two clusters of principal points; None without any."""
    rows = columns_of(evidence.own.shape[1])["shift"]
    scores = ImageScores.scaled(evidence.own[:, rows, rows], evidence.along[:, rows], np.zeros((2, 2)))
    split = scores.best_split()
    return None if split is None else np.isin(np.arange(count), np.array(evidence.views)[split[0]])


def _initial_flips(
    way: str, split: BoolArray | None, observations: Observations, fit: Fit
) -> Iterator[tuple[BoolArray, IntArray]]:
    """Yield which views (V,) may be flipped, and the quarter turns by which their boards are then numbered differently:
    the views that fit better flipped with lens and boards held, and those of the `split` by principal points.
    """
    better, gain, turns = _fitting_better_flipped(way, observations, fit.state, fit)
    if gain > MIN_FIRST_GAIN and not better.all():
        yield better, turns
    if split is not None:
        yield split, turns


def _alternated(
    way: str, at: BoolArray, turns: IntArray, observations: Observations, fit: Fit, before: float
) -> _FlippedBack:
    """Return the solution from a first guess of which views are flipped, by alternating solution and test. A guess that
    explains nothing of the sum of squares `before` is not improved: as many views are wrong in it as right."""
    start, state = _flipped(way, at, turns, observations, fit.state)
    state, _ = refine_poses(start, state, fit.weight(observations), tolerance=START_TOLERANCE)
    for _ in range(ROUNDS):
        found = _solved(way, at, start, state, fit)
        if found.squares >= before:
            break
        wrong, _, turns = _fitting_better_flipped(way, found.observations, found.state, fit)
        at = at ^ wrong
        if not wrong.any() or at.all() or not at.any():
            break
        start, state = _flipped(way, wrong, turns, found.observations, found.state)
    return found


def _solved(way: str, at: BoolArray, observations: Observations, state: State, fit: Fit) -> _FlippedBack:
    weight = fit.weight(observations)
    state = solve(observations, state, weight=weight, prior_sigma_px=fit.sigma_px, cost_tolerance=TOLERANCE).state
    return _FlippedBack(way, at, observations, state, float(weighted_squares(state, observations, weight).sum()))


def _fitting_better_flipped(
    way: str, observations: Observations, state: State, fit: Fit
) -> tuple[BoolArray, float, IntArray]:
    """Return which views (V,) fit better flipped, with lens and boards held, the relative decrease of the sum of
    squares, and the quarter turns (V,) by which their boards are then numbered differently: a mirrored board is
    numbered from either end, as is one with rotational symmetry."""
    every, weight = np.ones(len(observations.views), dtype=bool), fit.weight(observations)
    now, costs = weighted_squares(state, observations, weight), []
    # Flat boards look the same from either end.
    for turns in (0,) if state.shape.kind == "flat" else (0, 2):
        numbered = turns == 2 and math.prod(FLIP_SIGNS[way]) > 0.0
        possible = np.array([not numbered or view.board.looks_same_turned for view in observations.views])
        if not possible.any():
            break
        flipped, start = _flipped(way, every, np.full(len(every), turns), observations, state)
        cost = refine_poses(flipped, start, weight, tolerance=START_TOLERANCE)[1]
        costs.append(np.where(possible, cost, np.inf))
    best = np.min(costs, axis=0)
    better = best < now
    gain = float((now - best)[better].sum() / max(float(now.sum()), np.finfo(float).tiny))
    return better, gain, 2 * np.argmin(costs, axis=0)


def _flipped(
    way: str, at: BoolArray, turns: IntArray, observations: Observations, state: State
) -> tuple[Observations, State]:
    """Return observations and poses with the images of the views `at` (V,) flipped in one `way`, and their boards
    renumbered by so many quarter `turns` (V,): a mirrored board along its columns, or else along its rows. Only
    `_with_views` has the views themselves flipped."""
    signs = np.append(FLIP_SIGNS[way], 1.0)
    half, which = turns == 2, observations.board
    backwards = at[:, None] & np.stack([half ^ bool(signs.prod() < 0.0), half], axis=-1)
    size = np.array([board.size for board in observations.boards])[which][:, None]
    first = observations.first_row[which][:, None]
    grid = _grid(observations)
    grid = np.where(backwards[:, None], size - 1 - grid, grid)
    corner = np.where(observations.present, first + grid[..., 1] * size[..., 0] + grid[..., 0], observations.corner)
    middle, off_axis = image_center(state.camera.size_px), np.where(at[:, None], signs, 1.0)
    pixels = np.where(
        (at[:, None] & observations.present)[..., None],
        middle + signs[:2] * (observations.pixels - middle),
        observations.pixels,
    )
    # The frame of a board begins at zero again.
    far = np.where(backwards, np.array([board.points()[-1, :2] for board in observations.boards])[which], 0.0)
    on_board = np.append(np.where(backwards, -1.0, 1.0), np.ones((len(at), 1)), axis=1)
    place = (state.rotation[..., :2] @ far[..., None])[..., 0] + state.translation_mm
    moved = replace(
        state,
        rotation=off_axis[:, :, None] * state.rotation * on_board[:, None],
        translation_mm=off_axis * place,
    )
    return replace(observations, pixels=pixels, corner=corner), moved


def _grid(observations: Observations) -> IntArray:
    """Return column and row (V, C, 2) of every corner on its board."""
    columns = np.array([board.columns for board in observations.boards])[observations.board]
    row, column = np.divmod(observations.corner - observations.first_row[observations.board][:, None], columns[:, None])
    return np.stack([column, row], axis=-1)


def _with_views(observations: Observations) -> Observations:
    """Return the observations with views of their pixels and corners."""
    each = zip(observations.views, _grid(observations), observations.pixels, strict=True)
    views = [replace(view, grid=grid[: len(view.grid)], pixels=pixels[: len(view.grid)]) for view, grid, pixels in each]
    return replace(observations, views=tuple(views))


def _finding_of(back: _FlippedBack, before: float, evidence: ViewEvidence) -> Finding | None:
    """Return the finding, if flipping images back explains the residuals and no shift between images is left."""
    at, changes = back.at, evidence.changes
    left, part = max(back.squares / before, np.finfo(float).eps), float(at.mean())
    if not 0.0 < part < 1.0 or not changes:
        return None
    # Errors within an image are correlated: each counts as two measurements, of its principal point.
    if 2.0 * len(at) * np.log(left) + _split_entropy(at) > -MIN_LEAD:
        return None
    # Images that shift on the sensor for another reason still do after flipping.
    if left * max(changes[way].share for way in ("shift", "lens")) > MAX_STILL_SHIFTED * (1.0 - left):
        return None
    names = [view.image for view in back.observations.views]
    flipped = list(dict.fromkeys(name for name, of in zip(names, at, strict=True) if of == (part <= 0.5)))
    camera = back.state.camera
    off = np.where(np.array(FLIP_SIGNS[back.way]) < 0.0, camera.axis_px - image_center(camera.size_px), 0.0)
    apart = float(np.linalg.norm(2.0 * off))
    causes, size = [back.way], max(camera.size_px)
    if apart > MIN_CROP * size:
        causes.insert(
            0 if apart > 2.0 * MAX_OFF_CENTRE * size else 1,
            f"cropped on opposite sides (principal points {apart:.0f} px apart)",
        )
    return Finding.contradicting(
        f"{len(flipped)} of {len(set(names))} images (such as '{flipped[0]}'), or all others, are "
        f"{', or '.join(causes)}: undoing that removes {100.0 * (1.0 - left):.0f} % of the sum of squared residuals",
        "use the image files as the camera wrote them, and calibrate again",
    )
