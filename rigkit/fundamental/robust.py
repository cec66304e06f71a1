"""Robust relative pose from contaminated matches: minimal samples, a marginalised threshold, local optimisation.

The quality of a hypothesis is that of its points' Sampson distances r in sigmas, marginalised over the unknown noise
level s in [1, max_noise]: q(r) = mean over s of max(0, 1 - (r / (k s))^2), k the 99 % quantile. No threshold between
inlier and outlier is set; the same q gives the weights of the local optimisation, which is the maximum likelihood
refinement itself. Deterministic under a seeded generator. References: Fischler and Bolles; Chum, Matas, Kittler
("Locally optimized RANSAC"); Barath, Noskova, Matas ("MAGSAC++").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, IntArray, Mat3
from rigkit.errors import DegenerateError, InputError, RigkitError
from rigkit.fundamental.eight_point import essential_nearest
from rigkit.fundamental.local import SampsonRows
from rigkit.fundamental.minimal import essential_from_five_rows, essential_from_six_rows, planar_from_two_rows
from rigkit.fundamental.planar import solve_planar_batch
from rigkit.fundamental.pose import choose_pose, essential_from_pose
from rigkit.fundamental.refine import RefinedPose, refine_pose
from rigkit.fundamental.registry import fundamental_for
from rigkit.fundamental.rows import PLANAR_ENTRIES, affinity_rows, essential_from_planar, point_rows
from rigkit.fundamental.weights import usable_affinities
from rigkit.matches import Matches
from rigkit.posetype import PoseType

__all__ = ["RobustPose", "Sample", "marginal_quality", "marginal_weights", "robust_pose"]

Sample = Literal["points", "affine", "mixed"]
"""What minimal samples consist of: points only; affine correspondences only; one affine correspondence and points."""

QUANTILE = 2.576
MEDIAN_OF_NORMAL = 0.6745
BATCH = 64
WIDE = 4.0
LOCAL_TRIES = 2
PROMISING = 0.6
FINALISTS = 6
LEAST_NOISE = 1.5
GOOD_AFFINE = 0.1
"""Share of clean samples with an affinity that lead to the optimum (measured: a third at 0.05 noise of A)."""


@dataclass(frozen=True, eq=False, slots=True)
class RobustPose:
    """A pose found among contaminated matches.

    Attributes
    ----------
    refined : the pose, refined on the weighted matches.
    inliers : (N,) bool, matches that fit at twice the noise that the fitting ones show.
    weights : (N,) of the last local optimisation.
    quality : sum of q over the matches at that noise.
    trials : samples drawn.
    """

    refined: RefinedPose
    inliers: BoolArray
    weights: FloatArray
    quality: float
    trials: int


def marginal_quality(r: FloatArray, max_noise: FloatArray | float) -> FloatArray:
    """Return q (0 to 1) of residuals in sigmas; `max_noise` may be an array that broadcasts with `r`."""
    rho = np.abs(r) / QUANTILE
    low = np.clip(rho, 1.0, max_noise)
    value = (max_noise - low - rho**2 * (1.0 / low - 1.0 / max_noise)) / (max_noise - 1.0)
    return np.asarray(np.where(rho < max_noise, value, 0.0))


def marginal_weights(r: FloatArray, max_noise: FloatArray | float) -> FloatArray:
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
    rows = SampsonRows.of(matches)
    if kind in (PoseType.STANDARD, PoseType.FORWARD):
        finalists, trials = fundamental_for(kind).solve(matches, "points").E21[None], 0
    else:
        size = _sample_size(matches, kind, sample)
        search = _Search(matches, rows, kind, sample, size, max_noise)
        finalists, trials = search.run(rng, confidence, max_trials)
    if not len(finalists):
        raise DegenerateError(f"no pose in {trials} samples of {len(matches)} matches; check how they were matched")
    # The search allowed for much noise; what the matches that fit show is the noise there is. At that level the local
    # optima, nearly equal before, part company.
    fitting = np.abs(rows.residuals(finalists[:1])[0])
    fitting = fitting[fitting < QUANTILE * max_noise]
    shown = float(np.median(fitting)) / MEDIAN_OF_NORMAL if fitting.size else max_noise
    final = min(max_noise, max(2.0 * shown, LEAST_NOISE))
    finalists = rows.improved(finalists, kind, np.full(len(finalists), final), _loss)
    order = np.argsort(-marginal_quality(rows.residuals(finalists), final).sum(axis=1), kind="stable")
    for E21 in finalists[order]:
        try:
            end = _refined(matches, rows, E21, kind, level_sigma_rad, final)
        except RigkitError:
            continue
        r = rows.residuals(essential_from_pose(end.cam2_from_cam1)[None])[0]
        q, weights = _loss(r, final)
        return RobustPose(end, np.asarray(np.abs(r) < QUANTILE * final), weights, float(q.sum()), trials)
    raise DegenerateError(f"no pose that puts the matches in front of both cameras among {len(finalists)} found")


@dataclass(frozen=True, eq=False, slots=True)
class _Search:
    """Sampling with local optimisation of promising hypotheses."""

    matches: Matches
    rows: SampsonRows
    kind: str
    sample: Sample
    size: int
    max_noise: float

    def run(self, rng: np.random.Generator, confidence: float, max_trials: int) -> tuple[Mat3, int]:
        """Return the best essential matrices (H, 3, 3), locally optimised, best first, and the number of samples."""
        best, quality = np.zeros((0, 3, 3)), np.zeros(0)
        trials, needed, best_rank = 0, float(max_trials), 0.0
        affine = np.flatnonzero(usable_affinities(self.matches))
        while trials < needed:
            trials += BATCH
            index = _draw(rng, len(self.matches), affine, self.sample, self.size)
            candidates = _hypotheses(self.matches, index, self.kind, self.sample)
            if not len(candidates):
                continue
            # A sample's own noise can hide a good hypothesis at the final noise level: rank at a wider one.
            rank = self.quality(candidates, WIDE * self.max_noise)
            tried = np.argsort(-rank, kind="stable")[:LOCAL_TRIES]
            tried = tried[rank[tried] >= PROMISING * best_rank]
            if len(tried):
                better = self.improved(candidates[tried])
                best, quality = np.concatenate([best, better]), np.append(quality, self.quality(better, self.max_noise))
                order = np.argsort(-quality, kind="stable")[:FINALISTS]
                best, quality = best[order], quality[order]
                best_rank = float(self.quality(best[:1], WIDE * self.max_noise)[0])
            share = float(np.mean(np.abs(self.rows.residuals(best[:1])[0]) < QUANTILE * self.max_noise))
            # Affinities are noisy: of the samples without outliers only some are good enough to start from.
            hit = share**self.size * (1.0 if self.sample == "points" else GOOD_AFFINE)
            needed = min(float(max_trials), float(np.log(1.0 - confidence) / np.log1p(-np.clip(hit, 1e-12, 1 - 1e-12))))
        return best, trials

    def quality(self, E21: Mat3, noise: float) -> FloatArray:
        """Return the sum of q over the matches of hypotheses (H, 3, 3)."""
        return np.asarray(marginal_quality(self.rows.residuals(E21), noise).sum(axis=1))

    def improved(self, E21: Mat3) -> Mat3:
        """Return what `E21` (H, 3, 3) lead to, each twice, (2 H, 3, 3).

        Widely first, which forgives a poor start; and at once, which an outlier with leverage cannot lure.
        """
        out, count = np.concatenate([E21, E21]), len(E21)
        for wide, narrow in ((WIDE * self.max_noise, self.max_noise), (self.max_noise, LEAST_NOISE)):
            out = self.rows.improved(out, self.kind, np.repeat([wide, narrow], count), _loss)
        return out


def _loss(r: FloatArray, max_noise: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    return marginal_quality(r, max_noise), marginal_weights(r, max_noise)


def _refined(
    matches: Matches, rows: SampsonRows, E21: Mat3, kind: str, level_sigma_rad: float | None, max_noise: float
) -> RefinedPose:
    """Return the maximum likelihood pose under the marginalised loss, from the essential matrix `E21`."""
    r = np.abs(rows.residuals(E21[None])[0])
    # Cheirality by the matches that fit best: those that only might fit are half in front by chance.
    near = r <= max(QUANTILE, float(np.sort(r)[min(10, len(r)) - 1]))
    start = choose_pose(E21, matches.rays1[near], matches.rays2[near], kind)

    def weights(r: FloatArray) -> FloatArray:
        return marginal_weights(r, max_noise)

    return refine_pose(matches, start, kind, level_sigma_rad, robust=weights)


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
