"""Robust relative pose from contaminated matches: minimal samples, a marginalised threshold, local optimisation.

The quality of a hypothesis is that of its points' Sampson distances r in sigmas, marginalised over the unknown noise
level s in [1, max_noise]: q(r) = mean over s of max(0, 1 - (r / (k s))^2), k the 99 % quantile. No threshold between
inlier and outlier is set; the same q gives the weights of the local optimisation, which is the maximum likelihood
refinement itself. Deterministic under a seeded generator. References: Fischler and Bolles; Chum, Matas, Kittler
("Locally optimized RANSAC"); Barath, Noskova, Matas ("MAGSAC++").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, IntArray, Mat3
from rigkit.errors import DegenerateError, InputError, RigkitError
from rigkit.fundamental.eight_point import essential_nearest
from rigkit.fundamental.minimal import essential_from_five_rows, essential_from_six_rows, planar_from_two_rows
from rigkit.fundamental.planar import solve_planar_batch
from rigkit.fundamental.pose import choose_pose, essential_from_pose
from rigkit.fundamental.refine import RefinedPose, refine_pose
from rigkit.fundamental.registry import fundamental_for
from rigkit.fundamental.rows import PLANAR_ENTRIES, affinity_rows, essential_from_planar, point_rows
from rigkit.fundamental.weights import usable_affinities
from rigkit.geometry.sampson import sampson_distances
from rigkit.matches import Matches
from rigkit.posetype import PoseType

__all__ = ["RobustPose", "Sample", "marginal_quality", "marginal_weights", "robust_pose"]

Sample = Literal["points", "affine", "mixed"]
"""What minimal samples consist of: points only; affine correspondences only; one affine correspondence and points."""

QUANTILE = 2.576
BATCH = 64
WIDE = 4.0
LOCAL_TRIES = 3
PROMISING = 0.6
GOOD_AFFINE = 0.1
"""Share of clean samples with an affinity that lead to the optimum (measured: a third at 0.05 noise of A)."""


@dataclass(frozen=True, eq=False, slots=True)
class RobustPose:
    """A pose found among contaminated matches.

    Attributes
    ----------
    refined : the pose, refined on the weighted matches.
    inliers : (N,) bool, matches that fit at the highest noise level considered and lie in front of both cameras.
    weights : (N,) of the last local optimisation.
    quality : sum of q over the matches.
    trials : samples drawn.
    """

    refined: RefinedPose
    inliers: BoolArray
    weights: FloatArray
    quality: float
    trials: int


def marginal_quality(r: FloatArray, max_noise: float) -> FloatArray:
    """Return q (0 to 1) of residuals in sigmas."""
    rho = np.abs(r) / QUANTILE
    low = np.clip(rho, 1.0, max_noise)
    value = (max_noise - low - rho**2 * (1.0 / low - 1.0 / max_noise)) / (max_noise - 1.0)
    return np.asarray(np.where(rho < max_noise, value, 0.0))


def marginal_weights(r: FloatArray, max_noise: float) -> FloatArray:
    """Return the weights -q'(r) / r, 1 for small residuals and 0 beyond the highest noise level."""
    low = np.clip(np.abs(r) / QUANTILE, 1.0, max_noise)
    return np.asarray((1.0 / low - 1.0 / max_noise) / (1.0 - 1.0 / max_noise))


def robust_pose(
    matches: Matches,
    rng: np.random.Generator,
    *,
    pose_type: PoseType | str = PoseType.GENERAL,
    sample: Sample = "points",
    max_noise: float = 6.0,
    confidence: float = 0.999,
    max_trials: int = 4000,
    level_sigma_rad: float | None = None,
) -> RobustPose:
    """Return the pose that most matches agree with.

    Parameters
    ----------
    matches : contaminated; their sigmas are the smallest noise expected.
    pose_type : general or planar are sampled; standard and forward have nothing to sample and are only refined.
    sample : see Sample. Affine correspondences need fewer draws: two instead of five, one instead of two.
    max_noise : highest noise level considered, in sigmas of the matches.
    confidence : of having drawn a sample without outliers, given the share of inliers found so far.

    Raises
    ------
    InputError
        Too few matches for a sample, or affinities asked for where there are none.
    DegenerateError
        No sample gave a pose.
    """
    kind = str(pose_type)
    if kind in (PoseType.STANDARD, PoseType.FORWARD):
        best: Mat3 | None = fundamental_for(kind).solve(matches, "points").E21
        trials = 0
    else:
        size = _sample_size(matches, kind, sample)
        best, trials = _search(matches, rng, kind, sample, size, max_noise, confidence, max_trials)
    if best is None:
        raise DegenerateError(f"no pose in {trials} samples of {len(matches)} matches; check how they were matched")
    end = _local(matches, best, kind, level_sigma_rad, max_noise)
    E21 = essential_from_pose(end.cam2_from_cam1)
    r = _residuals(matches, E21[None])[0]
    return RobustPose(
        end,
        np.asarray(np.abs(r) < QUANTILE * max_noise),
        marginal_weights(r, max_noise),
        float(marginal_quality(r, max_noise).sum()),
        trials,
    )


def _search(
    matches: Matches,
    rng: np.random.Generator,
    kind: str,
    sample: Sample,
    size: int,
    max_noise: float,
    confidence: float,
    max_trials: int,
) -> tuple[Mat3 | None, int]:
    """Return the best essential matrix, locally optimised, and the number of samples drawn."""
    best, best_quality, best_rank, trials, needed = None, 0.0, 0.0, 0, float(max_trials)
    affine = np.flatnonzero(usable_affinities(matches))
    points = replace(matches, A21=None, sigma_A=None)
    while trials < needed:
        trials += BATCH
        candidates = _hypotheses(matches, _draw(rng, len(matches), affine, sample, size), kind, sample)
        if not len(candidates):
            continue
        # A sample's own noise can hide a good hypothesis at the final noise level: rank at a wider one.
        rank = marginal_quality(_residuals(matches, candidates), WIDE * max_noise).sum(axis=1)
        for index in np.argsort(-rank)[:LOCAL_TRIES]:
            if rank[index] < PROMISING * best_rank:
                break
            candidate = candidates[index]
            better = _improved(points, candidate, kind, max_noise)
            quality = float(marginal_quality(_residuals(matches, better[None])[0], max_noise).sum())
            if quality > best_quality:
                best, best_quality = better, quality
                best_rank = float(marginal_quality(_residuals(matches, better[None])[0], WIDE * max_noise).sum())
        if best is None:
            continue
        share = float(np.mean(np.abs(_residuals(matches, best[None])[0]) < QUANTILE * max_noise))
        # Affinities are noisy: of the samples without outliers only some are good enough to start from.
        hit = min(max(share**size * (1.0 if sample == "points" else GOOD_AFFINE), 1e-12), 1.0 - 1e-12)
        needed = min(float(max_trials), float(np.log(1.0 - confidence) / np.log1p(-hit)))
    return best, trials


def _improved(matches: Matches, E21: Mat3, kind: str, max_noise: float) -> Mat3:
    """Return the essential matrix after local optimisation at the wide noise level, then at the final one."""
    for level in (WIDE * max_noise, max_noise):
        try:
            E21 = essential_from_pose(_local(matches, E21, kind, None, level).cam2_from_cam1)
        except RigkitError:
            return E21
    return E21


def _local(matches: Matches, E21: Mat3, kind: str, level_sigma_rad: float | None, max_noise: float) -> RefinedPose:
    """Return the maximum likelihood pose under the marginalised loss, from the essential matrix `E21`."""
    r = np.abs(_residuals(matches, E21[None])[0])
    # Cheirality by the matches that fit best: those that only might fit are half in front by chance.
    near = r <= max(QUANTILE, float(np.sort(r)[min(10, len(r)) - 1]))
    start = choose_pose(E21, matches.rays1[near], matches.rays2[near], kind)

    def loss(r: FloatArray) -> FloatArray:
        return marginal_weights(r, max_noise)

    return refine_pose(matches, start, kind, level_sigma_rad, robust=loss)


def _residuals(matches: Matches, E21: Mat3) -> FloatArray:
    """Return the Sampson distances (H, N) in sigmas of hypotheses (H, 3, 3)."""
    return sampson_distances(
        E21, matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2, matches.sigma1_px, matches.sigma2_px
    )


def _sample_size(matches: Matches, kind: str, sample: Sample) -> int:
    """Return how many matches a sample holds; raises InputError where the matches cannot provide it."""
    sizes = {
        "general": {"points": 5, "affine": 2, "mixed": 3},
        "planar": {"points": 2, "affine": 1, "mixed": 2},
    }
    if kind not in sizes or sample not in sizes[kind]:
        raise InputError(f"robust estimation knows no samples of kind '{sample}' for pose type '{kind}'")
    size = sizes[kind][sample]
    if len(matches) < size + 1:
        raise InputError(f"robust estimation: {len(matches)} matches, at least {size + 1} are needed")
    have = int(usable_affinities(matches).sum())
    wanted = {"points": 0, "affine": size, "mixed": 1}[sample]
    if have < wanted:
        raise InputError(f"samples '{sample}' need {wanted} affinities, the matches have {have}; use sample='points'")
    return size


def _draw(rng: np.random.Generator, count: int, affine: IntArray, sample: Sample, size: int) -> IntArray:
    """Return indices (BATCH, size) without repetition in a row; "mixed" begins with an affine correspondence."""
    if sample == "affine":
        return np.asarray(affine[np.argsort(rng.random((BATCH, len(affine))), axis=1)[:, :size]])
    order = rng.random((BATCH, count))
    if sample == "mixed":
        order[np.arange(BATCH), rng.choice(affine, BATCH)] = -1.0
    return np.asarray(np.argsort(order, axis=1)[:, :size])


def _hypotheses(matches: Matches, index: IntArray, kind: str, sample: Sample) -> Mat3:
    """Return all essential matrices (H, 3, 3) of samples (B, size)."""
    f1, f2 = matches.rays1[index], matches.rays2[index]
    rows = point_rows(f1, f2)
    affinities = 0 if sample == "points" else (index.shape[1] if sample == "affine" else 1)
    if affinities:
        which = index[:, :affinities]
        assert matches.A21 is not None
        more = affinity_rows(
            f1[:, :affinities],
            f2[:, :affinities],
            matches.jacobians1[which],
            matches.jacobians2[which],
            matches.A21[which],
        )
        rows = np.concatenate([rows, more.reshape(len(index), -1, 9)], axis=1)
    if kind == PoseType.PLANAR:
        rows = rows[..., np.array(PLANAR_ENTRIES)]
        if rows.shape[1] == 2:
            found = planar_from_two_rows(rows)
        else:
            found = essential_from_planar(solve_planar_batch(np.swapaxes(rows, 1, 2) @ rows)[0])[:, None]
    elif rows.shape[1] == 5:
        found = essential_from_five_rows(rows)
    else:
        found = essential_from_six_rows(rows)
    flat = found.reshape(-1, 3, 3)
    flat = flat[np.isfinite(flat).all(axis=(1, 2))]
    return essential_nearest(flat) if kind == PoseType.GENERAL else flat
