"""Test for a lens that is not central: its entrance pupil moves along the axis with the angle.

All camera models here are central: the rays of all pixels meet in one point. For wide lenses that holds only for far
points. The pupil of a real fisheye moves forward by millimetres towards the rim, so that a point at the angle t and
the distance R appears rotated by about s(t) sin(t) / R, with s(t) = e t^2 to first order. A board that fills the image
of such a lens is so near that this is pixels. A central model absorbs it for one distance. The rest is in the
residuals, and the absorbed part is an error at all other distances, largest for far points.

The residuals give e by regression, with the boards' poses and bows and any displacement of a central lens free, so
that errors of the lens model do not count as a pupil. The scatter between images gives the standard deviation of e. The
change of the fitted parameters gives the displacement of far points. As outliers are left out and released board shapes
absorb a part as well, a half to three quarters of the movement are found, and the finding says "at least".

Reference: D. B. Gennery, "Generalized camera calibration including fish-eye lenses", IJCV 68 (2006), section 2, on the
moving entrance pupil (the E terms of CAHVORE).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.diagnosis.captured import SMALL_PX
from rigkit.calibration.diagnosis.changing import MIN_NEIGHBOUR_CORRELATION
from rigkit.calibration.diagnosis.view_evidence import (
    CHANGE_COLUMNS,
    MIN_INFORMATIVE_CORNERS,
    columns_of,
    points_of,
    products_of,
    rows_of,
    without_pose,
)
from rigkit.calibration.pupil import SolvedPupil
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.calibration.solving.clustered import MIN_LEFT
from rigkit.core.arrays import FloatArray, IntArray, root_diagonal
from rigkit.core.findings import Finding
from rigkit.kernels.departures import displacements

BOW_COLUMNS = CHANGE_COLUMNS["bend"]
PUPIL_SIGNIFICANCE = 1e-3
"""Significance level of the finding."""
MIN_IMAGES = 3
"""Two images have no scatter besides what they have in common."""
ASKED_AT = 0.05
"""Significance level at which a pupil is solved for. It is higher, as a moving pupil increases the scatter between
images, most with few images: one of ten SIMULATED sessions with 3 mm rad^-2 had a p-value of 0.001 to 0.003."""
WIDE_FROM_RAD = 0.25 * np.pi
"""A lens seen beyond this angle from its axis is solved with a pupil even where that is not significant here, unless
with EXCLUDED_SIGMAS more it would displace far points by little as well: of REAL fisheyes with 3 to 8 images, whose
pupils move by 3 to 4 mm, a tenth is found here, with p-values up to 0.9. Of narrower lenses, whose pupils move with the
square of the angle, this would only take time."""
EXCLUDED_SIGMAS = 2.0
MAX_TAKEN_BACK = 0.5
"""Largest part of a solved movement that residuals may take back or add again once a central lens may have any
displacement. It is 0.25 and less for pupils that move (ocam, fisheye-chess from 3 to 8 images; SIMULATED 0.04), and 0.7
and more for central lenses that their model does not fit (SIMULATED)."""
MIN_FOUND = 0.5
"""Smallest part of a pupil's movement that is found here; so a pupil is solved for from half of the size that
matters."""
MIN_PUPIL_PART = 1e-4
"""Smallest part of a pupil's effect on the corners (sum of squares) that poses, boards and a central lens must not
absorb. Captures that determine it have 0.01 to 0.3; boards at one distance and narrow lenses have almost none."""
NOT_FOLLOWED = 1e-10
"""Relative singular value up to which a direction common to all images is undetermined."""
DISTANCES = (0.05, 0.95)
"""Quantiles of the corners' distances that are reported."""
NOT_CENTRAL = "the lens is not central"


@dataclass(frozen=True, eq=False, slots=True)
class MovingPupil:
    """First-order estimate of the movement of an entrance pupil.

    Attributes
    ----------
    mm_per_rad2, sigma_mm_per_rad2 : forward movement per squared angle, and its standard deviation from the scatter
        between images.
    freedom : degrees of freedom of the latter.
    parameter_changes : (P,) change of the camera's parameters if the movement were modelled.
    left_px : residuals that remain, rms per degree of freedom.
    """

    mm_per_rad2: float
    sigma_mm_per_rad2: float
    freedom: float
    parameter_changes: FloatArray
    left_px: float

    @classmethod
    def of(cls, calibration: Calibration) -> MovingPupil | None:
        """Return that of a calibrated lens; None where its images do not determine it."""
        found = _products(calibration)
        if found is None:
            return None
        # Rows common to all images, then the pupil and the residual.
        products, image, p, residuals = found
        whole = products.sum(axis=0)
        scale = root_diagonal(whole)
        gram = whole / np.outer(scale, scale)
        pupil = len(gram) - 2
        common = np.arange(pupil)
        follow = _regression(gram, common, pupil)
        left = float(gram[pupil, pupil] - follow @ gram[common, pupil])
        if not left > MIN_PUPIL_PART:
            return None
        # Change of all rows with 1 mm rad^-2 of the pupil, and the residual of each image after the fit.
        direction = np.append(-follow * scale[pupil] / scale[common], 1.0)
        information = left * scale[pupil] ** 2
        own, pull = products[:, :-1, :-1], products[:, :-1, -1]
        amount = float((pull @ direction).sum()) / information
        fitted = _regression(gram, np.arange(pupil + 1), -1)
        step = fitted * scale[-1] / scale[:-1]
        after = np.bincount(image, (pull - own @ step) @ direction)
        share = np.bincount(image, own @ direction @ direction) / information
        variance = float((after**2 / np.maximum(1.0 - share, MIN_LEFT)).sum()) / information**2
        # Images of high leverage count for several.
        freedom = max(1.0 / float((share**2).sum()) - 1.0, 1.0)
        # The calibration itself could adapt its parameters and board shapes, but no displacements.
        alone = _regression(gram, np.append(common[:p], common[-BOW_COLUMNS:]), pupil)[:p] * scale[pupil] / scale[:p]
        square = max(float(gram[-1, -1] - fitted @ gram[:-1, -1]), 0.0) * scale[-1] ** 2
        left_px = float(np.sqrt(square / max(residuals - len(fitted), 1)))
        return cls(amount, float(np.sqrt(variance)), freedom, -amount * alone, left_px)

    @property
    def chance(self) -> float:
        """Probability of a movement this large for a central lens."""
        # Imported here: scipy is slow to import, and most calibrations never ask.
        from scipy.special import stdtr

        return float(2.0 * stdtr(self.freedom, -abs(self.mm_per_rad2) / max(self.sigma_mm_per_rad2, 1e-12)))

    def far_px(self, far: FarProjection) -> float:
        """Return the displacement of far points by it (rms at the boards' corners), after the rotation that compensates
        it best."""
        safe = np.where(far.sigmas > 0.0, far.sigmas, 1.0)
        moved = np.einsum(
            "ipm,p->im",
            far.corners.design,
            np.append(self.parameter_changes, -far.compensation @ (self.parameter_changes / safe)),
        )
        return float(np.sqrt((moved**2).sum(axis=0).mean()))


def changes_with(calibration: Calibration, pupil: SolvedPupil) -> FloatArray | None:
    """Return the change of a central lens's parameters (P,) if the movement `pupil`, solved for from other images, were
    modelled; None where its images do not determine it."""
    found = MovingPupil.of(calibration)
    if found is None or found.mm_per_rad2 == 0.0:
        return None
    *_, rim = _distances_and_rim(calibration)
    return np.asarray(found.parameter_changes * (pupil.shift_mm(rim)[0] / rim**2 / found.mm_per_rad2))


def solved_again(calibration: Calibration) -> MovingPupil | None:
    """Return the movement of a solved pupil with any displacement of a central lens free; None where the residuals take
    it back. An error of the lens model passes for a pupil, mostly where the boards are at one distance."""
    rest = None if calibration.pupil is None else MovingPupil.of(calibration)
    if calibration.pupil is None or rest is None:
        return None
    *_, rim = _distances_and_rim(calibration)
    solved = calibration.pupil.shift_mm(rim)[0] / rim**2
    taken_back = abs(rest.mm_per_rad2) > MAX_TAKEN_BACK * abs(solved)
    return None if taken_back else replace(rest, mm_per_rad2=solved + rest.mm_per_rad2)


def pupil_is_significant(calibration: Calibration, central: Calibration) -> bool:
    """Return whether the pupil of a calibration moves significantly, by the residuals of the same lens with or without
    it. Both are linearised with any displacement of a central lens free, and the one that is nearer to the joint
    minimum leaves less: a pupil solved for instead of a displacement has moved lens and boards far away from it."""
    again, before = solved_again(calibration), MovingPupil.of(central)
    if again is None or (before is not None and before.left_px < again.left_px and before.chance > PUPIL_SIGNIFICANCE):
        return False
    return again.chance <= PUPIL_SIGNIFICANCE


def _products(calibration: Calibration) -> tuple[FloatArray, IntArray, int, int] | None:
    """Return J^T J (V, K, K) of V views with poses eliminated, the image (V,) of each, P, and the number of residuals
    less that of the poses' parameters; None with too few views.
    The columns of J are derivatives by what is common to all images (the camera's P parameters, displacements of the
    image and bows of the boards) and by the pupil, and the residual."""
    views = [view for view in calibration.views if np.count_nonzero(view.kept) >= MIN_INFORMATIVE_CORNERS]
    if len({view.image for view in views}) < MIN_IMAGES:
        return None
    products = products_of(views, lambda some: _rows(calibration, some))
    if not np.isfinite(products).all():
        return None
    length = root_diagonal(products)
    image = np.unique([view.image for view in views], return_inverse=True)[1]
    residuals = sum(2 * int(np.count_nonzero(view.kept)) - 6 for view in views)
    return without_pose(products, length)[:, 6:, 6:], image, calibration.camera.parameters.size, residuals


def _rows(calibration: Calibration, views: Sequence[ViewResult]) -> tuple[FloatArray, IntArray]:
    """Return the rows (2, K, N) for `_products`, those of the pose first, and the number of corners of each view."""
    rows, count = rows_of(calibration, views)
    p, bows = calibration.camera.parameters.size, columns_of(rows.shape[1])["bend"]
    poses = [view.cam_from_board for view in views]
    points = np.split(points_of(calibration, views), np.cumsum(count)[:-1])
    x, y, z = np.concatenate(
        [at @ pose.rotation.T + pose.translation_mm for at, pose in zip(points, poses, strict=True)]
    ).T
    # A pupil that moves forward is equivalent to a board that comes nearer: the third row of the translation.
    pupil = -(np.arctan2(np.hypot(x, y), z) ** 2) * rows[:, 5]
    moved = displacements(np.concatenate([view.pixels[view.kept] for view in views]), calibration.camera.size_px)
    parts = [rows[:, : 6 + p], moved, rows[:, bows], pupil[:, None], rows[:, -1:]]
    return np.concatenate(parts, axis=1), count


def _regression(gram: FloatArray, rows: IntArray, what: int) -> FloatArray:
    """Return the coefficients of the regression of the row `what` on `rows`, from their products `gram`."""
    return np.asarray(np.linalg.lstsq(gram[np.ix_(rows, rows)], gram[rows, what], rcond=NOT_FOLLOWED)[0])


def moving_pupil(calibration: Calibration, far: FarProjection) -> Iterator[Finding]:
    """Yield a finding where the pupil moves significantly and by a relevant amount."""
    asked = calibration.pupil is None and calibration.corners.neighbour_correlation > MIN_NEIGHBOUR_CORRELATION
    pupil = MovingPupil.of(calibration) if asked else None
    if pupil is None or pupil.chance > PUPIL_SIGNIFICANCE:
        return
    off = pupil.far_px(far)
    if off <= max(far.typical_px, SMALL_PX):
        return
    nearest, farthest, rim = _distances_and_rim(calibration)
    moved = abs(pupil.mm_per_rad2) * rim**2
    yield Finding.look(
        f"{NOT_CENTRAL}: its entrance pupil moves by at least {moved:.1f} mm between the optical axis and the "
        f"outermost corners (boards {nearest:.0f} to {farthest:.0f} mm away), which is not modelled; distant "
        f"points are projected with an error of at least {off:.2f} px",
        "calibrate at the distance of what is to be measured (with a larger board)",
    )


def modelled_pupil(calibration: Calibration) -> Iterator[Finding]:
    """Yield a finding with the movement of a pupil that is part of the calibration."""
    if calibration.pupil is None:
        return
    nearest, farthest, rim = _distances_and_rim(calibration)
    mm, sigma = calibration.pupil.shift_mm(rim)
    yield Finding.good(
        f"{NOT_CENTRAL}, which is modelled: its entrance pupil moves by {mm:.2f} ± "
        f"{calibration.widening * sigma:.2f} mm between the optical axis and the outermost corners "
        f"({np.degrees(rim):.0f} degrees; boards {nearest:.0f} to {farthest:.0f} mm away); exports to central "
        "models omit it and are exact for distant points only"
    )


def may_move(calibration: Calibration, far: FarProjection) -> bool:
    """Return whether a moving pupil should be solved for: its first-order estimate is significant at ASKED_AT, or the
    lens is wide, and far points may be displaced by a relevant amount, against `far` of the calibration. The fit
    decides then; all that `moving_pupil` says passes these limits, which are lower."""
    if calibration.corners.neighbour_correlation <= MIN_NEIGHBOUR_CORRELATION:
        return False
    pupil = MovingPupil.of(calibration)
    if pupil is None:
        return False
    *_, rim = _distances_and_rim(calibration)
    if rim <= WIDE_FROM_RAD and pupil.chance > ASKED_AT:
        return False
    uncertain = EXCLUDED_SIGMAS * pupil.sigma_mm_per_rad2 / max(abs(pupil.mm_per_rad2), np.finfo(float).tiny)
    more = 1.0 + uncertain if rim > WIDE_FROM_RAD else 1.0
    return more * pupil.far_px(far) > MIN_FOUND * SMALL_PX


def _distances_and_rim(calibration: Calibration) -> tuple[float, float, float]:
    """Return the DISTANCES of the corners, mm, and their largest angle from the axis, rad."""
    points = calibration.corners.in_cam(np.flatnonzero(calibration.corners.kept))
    distance = np.linalg.norm(points, axis=1)
    nearest, farthest = np.quantile(distance, DISTANCES).tolist()
    return nearest, farthest, float(np.arccos(np.clip(points[:, 2] / distance, -1.0, 1.0)).max())
