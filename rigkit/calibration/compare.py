"""Two calibrations: is their difference what their uncertainties predict, or are these two cameras?

A camera calibrated from boards alone has a free rotation, which the boards' poses take up. So the difference is taken
after the best rotation, over the pixels where both had boards, and what is predicted for it from the two covariances is
taken over the same pixels, with the same three rotations projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.clustered import NULL_DRAWS, drawn_errors
from rigkit.cameras.base import Camera, image_center
from rigkit.cameras.compare import CameraDifference, compare_cameras, grid_pixels
from rigkit.cameras.convert import refit_camera
from rigkit.core.arrays import FloatArray, Pixels

REFIT_SIGMA = 0.5
"""What the models make of one lens is known from a refit to about half: poses and noise had their part in the fits."""
SAME_CHANCE = 0.01
"""A difference this unlikely for one and the same camera is no chance."""
COVARIANCE_FLOOR_PX = 0.05
"""Of no combination of the parameters does a covariance from images know that it moves the projection by less."""
TYPICAL_SHARE = 0.9
"""Part of the differences of one and the same camera that is called usual."""
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
        of them differ by more. A difference is mostly of one kind (the focal length, which the distances of the boards
        take up): it scatters like the size of a single number, by several times, and its mean square is that of a few
        large ones.
    usual_px : between these lie nine of ten: what is larger than the second has a chance of less than one in ten.
    chance : probability of a difference at least this large if both were calibrations of the same, unchanged camera,
        each in its own model.
    same_model : both are of one model and size.
    """

    difference: CameraDifference
    predicted_px: float
    usual_px: tuple[float, float]
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
    The null distribution of the difference is sampled: both calibrations' errors are drawn from their covariances
    (Student's t with the degrees of freedom that these have) and turned into differences by the projection's
    derivatives. Models of different kinds or sizes show one lens differently, which no covariance knows: that
    difference, from each camera refitted as the other is modelled, is a part of the null.
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
    columns = [*(design[:, :-3] for design in designs), by_model]
    found = _Modes.of(
        _without(difference.difference_px[difference.covered].reshape(-1), turn),
        np.concatenate([_without(column, turn) for column in columns], axis=1),
        covariance,
        drawn,
    )
    chance, unusual = found.chance([_without(step, turn) for step in _touched(a.camera, pixels)])
    typical = np.sqrt(np.quantile((found.null**2).sum(axis=0), (1.0 - TYPICAL_SHARE - unusual, 0.5, 1.0 - unusual)))
    low, median, high = typical.tolist()
    same_model = _kind(a.camera) == _kind(b.camera)
    return CalibrationComparison(difference, median, (low, high), chance, same_model)


def _without(column: FloatArray, turn: FloatArray) -> FloatArray:
    """Return differences (2 N,) or (2 N, K) without what the rotation `turn` (2 N, 3), of orthonormal columns, does."""
    return np.asarray(column - turn @ (turn.T @ column))


def _touched(camera: Camera, pixels: Pixels) -> list[FloatArray]:
    """Return what happens to lenses, as ways to differ (2 N, K) at pixels (N, 2): focus or zoom make the image larger
    about the principal point; lens or sensor shift."""
    centre = camera.axis_px
    if not np.isfinite(centre).all():
        centre = image_center(camera.size_px)
    return [(pixels - centre).reshape(-1, 1), np.tile(np.eye(2), (len(pixels), 1))]


@dataclass(frozen=True, eq=False, slots=True)
class _Modes:
    """A difference over N pixels in its principal modes: the combinations of the unknowns that move the projection
    independently of each other.

    Attributes
    ----------
    axes : (2 N, K) the modes over the pixels, of mean square one.
    found : (K,) the difference found, px rms in each mode.
    null : (K, NULL_DRAWS) differences drawn for one and the same camera.
    expected : (K,) their variances.
    beyond : mean square of what of the difference is in none of the modes, px^2.
    """

    axes: FloatArray
    found: FloatArray
    null: FloatArray
    expected: FloatArray
    beyond: float

    @classmethod
    def of(cls, found: FloatArray, design: FloatArray, covariance: FloatArray, drawn: FloatArray) -> _Modes:
        """Return a difference (2 N,) in the modes of K unknowns, from their derivatives `design` (2 N, K), covariance
        and errors drawn (K, NULL_DRAWS)."""
        pixels = len(found) / 2.0
        # Parameters have units of their own: in standard deviations they can be compared.
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
        """Return the probability of a difference as large as the one found, and how unlikely one answer must be for
        that to be 1 - TYPICAL_SHARE: it is one of several.

        What is large is asked in several ways, and the one that says most is compared with what it would say by chance
        (Tippett's combination). Of anything: the mean square, and the difference in units of what is expected
        (Mahalanobis), in which each mode is judged by how far it may. Of each of the `steps` (2 N, k) to differ: how
        much of it there is by generalised least squares, in standard deviations; where it is the way, no other test
        finds less of it. What is known better than COVARIANCE_FLOOR_PX is taken for known to so much: of the surest
        combinations a covariance from some images says least.
        """
        known = (self.expected + COVARIANCE_FLOOR_PX**2)[:, None]
        null = self.null**2
        likely = [
            _exceeded(float((self.found**2).sum()) + self.beyond, null.sum(axis=0)),
            _exceeded(
                float((self.found**2 / known[:, 0]).sum()) + self.beyond / COVARIANCE_FLOOR_PX**2,
                (null / known).sum(axis=0),
            ),
        ]
        for step in steps:
            weighted = self.axes.T @ step / known
            inverse = np.linalg.pinv(weighted.T @ (self.expected[:, None] * weighted), hermitian=True)
            size, by_chance = weighted.T @ self.found, weighted.T @ self.null
            null_size = np.einsum("in,ij,jn->n", by_chance, inverse, by_chance)
            likely.append(_exceeded(float(size @ inverse @ size), null_size))
        least = np.min(likely, axis=0)
        return float(np.count_nonzero(least <= least[0]) / len(least)), float(
            np.quantile(least[1:], 1.0 - TYPICAL_SHARE)
        )


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
