"""Measure the planner on existing images, and compute its figures for an exactly true covariance.

A choice of images is one random draw: even the best choice by an exact covariance is closer to the calibration from all
images than a random choice only with some probability. It is simulated by drawing the scores of all images, each with
its information as covariance; everything is then linear, and every choice has its error.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from halves.captures import load

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.result import Calibration
from rigkit.cameras.compare import compare_cameras, grid_pixels
from rigkit.core.arrays import BoolArray, FloatArray, Pixels
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.board_pose import board_pose
from rigkit.planning.goal import Goal, projection_goal
from rigkit.planning.information import BoardPoses, CornerError, Knowledge
from rigkit.planning.plan import choose_views, covariance_of

REAL = ("caliper", "camodocal", "ov-plane", "charuco-stereo-left", "charuco-stereo-right")
GRID = (40, 30)
COUNTS = (8, 10)
FEW_IMAGES = 12
"""Of so few half are chosen, too."""
SESSIONS = 2000
"""Drawn anew, each with errors of all images that are as large as the covariance says."""


@dataclass(frozen=True, slots=True)
class Way:
    """How images are chosen, always greedily, and what is taken stays taken: by the book for the whole image, from
    independent corners of flat boards; else as the product does, for what boards cover."""

    name: str
    book: bool = False


WAYS = (Way("planner"), Way("greedy by the book", book=True))
BEST = "the best choice"
"""Of all, by the covariance of the calibration from all images: nobody can choose so before it is there."""


@dataclass(frozen=True, eq=False, slots=True)
class Images:
    """A capture, the calibration from all of it, and where boards were."""

    name: str
    views: list[BoardView]
    full: Calibration
    mask: BoolArray

    @classmethod
    def of(cls, name: str, data: Path, cache: Path) -> Images:
        found, size = load(name, data, cache)
        views = [view for own in found.values() for view in own[:1]]
        full = calibrate(views, size)
        return cls(name, views, full, covered_by_boards(full, grid_pixels(size, GRID)))

    @property
    def covered(self) -> Pixels:
        return grid_pixels(self.full.camera.size_px, GRID)[self.mask]

    def calibrated(self, chosen: list[int]) -> Calibration | None:
        """Return the calibration from some, with the lens model and the kind of board that the one from all chose by
        held-out error: what is judged is which images are taken, not what is made of them."""
        camera = self.full.camera
        degree = camera.parameters.size - 4 if type(camera).orders else None
        own, board = [self.views[i] for i in chosen], self.full.boards[0].kind
        try:
            return calibrate(own, camera.size_px, model=camera.model, degree=degree, board=board, folds=0)
        except RigkitError:
            return None

    def error(self, chosen: list[int]) -> float:
        """Return the distance to the calibration from all where boards were, after the best rotation, px."""
        part = self.calibrated(chosen)
        return (
            np.inf if part is None else compare_cameras(self.full.camera, part.camera, grid=GRID, mask=self.mask).rms_px
        )

    def gains(self, knowledge: Knowledge) -> FloatArray:
        """Return what each image tells, as far as the lens is known."""
        return np.array([_of_image(view, knowledge) for view in self.views])


def _of_image(view: BoardView, knowledge: Knowledge) -> FloatArray:
    """Return what an image would tell: nothing where the lens does not see its corners."""
    rays, valid = knowledge.camera.unproject(view.pixels)
    points = view.points()
    try:
        pose = board_pose(rays[valid], points[valid]).cam_from_board
    except RigkitError:
        return np.zeros_like(knowledge.information)
    held = BoardPoses(points, pose.rotation[None], pose.translation_mm[None], valid[None])
    return knowledge.of_views(held, view.board.board_id)[0]


def _known(calibration: Calibration, way: Way) -> Knowledge:
    known = Knowledge.unseen(calibration)
    if not way.book:
        return known
    p = calibration.camera.parameters.size
    return Knowledge(known.camera, known.information[:p, :p], CornerError(known.error.sigma_px))


def choose_images(images: Images, start: list[int], count: int, way: Way) -> list[int]:
    """Return which images to take: `start`, then what is chosen of those at hand, one by one, each with the lens as
    those before it show it."""
    taken = list(start)
    covered = None if way.book else images.covered
    while len(taken) < count:
        calibration = images.calibrated(taken)
        left = [i for i in range(len(images.views)) if i not in taken]
        if calibration is None:
            taken.append(left[0])
            continue
        known = _known(calibration, way)
        gains = images.gains(known)
        goal = projection_goal(calibration.camera, pixels=covered)
        taken.append(left[choose_views(known.information + gains[taken].sum(axis=0), gains[left], goal, 1)[0][0]])
    return taken


@dataclass(frozen=True, eq=False, slots=True)
class Row:
    """The median error of chosen images over that of random ones, the part of these that are worse (%; where the same
    are chosen, half), and both in SESSIONS in which the covariance is true, against the calibration from all images
    and against the true lens (2, SESSIONS)."""

    ratio: float
    better: float
    true_ratio: FloatArray
    true_better: FloatArray

    def __str__(self) -> str:
        both = zip(("from all", "true"), self.true_ratio, self.true_better, strict=True)
        sessions = (f"against the lens {w}: {_spread(r, '.2f')}, {_spread(b, '.0f')} %" for w, r, b in both)
        return (
            f"ratio {self.ratio:.2f}, better than {self.better:.0f} % (were the covariance true, {'; '.join(sessions)})"
        )


def _spread(values: FloatArray, form: str) -> str:
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return f"{middle:{form}}, 90 % of sessions {low:{form}} to {high:{form}}"


def real(name: str, data: Path, cache: Path, draws: int, rows: dict[str, list[Row]]) -> None:
    """Choose among the images of a capture; print and keep how near the choices come to the calibration from all."""
    images = Images.of(name, data, cache)
    known = Knowledge.unseen(images.full)
    gains, goal = images.gains(known), projection_goal(images.full.camera, pixels=images.covered)
    total = len(images.views)
    counts = [count for count in COUNTS if count < total]
    for count in counts if total > FEW_IMAGES else (total // 2, *counts):
        rng = np.random.default_rng(count)
        unplanned = [rng.choice(total, count, replace=False).tolist() for _ in range(draws)]
        free = np.array([images.error(chosen) for chosen in unplanned])
        starts = [rng.choice(total, 2, replace=False).tolist() for _ in range(max(draws // 4, 4))]
        print(
            f"{name}, {images.full.camera.model}, board {images.full.boards[0].kind}, {count} of {total}: random "
            f"{np.median(free):.3f} px, the best of {draws} of them {free.min() / np.median(free):.2f} of that"
        )
        ways = {way.name: [choose_images(images, start, count, way) for start in starts] for way in WAYS}
        ways[BEST] = [exchanged(known, gains, goal, unplanned[0])]
        for name_of_way, chosen in ways.items():
            own = np.array([images.error(c) for c in chosen])
            row = Row(
                float(np.median(own) / np.median(free)),
                100.0 * float(np.mean((free > own[:, None]) + 0.5 * (free == own[:, None]))),
                *_if_true(known, gains, goal, chosen, unplanned),
            )
            rows.setdefault(name_of_way, []).append(row)
            print(f"    {name_of_way:18s} {len({tuple(sorted(c)) for c in chosen}):2d} choices: {row}", flush=True)


def exchanged(known: Knowledge, gains: FloatArray, goal: Goal, chosen: list[int]) -> list[int]:
    """Return the choice of as many images with the smallest error, from `chosen` on, one image exchanged at a time."""

    def errors(choices: list[list[int]]) -> FloatArray:
        return np.asarray(goal.error(covariance_of(known.information + gains[np.array(choices)].sum(axis=1))))

    while True:
        left = [i for i in range(len(gains)) if i not in chosen]
        others = [[*(i for i in chosen if i != out), new] for out in chosen for new in left]
        error, best = errors([chosen])[0], errors(others)
        if best.min() >= error * (1.0 - 1e-9):
            return chosen
        chosen = others[int(best.argmin())]


def _if_true(
    known: Knowledge, gains: FloatArray, goal: Goal, chosen: list[list[int]], unplanned: list[list[int]]
) -> tuple[FloatArray, FloatArray]:
    """Return ratios and parts (%) in sessions (2, S) whose images err as the covariance says, against the calibration
    from all images and against the lens. The sessions of a capture are the same for every row of it."""
    rng = np.random.default_rng(0)
    p = len(goal.weight)
    scale = 1.0 / np.sqrt(np.diag(known.information + gains.sum(axis=0)))
    before, own = (m * scale[:, None] * scale for m in (known.information, gains))
    seen = _root(goal.weight * scale[:p, None] * scale[:p]).T
    scores = np.einsum("nij,njs->nis", _root(own), rng.standard_normal((*own.shape[:2], SESSIONS)))
    first = _root(before) @ rng.standard_normal((len(scale), SESSIONS))

    def step(images: list[int]) -> FloatArray:
        moved = covariance_of(before + own[images].sum(axis=0)) @ (first + scores[images].sum(axis=0))
        return np.asarray(seen @ moved[:p])

    whole = step(list(range(len(gains))))
    against = np.stack([whole, np.zeros_like(whole)])
    free, best = (np.array([np.linalg.norm(step(c) - against, axis=1) for c in own]) for own in (unplanned, chosen))
    ratio = np.median(best, axis=0) / np.median(free, axis=0)
    return ratio, 100.0 * np.mean([(free > errors).mean(axis=0) for errors in best], axis=0)


def _root(matrices: FloatArray) -> FloatArray:
    """Return R with R R^T = matrices (..., T, T)."""
    values, axes = np.linalg.eigh(matrices)
    return np.asarray(axes * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def together(rows: dict[str, list[Row]]) -> None:
    """Print the means over all rows: these scatter least."""
    for name, own in rows.items():
        mean = Row(
            float(np.exp(np.mean([np.log(r.ratio) for r in own]))),
            float(np.mean([r.better for r in own])),
            np.exp(np.mean([np.log(r.true_ratio) for r in own], axis=0)),
            np.mean([r.true_better for r in own], axis=0),
        )
        met = [sum(r.ratio <= 0.6 for r in own), sum(r.better >= 85.0 for r in own)]
        print(f"== {name}: mean of {len(own)} rows: {mean}; at most 0.6 in {met[0]}, better than 85 % in {met[1]}")
