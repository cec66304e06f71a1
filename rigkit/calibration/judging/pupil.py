"""A lens that does not look from one point: its entrance pupil moves along the axis with the angle.

All camera models here are central: a pixel has a ray, and all rays meet. Of wide lenses that is true of what is far
away. The pupil of a real fisheye moves forward by millimetres towards the rim, so that a point at the angle t and the
distance R appears turned by about s(t) sin(t) / R, with s(t) = e t^2 to first order. Boards that fill the image of such
a lens are as near as the board is large, where that is pixels. A central model follows it for one distance; what it
cannot follow shows in the residuals, and what it did follow is wrong at all other distances, far away most of all.

The residuals tell e, with the boards' poses and a bow of the boards free to follow, and the lens, as far as any central
one can: a displacement of its image that no model has is not taken for a pupil. How sure e is, the scatter from image
to image tells; how far what is far away has moved, by how much the parameters have followed. Corners that fit least
were left out, and boards of free shape follow, too: of what is there this finds about a half to three quarters, and
says "at least".

Reference: D. B. Gennery, "Generalized camera calibration including fish-eye lenses", IJCV 68 (2006), section 2, on the
moving entrance pupil (the E terms of CAHVORE).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.judging.captured import SMALL_PX
from rigkit.calibration.judging.changing import MIN_NEIGHBOUR_CORRELATION
from rigkit.calibration.judging.neighbours import neighbour_correlation
from rigkit.calibration.judging.view_evidence import (
    CHANGE_COLUMNS,
    MIN_INFORMATIVE_CORNERS,
    MIN_INFORMATIVE_VIEWS,
    columns_of,
    points_of,
    products_of,
    rows_of,
    without_pose,
)
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.solving.clustered import MIN_LEFT
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.findings import Finding
from rigkit.kernels.departures import displacements

BOWS = CHANGE_COLUMNS["bend"]
BY_CHANCE = 1e-3
"""Of images of a lens that looks from one point so few show a pupil that moves."""
ASKED_AT = 0.05
"""Of such images so few have it solved for. A pupil spoils the lens it is told by, and the scatter between images, most
where images are few: of SIMULATED sessions with 3 mm rad^-2 one of ten had a chance of one to three in a thousand."""
MIN_FOUND = 0.5
"""Mostly a half of a pupil or more is found where lens and boards follow it: what may matter in full is asked for."""
MIN_PUPIL_PART = 1e-4
"""Of the square of what a pupil does to the corners, poses, boards and a central lens that follow it leave at least
this. Captures that tell have a hundredth to a third, boards of one distance and narrow lenses next to nothing."""
NOT_FOLLOWED = 1e-10
"""Of what is common to all images, a direction with less than this part of the largest square is not followed."""
DISTANCES = (0.05, 0.95)
"""Quantiles of the corners' distances that are told."""
NOT_ONE_POINT = "the lens does not look from one point"


@dataclass(frozen=True, eq=False, slots=True)
class MovingPupil:
    """How an entrance pupil moves.

    Attributes
    ----------
    mm_per_rad2, sigma_mm_per_rad2 : by how much it moves forward with the square of the angle, and the standard
        deviation of that, from the scatter between images.
    freedom : degrees of freedom of the latter.
    followed : (P,) by how much the camera's parameters would change if it were known.
    """

    mm_per_rad2: float
    sigma_mm_per_rad2: float
    freedom: float
    followed: FloatArray

    @classmethod
    def of(cls, calibration: Calibration) -> MovingPupil | None:
        """Return that of a calibrated lens; None where its images leave it open."""
        found = _products(calibration)
        if found is None:
            return None
        # All that is common to the images, then the pupil and the residual.
        products, image, p = found
        whole = products.sum(axis=0)
        scale = np.sqrt(np.maximum(np.diag(whole), np.finfo(float).tiny))
        gram = whole / np.outer(scale, scale)
        pupil = len(gram) - 2
        common = np.arange(pupil)
        follow = _following(gram, common, pupil)
        left = float(gram[pupil, pupil] - follow @ gram[common, pupil])
        if not left > MIN_PUPIL_PART:
            return None
        # How all of it moves with 1 mm rad^-2 of the pupil, and what is then left in each image.
        direction = np.append(-follow * scale[pupil] / scale[common], 1.0)
        information = left * scale[pupil] ** 2
        own, pull = products[:, :-1, :-1], products[:, :-1, -1]
        amount = float((pull @ direction).sum()) / information
        step = _following(gram, np.arange(pupil + 1), -1) * scale[-1] / scale[:-1]
        after = np.bincount(image, (pull - own @ step) @ direction)
        share = np.bincount(image, own @ direction @ direction) / information
        variance = float((after**2 / np.maximum(1.0 - share, MIN_LEFT)).sum()) / information**2
        # Images of much leverage count for several.
        freedom = max(1.0 / float((share**2).sum()) - 1.0, 1.0)
        # The lens as it is had its parameters and the boards' shapes to follow with, and no displacement.
        alone = _following(gram, np.append(common[:p], common[-BOWS:]), pupil)[:p] * scale[pupil] / scale[:p]
        return cls(amount, float(np.sqrt(variance)), freedom, -amount * alone)

    @property
    def chance(self) -> float:
        """Probability of a movement as large from images of a lens that looks from one point."""
        # Imported here: scipy is slow to import, and most calibrations never ask.
        from scipy.special import stdtr

        return float(2.0 * stdtr(self.freedom, -abs(self.mm_per_rad2) / max(self.sigma_mm_per_rad2, 1e-12)))

    def far_px(self, far: FarProjection) -> float:
        """Return by how much (rms at the boards' corners) it moves what is far away, after the rotation that hides it
        best."""
        safe = np.where(far.sigmas > 0.0, far.sigmas, 1.0)
        moved = np.einsum(
            "ipm,p->im", far.corners.design, np.append(self.followed, -far.hides @ (self.followed / safe))
        )
        return float(np.sqrt((moved**2).sum(axis=0).mean()))


def _products(calibration: Calibration) -> tuple[FloatArray, IntArray, int] | None:
    """Return products (V, K, K) of how the corners of V views move, their poses eliminated; which image (V,) each is
    of, and P. They move with what is common to all images (the camera's P parameters, displacements of the image and
    bows of the boards), with the pupil and with the residual. None where that is nothing."""
    views = [view for view in calibration.views if np.count_nonzero(view.kept) >= MIN_INFORMATIVE_CORNERS]
    if len(views) < MIN_INFORMATIVE_VIEWS:
        return None
    products = products_of(views, lambda some: _rows(calibration, some))
    if not np.isfinite(products).all():
        return None
    length = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), np.finfo(float).tiny))
    image = np.unique([view.image for view in views], return_inverse=True)[1]
    return without_pose(products, length)[:, 6:, 6:], image, calibration.camera.parameters.size


def _rows(calibration: Calibration, views: Sequence[ViewResult]) -> tuple[FloatArray, IntArray]:
    """Return the rows (2, K, N) of `_products`, those of the pose first, and how many corners each view has."""
    rows, count = rows_of(calibration, views)
    p, bows = calibration.camera.parameters.size, columns_of(rows.shape[1])["bend"]
    poses = [view.cam_from_board for view in views]
    points = np.split(points_of(calibration, views), np.cumsum(count)[:-1])
    x, y, z = np.concatenate(
        [at @ pose.rotation.T + pose.translation_mm for at, pose in zip(points, poses, strict=True)]
    ).T
    # Boards that come nearer by as much as the pupil moves forward: the third of the rows of a pose's shift.
    pupil = -(np.arctan2(np.hypot(x, y), z) ** 2) * rows[:, 5]
    moved = displacements(np.concatenate([view.pixels[view.kept] for view in views]), calibration.camera.size_px)
    parts = [rows[:, : 6 + p], moved, rows[:, bows], pupil[:, None], rows[:, -1:]]
    return np.concatenate(parts, axis=1), count


def _following(gram: FloatArray, rows: IntArray, what: int) -> FloatArray:
    """Return the amounts of these `rows` with which they follow the row `what` best."""
    return np.asarray(np.linalg.lstsq(gram[np.ix_(rows, rows)], gram[rows, what], rcond=NOT_FOLLOWED)[0])


def moving_pupil(calibration: Calibration, correlation: float, far: FarProjection) -> list[Finding]:
    """Return a finding where the lens does not look from one point, and that matters; `correlation`: that of the
    residuals of neighbouring corners."""
    asked = calibration.pupil is None and correlation > MIN_NEIGHBOUR_CORRELATION
    pupil = MovingPupil.of(calibration) if asked else None
    if pupil is None or pupil.chance > BY_CHANCE:
        return []
    off = pupil.far_px(far)
    if off <= max(far.usual_px, SMALL_PX):
        return []
    near, away, rim = _shown(calibration)
    moved = abs(pupil.mm_per_rad2) * rim**2
    return [
        Finding.look(
            f"{NOT_ONE_POINT}: its entrance pupil moves by at least {moved:.1f} mm from the "
            f"middle to the outermost corners, which boards {near:.0f} to {away:.0f} mm away show; what is far away is "
            f"off by at least {off:.2f} px",
            "take boards about as far away as what is to be measured (a larger board fills as much of the image)",
        )
    ]


def modelled_pupil(calibration: Calibration) -> list[Finding]:
    """Say of a lens whose pupil is part of its calibration by how much that moves."""
    if calibration.pupil is None:
        return []
    near, away, rim = _shown(calibration)
    mm, sigma = calibration.pupil.shift_mm(rim)
    return [
        Finding.good(
            f"{NOT_ONE_POINT}, and is calibrated so: its entrance pupil moves by {mm:.2f} +- "
            f"{calibration.widening * sigma:.2f} mm from the middle to the outermost corners ({np.degrees(rim):.0f} "
            f"degrees), as boards {near:.0f} to {away:.0f} mm away show; formats of central cameras leave it out, "
            "exact far away"
        )
    ]


def may_move(calibration: Calibration) -> bool:
    """Say whether a pupil that moves is worth to be solved for: residuals of a central lens would not often be so by
    chance, and what is far away would move by something of importance. What the fit then says decides."""
    if neighbour_correlation(calibration) <= MIN_NEIGHBOUR_CORRELATION:
        return False
    pupil = MovingPupil.of(calibration)
    if pupil is None or pupil.chance > ASKED_AT:
        return False
    return pupil.far_px(FarProjection.of(calibration)) > MIN_FOUND * SMALL_PX


def _shown(calibration: Calibration) -> tuple[float, float, float]:
    """Return from where to where boards were, mm, and the largest angle of a corner from the axis, rad."""
    points = calibration.corners.in_cam(np.flatnonzero(calibration.corners.kept))
    distance = np.linalg.norm(points, axis=1)
    near, away = np.quantile(distance, DISTANCES).tolist()
    return near, away, float(np.arccos(np.clip(points[:, 2] / distance, -1.0, 1.0)).max())
