"""Checking a rig with images of any textured scene, by the epipolar geometry of matches. No board, and no scale.

Every match of a pair of cameras has a Sampson distance r with derivatives J by theta. A change d of theta changes r by
J d, so the scores -J^T r have the mean J^T J d, as those of boards have. The scatter of matches is estimated from the
residuals after the best fit of theta: otherwise a change would hide behind the scatter that it causes. Matches in one
part of the image have correlated errors: their variance is inflated by the disagreement of the parts relative to
independent matches. Errors common to the whole image would look like a change. One is known: patches are aligned by
affine warps, but the map between lenses with distortion is not affine. It moved matches by up to 0.02 px where their
noise is 0.007 px, and a mount between 90 degree lenses by 0.007 degrees. It is predicted from the rig and subtracted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.features import match_affine_features
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.refine_patches import HALF_WIDTH_OF_FEATURE, curvature_shift, levels_of_larger, window_variance
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels, RayJacobians, Rays
from rigkit.core.errors import DegenerateError
from rigkit.core.progress import Progress, silent
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.relative_pose import relative_pose
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew
from rigkit.geometry.sampson import sampson_distances
from rigkit.geometry.triangulation import triangulate_rays
from rigkit.optim.robust_scale import robust_sigma
from rigkit.planning.goal import Goal
from rigkit.planning.information import MIN_SIGMA_PX
from rigkit.validation.monitoring.evidence import FreshEvidence, Monitored
from rigkit.validation.monitoring.verdict import CalibrationCheck, evaluate_evidence
from rigkit.validation.monitoring.whitened import MIN_FREE_VARIANCE, disagreement

FEATURES = 2500
MIN_FRAME_MATCHES = 40
"""Fewer matches of a frame may all lie on one surface, or be outliers."""
PARTS = 4
"""Columns and rows of the parts of an image whose errors are treated as independent."""
WELSCH_SIGMAS = 2.985
"""Matches with larger residuals get almost no weight (J. E. Dennis, R. E. Welsch, 1978: efficiency 95 % for Gaussian
noise). In repetitive scenes up to a quarter of the matches are outliers, and not by far."""
FIT_ROUNDS, FIT_CUT = 15, 1e-5
"""Of the fit of theta to the matches; FIT_CUT is the smallest singular value used, relative to the largest."""
MATCHES_OF_DIRECTION = 5
"""Matches needed for each fitted direction, the strongest directions first: with fewer, residuals underestimate the
scatter. SIMULATED, 6 to 24 directions, none to a quarter of the matches wrong: of 1.5 matches a direction 5 % of the
estimated scatters are below a twentieth of the true one, of 3 below two thirds, of 5 none are below half."""
REACH_SIGMAS = 0.2
"""Steps of the central differences, in standard deviations of theta."""

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False, slots=True)
class PairMatches:
    """Matches between the cameras of index `first` and `second` in one frame: pixels (N, 2) in each."""

    first: int
    second: int
    pixels1: Pixels
    pixels2: Pixels


def matches_of_scenes(
    monitored: Monitored, frames: Sequence[Sequence[Any]], *, progress: Progress = silent
) -> list[PairMatches]:
    """Return the matches of the first camera with each other camera in images of textured scenes, one per camera in
    every frame; pairs with too few matches are left out."""
    found = []
    for k, images in enumerate(frames):
        progress("matches", k, len(frames))
        for c in range(1, len(images)):
            try:
                matches = scene_matches(monitored, (0, c), images[0], images[c])
            except DegenerateError:
                continue  # No texture in this one.
            if len(matches.pixels1) >= MIN_FRAME_MATCHES:
                found.append(matches)
    progress("matches", len(frames), len(frames))
    return found


def scene_matches(monitored: Monitored, numbers: tuple[int, int], image1: Any, image2: Any) -> PairMatches:
    """Return matches between the cameras of these indices, only of features that are unique in both images.

    Raises as `match_affine_features`.
    """
    found = match_affine_features(image1, image2, tilts=(1.0,), features_per_view=FEATURES, unique=True)
    return without_alignment_bias(monitored, numbers, found)


def without_alignment_bias(monitored: Monitored, numbers: tuple[int, int], found: Correspondences) -> PairMatches:
    """Return the matches of two cameras without the bias of affine alignment, the curvature of the map."""
    assert found.A21 is not None
    first, second = numbers
    cameras = monitored.cameras[first], monitored.cameras[second]
    motion = relative_pose(monitored.cam_from_rig[first], monitored.cam_from_rig[second])
    one, two = (
        _SeenRays.by(camera, pixels) for camera, pixels in zip(cameras, (found.pixels1, found.pixels2), strict=True)
    )
    points, near = triangulate_rays(one.rays, two.rays, motion, jacobians1=one.jacobians, jacobians2=two.jacobians)
    J1, J2 = pair_projection_jacobians(points, one.rays, one.jacobians, two.rays, two.jacobians, motion)
    normals, known = normals_from_affines(J1, J2, found.A21)
    known &= near & one.valid & two.valid
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = np.where(known[:, None], normals / np.sum(normals * points, axis=1)[:, None], np.nan)
    variance = window_variance(HALF_WIDTH_OF_FEATURE) * 4.0 ** levels_of_larger(found.A21)
    pixels2 = found.pixels2 - curvature_shift(found.pixels1, planes, variance, cameras, motion)
    return PairMatches(first, second, found.pixels1, pixels2)


def check_matches(monitored: Monitored, matches: Sequence[PairMatches], cost: Sequence[Goal] = ()) -> CalibrationCheck:
    """Return the verdict on matches of a rig's cameras; raises as `evidence_of_matches`."""
    return evaluate_evidence(monitored, lambda now: evidence_of_matches(now, matches), cost)


def evidence_of_matches(monitored: Monitored, matches: Sequence[PairMatches]) -> FreshEvidence:
    """Return the evidence of matches of a rig's cameras about theta.

    Raises DegenerateError without matches, or where they are outside the lenses' fields of view.
    """
    if not matches:
        raise DegenerateError(
            f"check: less than {MIN_FRAME_MATCHES} matches in every frame; show the rig a scene with texture and depth"
        )
    layout = monitored.layout
    n = layout.count
    information, scores, variances, disagreements = [], [], [], []
    squares, left_squares, count, freedom = 0.0, 0.0, 0, 0.0
    for pair, (residual, jacobian, good) in zip(matches, _linearised(monitored, matches), strict=True):
        if len(residual) == 0:
            raise DegenerateError("check: the lenses see none of the matches; check which camera took which picture")
        left, weight, sigma = _robust_residuals(residual, jacobian, layout.mount(pair.second))
        by_part = _parts(pair.pixels1[good], monitored.cameras[pair.first].size_px)
        own, score = np.zeros((PARTS**2, n, n)), np.zeros((PARTS**2, n))
        np.add.at(own, by_part, weight[:, None, None] * jacobian[:, :, None] * jacobian[:, None, :])
        np.add.at(score, by_part, -(weight * residual)[:, None] * jacobian)
        information.append(own.sum(axis=0))
        scores.append(score.sum(axis=0))
        ratio, free = disagreement(own / sigma**2, score / sigma**2)
        disagreements.append(ratio)
        variances.append(sigma**2 * ratio)
        # Parts with correlated errors count as one value each.
        freedom += min(free, np.count_nonzero(own.any(axis=(1, 2))) - 1.0)
        squares, count = squares + float((weight * residual**2).sum()), count + len(residual)
        left_squares += float((weight * left**2).sum())
    typical = float(np.median(variances))
    share = typical / np.array(variances)
    return FreshEvidence(
        information=share[:, None, None] * np.array(information),
        score=share[:, None] * np.array(scores),
        variance_px2=typical,
        rms_px=float(np.sqrt(squares / count)),
        expected_px=float(np.sqrt(left_squares / count)),
        corners=count,
        left_out=0,
        overdispersion=float(np.sqrt(np.median(disagreements))),
        freedom=max(freedom, 1.0),
    )


def _linearised(monitored: Monitored, matches: Sequence[PairMatches]) -> list[tuple[FloatArray, FloatArray, BoolArray]]:
    """Return for each of `matches` the Sampson distances (M,) px of those that both cameras see, their derivatives
    (M, T), and the mask (N,) of these matches."""
    found = {}
    for numbers in dict.fromkeys((pair.first, pair.second) for pair in matches):
        own = [k for k, pair in enumerate(matches) if (pair.first, pair.second) == numbers]
        pixels1, pixels2 = (np.concatenate([getattr(matches[k], name) for k in own]) for name in ("pixels1", "pixels2"))
        residual, jacobian = _derivatives(monitored, numbers, (pixels1, pixels2))
        ends = np.cumsum([len(matches[k].pixels1) for k in own[:-1]], dtype=np.int64)
        for k, r, J in zip(own, np.split(residual, ends), np.split(jacobian, ends), strict=True):
            good = np.isfinite(r) & np.isfinite(J).all(axis=1)
            found[k] = r[good], J[good], np.asarray(good)
    return [found[k] for k in range(len(matches))]


def _derivatives(
    monitored: Monitored, numbers: tuple[int, int], pixels: tuple[Pixels, Pixels]
) -> tuple[FloatArray, FloatArray]:
    """Return the Sampson distances (N,) px of matches of two cameras and their derivatives (N, T)."""
    layout, reach = monitored.layout, REACH_SIGMAS * np.sqrt(np.diag(monitored.covariance))
    poses = [monitored.cam_from_rig[c] for c in numbers]
    seen = [_SeenRays.by(monitored.cameras[c], p) for c, p in zip(numbers, pixels, strict=True)]
    residual = _distances(poses, seen)
    jacobian = np.zeros((len(residual), layout.count))

    def differ(k: int, ends: list[FloatArray]) -> None:
        jacobian[:, k] = (ends[0] - ends[1]) / (2.0 * reach[k])

    # A lens affects only its own rays, a mount no rays.
    for side, c in enumerate(numbers):
        camera, lens, mount = monitored.cameras[c], layout.cameras[c], layout.mounts[c]
        for k, step in _steps(lens, reach):
            changed = [camera.with_parameters(camera.parameters + change) for change in (step, -step)]
            differ(k, [_distances(poses, _replaced(seen, side, _SeenRays.by(one, pixels[side]))) for one in changed])
        for k, step in _steps(mount, reach) if mount is not None else ():
            moved = [poses[side].moved(change) for change in (step, -step)]
            differ(k, [_distances(_replaced(poses, side, one), seen) for one in moved])
    return residual, jacobian


def _steps(own: slice, reach: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """Yield the index of each parameter in `own` with a standard deviation, and a step along it."""
    for k, size in enumerate(reach[own].tolist()):
        if size > 0.0:
            step = np.zeros(own.stop - own.start)
            step[k] = size
            yield own.start + k, step


def _replaced(items: Sequence[Item], at: int, item: Item) -> list[Item]:
    """Return `items` with `item` at index `at`."""
    return [*items[:at], item, *items[at + 1 :]]


def _robust_residuals(residual: FloatArray, jacobian: FloatArray, mount: slice) -> tuple[FloatArray, FloatArray, float]:
    """Return the residuals (M,) after the best change of theta, the weights of the matches, robust to outliers, and
    their standard deviation."""
    left, sigma = residual, robust_sigma(residual)
    # A gross outlier pulls the fit towards itself. A match that is an outlier before the fit, or after a fit of the
    # mount alone, which follows outliers little, therefore keeps its low weight.
    weight = _weights(residual, sigma)
    for part in (mount, slice(None)):
        if jacobian[:, part].any():
            left, weight, sigma = _fit_columns(residual, jacobian[:, part], weight)
    return left, weight, max(sigma, MIN_SIGMA_PX)


def _fit_columns(
    residual: FloatArray, jacobian: FloatArray, before: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return the residuals after the best step along all columns, the weights, at most `before`, and the standard
    deviation."""
    size = np.linalg.norm(jacobian, axis=0)
    design = jacobian[:, size > 0.0] / size[size > 0.0]
    left, weight, sigma = residual, before, 0.0
    most = int(before.sum() / MATCHES_OF_DIRECTION)
    for _ in range(FIT_ROUNDS):
        root = np.sqrt(weight)
        basis, values, axes = np.linalg.svd(design * root[:, None], full_matrices=False)
        rank = min(int(np.count_nonzero(values > FIT_CUT * values[0])), most)
        step = axes[:rank].T @ (basis[:, :rank].T @ (residual * root) / values[:rank])
        left = residual - design @ step
        freedom = max(len(residual) - rank, 1) / len(residual)
        sigma = robust_sigma(left) / np.sqrt(freedom)
        # A match with high leverage, alone in its part of the image, has a small residual, inlier or outlier.
        free = np.sqrt(np.maximum(1.0 - (basis[:, :rank] ** 2).sum(axis=1), MIN_FREE_VARIANCE))
        weight = np.minimum(before, _weights(left / free, sigma))
    return left, weight, sigma


def _weights(left: FloatArray, sigma_px: float) -> FloatArray:
    return np.asarray(np.exp(-((left / (WELSCH_SIGMAS * max(sigma_px, MIN_SIGMA_PX))) ** 2)))


@dataclass(frozen=True, eq=False, slots=True)
class _SeenRays:
    """Rays (N, 3) of a camera's pixels, their derivatives (N, 3, 2) by the pixels, and their validity (N,)."""

    rays: Rays
    jacobians: RayJacobians
    valid: BoolArray

    @classmethod
    def by(cls, camera: Camera, pixels: Pixels) -> _SeenRays:
        rays, valid, jacobians = camera.rays_and_jacobians(pixels)
        return cls(rays, jacobians, valid)


def _distances(poses: Sequence[Rigid3], seen: Sequence[_SeenRays]) -> FloatArray:
    """Return the Sampson distances (N,) px of matches of two cameras with `poses` cam_from_rig, NaN outside the field
    of view of one of them."""
    motion = relative_pose(*poses)
    essential = skew(motion.translation_mm) @ motion.rotation
    first, second = seen
    found = sampson_distances(essential, first.rays, second.rays, first.jacobians, second.jacobians)
    return np.where(first.valid & second.valid, found, np.nan)


def _parts(pixels: Pixels, size_px: tuple[int, int]) -> IntArray:
    """Return the index of the part of the image that contains each of `pixels` (N, 2)."""
    place = np.clip((pixels + 0.5) / np.array(size_px) * PARTS, 0, PARTS - 1).astype(np.int64)
    return np.asarray(place[:, 1] * PARTS + place[:, 0])
