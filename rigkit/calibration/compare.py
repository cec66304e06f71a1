"""Test whether two calibrations are of one unchanged camera: is their difference what their uncertainties predict?

A camera calibrated from boards alone has a free rotation, which the boards' poses absorb. So the difference is computed
after the best rotation, over the pixels that boards covered in both. The difference predicted from the two covariances
is computed over the same pixels, with the same three rotations projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.calibration.choosing.between_models import same_model
from rigkit.calibration.diagnosis.pupil import changes_with
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.clustered import NULL_DRAWS, drawn_errors
from rigkit.cameras.base import Camera, image_center
from rigkit.cameras.compare import CameraDifference, compare_cameras, grid_pixels
from rigkit.cameras.convert import refit_camera
from rigkit.core.arrays import FloatArray, Pixels, Rays

REFIT_SIGMA = 0.5
"""Relative standard deviation of the difference between models that a refit gives: noise and poses affect the fits."""
SAME_CHANCE = 0.01
"""Significance level: a difference less probable than this for one camera is not chance."""
COVARIANCE_FLOOR_PX = 0.05
"""Smallest standard deviation of a mode of the projection: a covariance from images is not more accurate than that."""
TYPICAL_SHARE = 0.9
"""Part of the differences of one camera between the limits `interval_px`."""
IMPORTANT_PX = 0.1
"""A smaller difference is of no importance, however significant: corners of real images are hardly better."""


class CameraVerdict(StrEnum):
    """Meaning of a difference."""

    SAME = "no contradiction"
    UNIMPORTANT = "differs by more than chance, of no importance"
    OTHER = "another camera or a moved lens"


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationComparison:
    """The difference of two calibrations, and the one that their uncertainties predict.

    Attributes
    ----------
    difference : over the pixels that boards covered in both, after the best rotation.
    predicted_px : median of the rms difference of two calibrations of one camera, over the same pixels and after the
        best rotation. The mean square would be dominated by a few large differences: most of a difference is one mode
        (the focal length, which correlates with the boards' distances), so that it varies like a single number.
    interval_px : limits that contain 90 % of such differences; one above the second has a probability below 0.1.
    chance : probability of a difference at least this large if both were calibrations of the same, unchanged camera,
        each in its own model.
    same_model : both are of one model and size.
    """

    difference: CameraDifference
    predicted_px: float
    interval_px: tuple[float, float]
    chance: float
    same_model: bool

    @property
    def ratio(self) -> float:
        """The rms difference over the one predicted: about 1 for one camera."""
        return self.difference.rms_px / max(self.predicted_px, np.finfo(float).tiny)

    @property
    def verdict(self) -> CameraVerdict:
        if self.chance >= SAME_CHANCE:
            return CameraVerdict.SAME
        return CameraVerdict.UNIMPORTANT if self.difference.rms_px < IMPORTANT_PX else CameraVerdict.OTHER

    @property
    def same(self) -> bool:
        """Whether no important difference is significant."""
        return self.verdict is not CameraVerdict.OTHER


def compare_calibrations(
    a: Calibration, b: Calibration, *, grid: tuple[int, int] = (40, 30), seed: int = 0
) -> CalibrationComparison:
    """Compare two calibrations over the image of `a`.

    Raises InputError or DegenerateError where the images differ in size, or the boards of both covered too few common
    pixels.

    Notes
    -----
    The null distribution of the difference is sampled: errors of both calibrations are drawn from their covariances
    (Student's t with their degrees of freedom) and propagated by the projection's derivatives. Models of different kind
    or size differ for one lens, which no covariance includes: that difference is computed by refitting each camera with
    the model of the other, and added to the null. So is what a central lens would change with the pupil of the other.
    """
    pixels = grid_pixels(a.camera.size_px, grid)
    both = covered_by_boards(a, pixels) & covered_by_boards(b, pixels)
    difference = compare_cameras(a.camera, b.camera, grid=grid, mask=both)
    pixels = difference.pixels[difference.covered]
    rays = a.camera.unproject(pixels)[0]
    designs = [_design(a, rays), _design(b, rays @ difference.b_from_a.T)]
    # The rotation that the comparison fits, at first order. In two calibrations of one camera both are the same.
    turn = np.linalg.qr(designs[0][:, -3:])[0]
    by_model = _model_difference(a, b, difference, turn) + _without(_pupil_difference(a, b, designs), turn)
    p = a.camera.parameters.size
    rng = np.random.default_rng(seed)
    drawn = np.concatenate(
        [
            drawn_errors(a.covariance, a.freedom, rng),
            -drawn_errors(b.covariance, b.freedom, rng),
            1.0 + REFIT_SIGMA * rng.normal(size=(1, NULL_DRAWS)),
        ]
    )
    covariance = np.zeros((len(drawn), len(drawn)))
    covariance[:p, :p], covariance[p:-1, p:-1] = a.covariance, b.covariance
    covariance[-1, -1] = 1.0 + REFIT_SIGMA**2
    columns = [*(design[:, :-3] for design in designs), by_model[:, None]]
    found = _Modes.of(
        _without(difference.difference_px[difference.covered].reshape(-1), turn),
        np.concatenate([_without(column, turn) for column in columns], axis=1),
        covariance,
        drawn,
    )
    chance, unusual = found.chance([_without(step, turn) for step in _lens_changes(a.camera, pixels)])
    typical = np.sqrt(np.quantile((found.null**2).sum(axis=0), (1.0 - TYPICAL_SHARE - unusual, 0.5, 1.0 - unusual)))
    low, median, high = typical.tolist()
    return CalibrationComparison(difference, median, (low, high), chance, same_model(a.camera, b.camera))


def _without(column: FloatArray, turn: FloatArray) -> FloatArray:
    """Return differences (2 N,) or (2 N, K) with the rotations `turn` (2 N, 3), orthonormal columns, projected out."""
    return np.asarray(column - turn @ (turn.T @ column))


def _lens_changes(camera: Camera, pixels: Pixels) -> list[FloatArray]:
    """Return the common changes of a lens as directions (2 N, K) at pixels (N, 2): focus or zoom (a scale about the
    principal point), and a shift of lens or sensor."""
    centre = camera.axis_px
    if not np.isfinite(centre).all():
        centre = image_center(camera.size_px)
    return [(pixels - centre).reshape(-1, 1), np.tile(np.eye(2), (len(pixels), 1))]


@dataclass(frozen=True, eq=False, slots=True)
class _Modes:
    """A difference over N pixels in the principal modes of the predicted one: uncorrelated combinations of unknowns.

    Attributes
    ----------
    axes : (2 N, K) the modes over the pixels, of mean square one.
    found : (K,) the difference found, px rms in each mode.
    null : (K, NULL_DRAWS) differences drawn for one camera.
    expected : (K,) their variances.
    beyond : mean square of the part of the difference outside all modes, px^2.
    """

    axes: FloatArray
    found: FloatArray
    null: FloatArray
    expected: FloatArray
    beyond: float

    @classmethod
    def of(cls, found: FloatArray, design: FloatArray, covariance: FloatArray, drawn: FloatArray) -> _Modes:
        """Return a difference (2 N,) in the modes of K unknowns, from the derivatives `design` (2 N, K), the covariance
        and drawn errors (K, NULL_DRAWS)."""
        pixels = len(found) / 2.0
        # Parameters have different units; in standard deviations they are comparable.
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        safe = np.where(sigma > 0.0, sigma, 1.0)
        basis, how = np.linalg.qr(design * safe / np.sqrt(pixels))
        expected, turned = np.linalg.eigh(how @ (covariance / np.outer(safe, safe)) @ how.T)
        axes = basis @ turned / np.sqrt(pixels)
        modes = axes.T @ found
        beyond = max(float(found @ found) / pixels - float(modes @ modes), 0.0)
        null = turned.T @ (how @ (drawn / safe[:, None]))
        return cls(axes, modes, null, np.maximum(expected, 0.0), beyond)

    def chance(self, steps: Sequence[FloatArray]) -> tuple[float, float]:
        """Return the p-value of the difference found, and the level of a single test at which that is
        1 - TYPICAL_SHARE.

        Several tests are combined by their smallest p-value, with its distribution under the null (Tippett). Two are
        for any difference: its mean square, and its Mahalanobis distance. One for each of the `steps` (2 N, k): the
        generalised least-squares estimate of that step, in standard deviations, the most powerful test for it.
        COVARIANCE_FLOOR_PX is added to the standard deviation of each mode, as a covariance from few images is least
        reliable for the most certain modes.
        """
        known = (self.expected + COVARIANCE_FLOOR_PX**2)[:, None]
        null = self.null**2
        likely = [
            _p_values(float((self.found**2).sum()) + self.beyond, null.sum(axis=0)),
            _p_values(
                float((self.found**2 / known[:, 0]).sum()) + self.beyond / COVARIANCE_FLOOR_PX**2,
                (null / known).sum(axis=0),
            ),
        ]
        for step in steps:
            weighted = self.axes.T @ step / known
            inverse = np.linalg.pinv(weighted.T @ (self.expected[:, None] * weighted), hermitian=True)
            size, by_chance = weighted.T @ self.found, weighted.T @ self.null
            null_size = np.einsum("in,ij,jn->n", by_chance, inverse, by_chance)
            likely.append(_p_values(float(size @ inverse @ size), null_size))
        least = np.min(likely, axis=0)
        return float(np.count_nonzero(least <= least[0]) / len(least)), float(
            np.quantile(least[1:], 1.0 - TYPICAL_SHARE)
        )


def _p_values(size: float, null: FloatArray) -> FloatArray:
    """Return the p-values (N + 1,) of `size` and of each of `null` (N,): the part of all of them at least as large."""
    everything = np.concatenate([[size], null])
    order = np.argsort(np.argsort(-everything, kind="stable"), kind="stable")
    return np.asarray((order + 1.0) / len(everything))


def _model_difference(a: Calibration, b: Calibration, difference: CameraDifference, turn: FloatArray) -> FloatArray:
    """Return the difference (2 M,) px at the covered pixels between the two models fitted to one lens, with the
    rotations `turn` (2 M, 3) projected out."""
    pixels = difference.pixels[difference.covered]
    out = np.zeros(2 * len(pixels))
    if same_model(a.camera, b.camera):
        return out
    for sign, lens, like, like_from_lens in ((1.0, a, b, difference.b_from_a), (-1.0, b, a, difference.b_from_a.T)):
        # One lens refitted in the other's model, at the corners that the other was fitted to.
        at = np.concatenate([view.pixels for view in like.views])
        rays, valid = lens.camera.unproject(at)
        tried = []
        # The optical axis of a model with symmetry is that of its own calibration, or that of the other one.
        for rotation in (np.eye(3), like_from_lens):
            refitted = refit_camera(like.camera, rays[valid] @ rotation.T, at[valid])
            projected, seen = refitted.project(lens.camera.unproject(pixels)[0] @ rotation.T)
            tried.append(_without(np.where(seen[:, None], projected - pixels, 0.0).reshape(-1), turn))
        # The residual of a model that the other cannot represent is in one of the two refits.
        out += sign * min(tried, key=lambda off: float(off @ off))
    return out


def _pupil_difference(a: Calibration, b: Calibration, designs: Sequence[FloatArray]) -> FloatArray:
    """Return the difference (2 M,) px between a lens with a moving pupil and the central one that was fitted to it near
    the camera, from the `designs` of both; zero where both or neither have one. Few images do not show a pupil."""
    for sign, central, other, design in ((1.0, a, b, designs[0]), (-1.0, b, a, designs[1])):
        if central.pupil is None and other.pupil is not None:
            changes = changes_with(central, other.pupil)
            if changes is not None:
                return np.asarray(sign * design[:, :-3] @ changes)
    return np.zeros(len(designs[0]))


def _design(calibration: Calibration, rays: Rays) -> FloatArray:
    """Return d pixel / d (parameters, rotation of the rays), (2 N, P + 3)."""
    design = projection_design(calibration.camera, rays)
    return design.transpose(2, 0, 1).reshape(2 * len(rays), -1)
