"""Two calibrations: is their difference what their uncertainties predict, or are these two cameras?

A camera calibrated from boards alone has a free rotation, which the boards' poses take up. So the difference is taken
after the best rotation, over the pixels where both had boards, and what is predicted for it from the two covariances is
taken over the same pixels, with the same three rotations projected out.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from rigkit.calibration.clustered import NULL_DRAWS, drawn_errors
from rigkit.calibration.coverage import covered_by_boards
from rigkit.calibration.result import Calibration
from rigkit.calibration.uncertainty import projection_design
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import CameraDifference, compare_cameras, grid_pixels
from rigkit.cameras.convert import refit_camera
from rigkit.core.arrays import FloatArray, Pixels

__all__ = ["CalibrationComparison", "CameraVerdict", "compare_calibrations"]

REFIT_SIGMA = 0.5
"""What the models make of one lens is known from a refit to about half: poses and noise had their part in the fits."""
SAME_CHANCE = 0.01
"""A difference this unlikely for one and the same camera is no chance."""
COVARIANCE_FLOOR_PX = 0.05
"""Of no combination of the parameters does a covariance from images know that it moves the projection by less."""
IMPORTANT_PX = 0.1
"""What is smaller is of no importance, however surely it is there: corners of real images are hardly better."""


class CameraVerdict(StrEnum):
    """What a difference means."""

    SAME = "no contradiction"
    UNIMPORTANT = "differs by more than chance, of no importance"
    OTHER = "another camera or a moved lens"


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationComparison:
    """The difference of two calibrations beside what their uncertainties predict.

    Attributes
    ----------
    difference : where both had boards, after the best rotation.
    predicted_px : the usual rms difference of two calibrations of one camera, there and after the best rotation: half
        of them differ by more. A difference is mostly of one kind (the focal length), and the mean of its square is
        that of a few large ones.
    chance : probability of a difference at least this large if both were calibrations of the same, unchanged camera,
        each in its own model.
    same_model : both are of one model and size.
    """

    difference: CameraDifference
    predicted_px: float
    chance: float
    same_model: bool

    @property
    def ratio(self) -> float:
        """The rms difference over the one predicted: about 1 for one and the same camera."""
        return self.difference.rms_px / max(self.predicted_px, np.finfo(float).tiny)

    @property
    def verdict(self) -> CameraVerdict:
        if self.chance >= SAME_CHANCE:
            return CameraVerdict.SAME
        return CameraVerdict.UNIMPORTANT if self.difference.rms_px < IMPORTANT_PX else CameraVerdict.OTHER

    @property
    def same(self) -> bool:
        """Nothing says that these are two cameras, or that the lens moved by anything of importance."""
        return self.verdict is not CameraVerdict.OTHER


def compare_calibrations(
    a: Calibration, b: Calibration, *, grid: tuple[int, int] = (40, 30), seed: int = 0
) -> CalibrationComparison:
    """Compare two calibrations over the image of `a`.

    Raises InputError or DegenerateError where the images differ in size, or the boards of the two had too little of it
    in common.

    Notes
    -----
    The null distribution of the difference, of its size and of its size in units of what is expected of it, is
    sampled: both calibrations' errors are drawn from their covariances (Student's t with the degrees of freedom that
    these have) and turned into differences by the projection's derivatives. Models of different kinds or sizes show one
    lens differently, which no covariance knows: that difference, from each camera refitted as the other is modelled, is
    a part of the null.
    """
    pixels = grid_pixels(a.camera.size_px, grid)
    both = covered_by_boards(a, pixels) & covered_by_boards(b, pixels)
    difference = compare_cameras(a.camera, b.camera, grid=grid, mask=both)
    pixels = difference.pixels[difference.covered]
    rays = a.camera.unproject(pixels)[0]
    designs = [_design(a, rays), _design(b, rays @ difference.b_from_a.T)]
    # The rotation that the comparison fits, at first order. In two calibrations of one camera both are the same.
    turn = np.linalg.qr(designs[0][:, -3:])[0]
    by_model = _by_model(a, b, difference, turn)[:, None]
    columns = [design[:, :-3] for design in designs] + [by_model]
    together = np.concatenate([column - turn @ (turn.T @ column) for column in columns], axis=1)
    gram = together.T @ together / len(pixels)
    rng = np.random.default_rng(seed)
    drawn = np.concatenate(
        [
            drawn_errors(a.covariance, a.freedom, rng),
            -drawn_errors(b.covariance, b.freedom, rng),
            1.0 + REFIT_SIGMA * rng.normal(size=(1, NULL_DRAWS)),
        ]
    )
    expected_by = np.zeros((len(gram), len(gram)))
    p = a.camera.parameters.size
    expected_by[:p, :p], expected_by[p:-1, p:-1] = a.covariance, b.covariance
    expected_by[-1, -1] = 1.0 + REFIT_SIGMA**2
    found = difference.difference_px[difference.covered].reshape(-1)
    chance = _chance(found - turn @ (turn.T @ found), together, expected_by, drawn)
    usual = float(np.sqrt(np.median(np.einsum("kn,kn->n", drawn, gram @ drawn))))
    return CalibrationComparison(difference, usual, chance, _kind(a.camera) == _kind(b.camera))


def _chance(found: FloatArray, design: FloatArray, covariance: FloatArray, drawn: FloatArray) -> float:
    """Return the probability of a difference as large as `found` (2 N,), from draws (K, NULL_DRAWS) of the errors of K
    unknowns, their derivatives `design` (2 N, K) and covariance.

    Two sizes count, and the one that says more is compared with what it would say by chance (Tippett's combination):
    the mean square, which large differences in few ways show best, and the difference in units of what is expected
    (Mahalanobis), in which each way to differ is judged by how far it may: a part of a pixel is small beside what a
    principal point may do, and plain beside what a focal length may. What is known better than COVARIANCE_FLOOR_PX is
    taken for known to so much: of the surest combinations a covariance from some images says least.
    """
    pixels = len(found) / 2.0
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    basis, how = np.linalg.qr(design * safe / np.sqrt(pixels))
    spread, axes = np.linalg.eigh(how @ (covariance / np.outer(safe, safe)) @ how.T)
    known = np.maximum(spread, 0.0) + COVARIANCE_FLOOR_PX**2
    total = float(found @ found) / pixels
    seen = (axes.T @ (basis.T @ found)) ** 2 / pixels
    beyond = max(total - float(seen.sum()), 0.0)
    null = (axes.T @ (how @ (drawn / safe[:, None]))) ** 2
    weighted = float((seen / known).sum()) + beyond / COVARIANCE_FLOOR_PX**2
    likely = np.minimum(_exceeded(total, null.sum(axis=0)), _exceeded(weighted, (null / known[:, None]).sum(axis=0)))
    return float(np.count_nonzero(likely <= likely[0]) / len(likely))


def _exceeded(size: float, null: FloatArray) -> FloatArray:
    """Return for `size` and then for each of `null` (N,) by which part of all of them it is reached, (N + 1,)."""
    everything = np.concatenate([[size], null])
    order = np.argsort(np.argsort(-everything, kind="stable"), kind="stable")
    return np.asarray((order + 1.0) / len(everything))


def _by_model(a: Calibration, b: Calibration, difference: CameraDifference, turn: FloatArray) -> FloatArray:
    """Return the difference (2 M,), px at the covered pixels, that the two models alone make of one lens, after the
    rotation `turn` (2 M, 3)."""
    pixels = difference.pixels[difference.covered]
    out = np.zeros(2 * len(pixels))
    if _kind(a.camera) == _kind(b.camera):
        return out
    for sign, lens, like, like_from_lens in ((1.0, a, b, difference.b_from_a), (-1.0, b, a, difference.b_from_a.T)):
        # The lens in the other's model, fitted as that was: where that had its corners.
        at = np.concatenate([view.pixels for view in like.views])
        rays, valid = lens.camera.unproject(at)
        tried = []
        # A model may ask for its own axis: turned as a moved lens is, none follows what one did of the other.
        for how in (np.eye(3), like_from_lens):
            refitted = refit_camera(like.camera, rays[valid] @ how.T, at[valid])
            projected, seen = refitted.project(lens.camera.unproject(pixels)[0] @ how.T)
            off = np.where(seen[:, None], projected - pixels, 0.0).reshape(-1)
            tried.append(off - turn @ (turn.T @ off))
        out += sign * min(tried, key=lambda off: float(off @ off))
    # What one model cannot follow of the other shows in one of the two refits.
    return out


def _kind(camera: Camera) -> tuple[str, int]:
    return camera.model, camera.parameters.size


def _design(calibration: Calibration, rays: Pixels) -> FloatArray:
    """Return d pixel / d (parameters, turn of the rays), (2 N, P + 3)."""
    design = projection_design(calibration.camera, rays)
    return design.transpose(2, 0, 1).reshape(2 * len(rays), -1)
