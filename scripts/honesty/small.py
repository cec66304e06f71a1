"""Test the sigmas of small sessions against the calibration from all other images of the same camera.

The uncertainty of the latter is included. Random draws of 3, 4, 5, 7 and 10 images, with automatic model and board
shape ("auto").
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.compare import CameraVerdict, compare_calibrations
from rigkit.calibration.diagnosis.captured import ASKED_DEG
from rigkit.calibration.result import Calibration
from rigkit.cameras.compare import compare_cameras, grid_pixels
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.core.findings import Severity

SIZES = (3, 4, 5, 7, 10)
MIN_OTHERS = 4
"""Fewer other images than these say little of a small session."""
GRID = (40, 30)
WIDELY = 3.0
"""An error of so many times what was stated is no chance."""
UNLIKELY = 0.05

Views = dict[str, list[BoardView]]


@dataclass(frozen=True, slots=True)
class Drawn:
    """One small session against all others of its camera.

    Attributes
    ----------
    images : how many the small session has.
    difference_px, stated_px : rms over where its boards were, after the best rotation: how far the two calibrations are
        apart, and what both state together (both directions).
    own_px : what of it the small session states.
    whole_px, whole_stated_px : the same over the whole image as both see it, up to where boards are asked for.
    ratio, chance, other : what `compare_calibrations` says: over its usual difference, its chance, "another camera".
    severity : of the small session's headline.
    model, numbers, board : what "auto" chose for it; `model_of_others` for the others.
    """

    images: int
    difference_px: float
    stated_px: float
    own_px: float
    whole_px: float
    whole_stated_px: float
    ratio: float
    chance: float
    other: bool
    severity: Severity
    model: str
    numbers: int
    board: str
    model_of_others: str

    @classmethod
    def of(cls, small: Calibration, others: Calibration) -> Drawn:
        """Hold a small session against the calibration from all others; RigkitError where they cannot be compared."""
        compared = compare_calibrations(small, others)
        pixels = grid_pixels(small.camera.size_px, GRID)
        covered = covered_by_boards(small, pixels)
        inside = compare_cameras(small.camera, others.camera, grid=GRID, mask=covered)
        turn = inside.b_from_a
        rays, valid = small.camera.unproject(pixels)
        projected, seen = others.camera.project(np.where(valid[..., None], rays, [0.0, 0.0, 1.0]) @ turn.T)
        both = valid & seen & (rays[..., 2] > np.cos(np.radians(ASKED_DEG)))
        off = np.where(both[..., None], projected - pixels, 0.0)
        own, other = np.zeros(both.shape), np.zeros(both.shape)
        own[both] = np.trace(FarProjection.of(small).covariance(rays[both]), axis1=1, axis2=2)
        other[both] = np.trace(FarProjection.of(others).covariance(rays[both] @ turn.T), axis1=1, axis2=2)

        def rms(squares: np.ndarray, where: np.ndarray) -> float:
            return float(np.sqrt(squares[where].mean()))

        within = covered & both
        return cls(
            images=len({view.image for view in small.views}),
            difference_px=rms((off**2).sum(axis=-1), within),
            stated_px=rms(own + other, within),
            own_px=rms(own, within),
            whole_px=rms((off**2).sum(axis=-1), both),
            whole_stated_px=rms(own + other, both),
            ratio=compared.ratio,
            chance=compared.chance,
            other=compared.verdict is CameraVerdict.OTHER,
            severity=small.verdicts[0].severity,
            model=small.camera.model,
            numbers=small.camera.parameters.size,
            board=small.boards[0].kind,
            model_of_others=others.camera.model,
        )


def drawn_sessions(
    views_of_draw: Callable[[np.random.Generator], Views],
    draws: int,
    calibrated: Callable[[Views], Calibration],
    seeds: Sequence[int],
) -> dict[int, list[Drawn | str]]:
    """Return, by how many images they have, `draws` random small sessions against all others; of one that could not be
    calibrated why."""
    out: dict[int, list[Drawn | str]] = {}
    for size in SIZES:
        for draw in range(draws):
            # The first draws are the same, however many are asked for.
            rng = np.random.default_rng([*seeds, size, draw])
            views = views_of_draw(np.random.default_rng([*seeds, size, draw, 1]))
            if len(views) - size < MIN_OTHERS:
                break
            names = rng.permutation(sorted(views)).tolist()
            parts = [{name: views[name] for name in sorted(part)} for part in (names[:size], names[size:])]
            try:
                found: Drawn | str = Drawn.of(*(calibrated(part) for part in parts))
            except RigkitError as error:
                found = str(error)
            out.setdefault(size, []).append(found)
    return out


def geometric_mean(values: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))


def table(found: Mapping[int, Sequence[Drawn | str]]) -> str:
    """Return the table, a row for each number of images."""
    lines = [
        "images sessions refused | diff: ratio, chance < .05, other | on boards: ratio, > 2 stated | whole image: "
        "ratio, > 2 stated | good look bad | good and > 3 stated | look and > 3 stated"
    ]
    for size, every in found.items():
        of = [one for one in every if isinstance(one, Drawn)]
        if not of:
            lines.append(f"{size} {len(every)} {len(every)}")
            continue
        inside = [one.difference_px / one.stated_px for one in of]
        whole = [one.whole_px / one.whole_stated_px for one in of]
        graves = [[one for one in of if one.severity is severity] for severity in Severity]
        wide = [sum(one.difference_px > WIDELY * one.stated_px for one in graves[k]) for k in (0, 1)]
        lines.append(
            f"{size:6d} {len(of):8d} {len(every) - len(of):7d} | {geometric_mean([one.ratio for one in of]):.2f}, "
            f"{np.mean([one.chance < UNLIKELY for one in of]):.3f}, {sum(one.other for one in of)} | "
            f"{geometric_mean(inside):.2f}, {np.mean(np.array(inside) > 2.0):.3f} | {geometric_mean(whole):.2f}, "
            f"{np.mean(np.array(whole) > 2.0):.3f} | {' '.join(str(len(part)) for part in graves)} | {wide[0]} | "
            f"{wide[1]}"
        )
    return "\n".join(lines)


def print_small(found: Mapping[str, Mapping[int, Sequence[Drawn | str]]], rendered: Collection[str]) -> None:
    """Print what small sessions come to, by set and number of images: of all REAL sets, and of those `rendered`."""
    for words, names in (("REAL", found.keys() - set(rendered)), ("RENDERED", set(rendered))):
        if names:
            sizes = sorted({size for name in names for size in found[name]})
            print(f"{len(names)} {words} sets")
            print(table({size: [one for name in sorted(names) for one in found[name].get(size, [])] for size in sizes}))
