"""Robust relative pose from matches with outliers: minimal samples, a marginalised threshold, local optimisation.

There is no inlier threshold: hypotheses are ranked, optimised and refined under the marginalised loss (local.py).
Several local optima, ranked with cheirality, are kept until the noise of the matches is estimated. Deterministic for a
seeded generator. Boards and facades partly fit many poses: `log_false_alarms` tells whether more matches fit than by
chance. References: Fischler and Bolles; Chum, Matas, Kittler ("Locally optimized RANSAC"); Barath, Noskova,
Matas ("MAGSAC++").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, lgamma
from typing import Literal

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType, axis_of
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.sampson import sampson_of_matches
from rigkit.kernels.pose import five_rows, six_rows
from rigkit.optim.robust_scale import MEDIAN_OF_NORMAL
from rigkit.relative_pose.refinement.local import QUANTILE, MarginalLoss, SampsonRows, marginal_quality
from rigkit.relative_pose.refinement.refine import SIGNIFICANT, RefinedPose, refine_pose
from rigkit.relative_pose.solvers.planar import planar_from_two_rows, solve_planar_batch
from rigkit.relative_pose.solvers.planar_ambiguity import compare_poses, other_ambiguous_poses
from rigkit.relative_pose.solvers.pose import cheirality_margin, choose_pose, essential_from_pose
from rigkit.relative_pose.solvers.registry import fundamental_for
from rigkit.relative_pose.solvers.rows import PLANAR_ENTRIES, affinity_rows, essential_from_planar, point_rows
from rigkit.relative_pose.solvers.weights import affinity_distances, usable_affinities

Sample = Literal["points", "affine"]
"""Type of the minimal samples: points or affine correspondences."""
SAMPLE_SIZES: dict[tuple[str, Sample], int] = {
    ("general", "points"): 5,
    ("general", "affine"): 2,
    ("planar", "points"): 2,
    ("planar", "affine"): 1,
}
CONFIDENCE = 0.999
"""Probability of at least one sample without outliers, given the share of inliers found so far."""
MAX_TRIALS = 4000

BATCH = 96
"""Samples per batch: slightly more than 40 % of outliers require."""
WIDE = 4.0
"""Factor of the highest noise level at which minimal samples, being noisy, are ranked and first optimised."""
LOCAL_TRIES = 8
"""Hypotheses of a batch that are optimised locally at the most."""
PROMISING = 0.6
"""Smallest quality of a hypothesis to be optimised locally, over the best quality so far."""
FINALISTS = 4
"""Local optima kept at each of the two noise levels."""
SAME_QUALITY = 1e-3
"""Optima whose qualities (in matches) differ by less count as one, given the precision of the local optimisation."""
MIN_NOISE = 1.5
"""Final noise level over the estimated noise of the inliers, and its lower bound in sigmas."""
NOISE_ITERATIONS = 3
"""Iterations of the noise estimate, each over the inliers at the noise level of the one before."""
GOOD_AFFINE = 0.1
"""Share of outlier-free samples with an affinity that lead to the optimum (measured: a third for sigma_A = 0.05)."""
SHIFTS = 40
"""Random wrong partners tried per point, so that the probability of a chance fit is known to a few per cent."""


@dataclass(frozen=True, eq=False, slots=True)
class RobustPose:
    """A pose estimated robustly.

    Attributes
    ----------
    refined : the pose, refined on the weighted matches.
    inliers : (N,) bool, matches within the 99 % quantile at MIN_NOISE times the estimated noise, not clearly behind
        a camera, and with a fitting affinity where it has a sigma.
    """

    refined: RefinedPose
    inliers: BoolArray


def robust_pose(
    matches: Matches,
    rng: np.random.Generator,
    *,
    pose_type: PoseType | str = PoseType.GENERAL,
    sample: Sample = "points",
    max_noise: float = 6.0,
) -> RobustPose:
    """Return the pose with the highest quality, refined.

    Raises InputError: too few matches or affinities for a sample, or max_noise is not above 1; DegenerateError: no
    sample gave a pose, or the inliers are coplanar and fit two poses, or they have no baseline.

    Parameters
    ----------
    matches : with outliers; their sigmas are the smallest noise expected.
    pose_type : general and planar poses are sampled; standard and forward poses need no sample.
    max_noise : highest noise level considered, in sigmas of the matches.
    """
    if not (np.isfinite(max_noise) and max_noise > 1.0):
        raise InputError(f"robust estimation: max_noise is in sigmas of the matches and above 1, got {max_noise}")
    kind = str(pose_type)
    rows = SampsonRows.of(matches)
    finalists, trials = _best_hypotheses(matches, rows, rng, kind, sample, max_noise)
    noise = _estimated_noise(rows, finalists, max_noise)
    finalists = rows.improved(finalists, kind, noise)[0]
    loss = MarginalLoss(noise)

    def finished(start: Rigid3, plausible: BoolArray) -> tuple[RobustPose, FloatArray]:
        own = plausible.astype(np.float64)
        end = refine_pose(matches, start, kind, robust=loss, point_weights=own)
        r = rows.residuals(essential_from_pose(end.cam2_from_cam1)[None])[0]
        qualities = marginal_quality(r, noise) * plausible
        inliers = plausible & (np.abs(r) < QUANTILE * noise)
        return RobustPose(end, inliers), qualities

    for start, plausible in _poses(matches, rows, finalists, kind, noise, max_noise):
        try:
            found, qualities = finished(start, plausible)
        except (InputError, DegenerateError):
            continue
        for alternative in other_ambiguous_poses(matches, found.inliers, noise / MIN_NOISE, _pose(found)):
            try:
                other, others = finished(alternative, _plausible(matches, alternative, max_noise))
            except (InputError, DegenerateError):
                continue
            if not compare_poses(_pose(found), _pose(other))[1]:
                found, qualities = _better_pose((found, qualities), (other, others))
        return found
    raise DegenerateError(
        f"no pose with enough inliers in front of both cameras{f' in {trials} samples' if trials else ''}; check which "
        "camera took which image"
    )


def _best_hypotheses(
    matches: Matches, rows: SampsonRows, rng: np.random.Generator, kind: str, sample: Sample, max_noise: float
) -> tuple[Mat3, int]:
    """Return the best essential matrices (H, 3, 3) and the number of samples; raises DegenerateError without any."""
    if axis_of(kind) is not None:
        return fundamental_for(kind).solve(matches, "points").E21[None], 0
    size = _sample_size(matches, kind, sample)
    finalists, trials = _ConsensusSearch(matches, rows, kind, sample, size, max_noise).run(rng)
    if not len(finalists):
        raise DegenerateError(f"no pose in {trials} samples of {len(matches)} matches; check how they were matched")
    return finalists, trials


def _estimated_noise(rows: SampsonRows, finalists: Mat3, max_noise: float) -> float:
    """Return the noise level, in sigmas, from the median residual of the inliers of the best of the finalists.

    At this level, lower than that of the search, the qualities of different local optima differ clearly.
    """
    noise = max_noise
    for _ in range(NOISE_ITERATIONS):
        fitting = np.abs(rows.residuals(finalists[:1])[0])
        fitting = fitting[fitting < QUANTILE * noise]
        shown = float(np.median(fitting)) / MEDIAN_OF_NORMAL if fitting.size else max_noise
        noise = min(max_noise, max(MIN_NOISE * shown, MIN_NOISE))
    return noise


def _pose(found: RobustPose) -> Rigid3:
    return found.refined.cam2_from_cam1


def _better_pose(
    first: tuple[RobustPose, FloatArray], second: tuple[RobustPose, FloatArray]
) -> tuple[RobustPose, FloatArray]:
    """Return the better of the two poses of a plane, each given with the qualities (N,) of all matches.

    Raises DegenerateError if their difference is not significant against noise and outliers that fit by chance.
    """
    difference = first[1] - second[1]
    total, chance = float(difference.sum()), float(np.linalg.norm(difference))
    if abs(total) <= SIGNIFICANT * chance:
        turn = np.degrees(compare_poses(_pose(first[0]), _pose(second[0]))[0])
        raise DegenerateError(
            f"nearly all of the {int(first[0].inliers.sum())} matches that fit lie on one plane and two poses "
            f"{turn:.1f} deg apart explain them equally well; add points off that plane, or declare the pose type"
        )
    return first if total > 0.0 else second


def _poses(
    matches: Matches, rows: SampsonRows, E21: Mat3, kind: str, noise: float, max_noise: float
) -> list[tuple[Rigid3, BoolArray]]:
    """Return the best poses of `E21` (H, 3, 3), best first, each with its plausible matches (N,).

    Cheirality is part of the quality: it distinguishes the two poses of a plane and halves the chance of outliers.
    """
    found: list[tuple[float, Rigid3, BoolArray]] = []
    total, best = rows.quality(E21, noise), 0.0
    for k in _distinct_optima(total):
        # The quality of the plausible matches is at most that of all.
        if total[k] <= best:
            break
        r = np.abs(rows.residuals(E21[k : k + 1])[0])
        # Cheirality by the matches with the smallest residuals: half of the outliers are in front by chance.
        near = r <= max(QUANTILE, float(np.sort(r)[min(10, len(r)) - 1]))
        try:
            pose = choose_pose(E21[k], matches.rays1[near], matches.rays2[near], kind)
        except DegenerateError:
            continue
        plausible = _plausible(matches, pose, max_noise)
        quality = float(np.sum(marginal_quality(r, noise), where=plausible))
        found.append((quality, pose, plausible))
        best = max(best, quality)
    return [(pose, plausible) for _, pose, plausible in sorted(found, key=lambda entry: -entry[0])]


def _distinct_optima(quality: FloatArray) -> IntArray:
    """Return the indices of distinct optima, best first."""
    order = np.argsort(-quality, kind="stable")
    return np.asarray(order[np.append(True, -np.diff(quality[order]) > SAME_QUALITY)])


def _plausible(matches: Matches, pose: Rigid3, max_noise: float) -> BoolArray:
    """Return which matches (N,) are neither significantly behind a camera nor have an affinity off by too much."""
    sigmas = QUANTILE * max_noise
    seen = cheirality_margin(matches, pose) <= sigmas
    if matches.sigma_A is None:
        return np.asarray(seen)
    off = affinity_distances(matches, essential_from_pose(pose)) * np.sqrt(0.5)
    return np.asarray(seen & ~(off > sigmas))


@dataclass(frozen=True, eq=False, slots=True)
class _ConsensusSearch:
    """RANSAC with local optimisation of promising hypotheses."""

    matches: Matches
    rows: SampsonRows
    kind: str
    sample: Sample
    size: int
    max_noise: float

    def run(self, rng: np.random.Generator) -> tuple[Mat3, int]:
        """Return the best essential matrices (H, 3, 3), locally optimised, best first, and the number of samples."""
        best = np.zeros((0, 3, 3))
        trials, needed, best_rank = 0, float(MAX_TRIALS), 0.0
        every = np.ones(len(self.matches), dtype=bool)
        among = np.flatnonzero(every if self.sample == "points" else usable_affinities(self.matches))
        while trials < needed:
            trials += BATCH
            index = _draw(rng, among, self.size)
            candidates = _hypotheses(self.matches, index, self.kind, self.sample)
            if not len(candidates):
                continue
            # The noise of a minimal sample can hide a good hypothesis at the final noise level: rank at a wider one.
            rank = self.rows.quality(candidates, WIDE * self.max_noise)
            tried = np.argsort(-rank, kind="stable")[:LOCAL_TRIES]
            tried = tried[rank[tried] >= PROMISING * best_rank]
            if len(tried):
                best = self.best(np.concatenate([best, self.improved(candidates[tried])]))
                best_rank = float(self.rows.quality(best[:1], WIDE * self.max_noise)[0])
            share = float(np.mean(np.abs(self.rows.residuals(best[:1])[0]) < QUANTILE * self.max_noise))
            # Affinities are noisy: only some of the samples without outliers converge to the optimum.
            hit = share**self.size * (1.0 if self.sample == "points" else GOOD_AFFINE)
            needed = min(MAX_TRIALS, float(np.log(1.0 - CONFIDENCE) / np.log1p(-np.clip(hit, 1e-12, 1 - 1e-12))))
        return best, trials

    def improved(self, E21: Mat3) -> Mat3:
        """Return the local optima (4 H, 3, 3) from `E21` (H, 3, 3) at the highest and the lowest noise level.

        One series starts at a wide noise level, which tolerates poor starts; one at the highest noise level, which
        is less sensitive to outliers with leverage.
        """
        widely = self.rows.improved(E21, self.kind, WIDE * self.max_noise, self.max_noise, MIN_NOISE)[1:]
        at_once = self.rows.improved(E21, self.kind, self.max_noise, MIN_NOISE)
        return np.concatenate([*widely, *at_once])

    def best(self, E21: Mat3) -> Mat3:
        """Return the best few of `E21` (H, 3, 3) at the highest noise level, best first, then those at the lowest."""
        qualities = self.rows.quality_ahead(E21, QUANTILE * self.max_noise, self.max_noise, MIN_NOISE)
        return np.asarray(E21[np.concatenate([_distinct_optima(quality)[:FINALISTS] for quality in qualities])])


def _sample_size(matches: Matches, kind: str, sample: Sample) -> int:
    """Return the number of matches per sample; raises InputError if there are too few matches or affinities."""
    size = SAMPLE_SIZES.get((kind, sample))
    if size is None:
        raise InputError(f"robust estimation knows no samples of kind '{sample}' for pose type '{kind}'")
    different = len({pair.tobytes() for pair in np.concatenate([matches.pixels1, matches.pixels2], axis=1)})
    if different < size + 1:
        raise InputError(f"robust estimation: {different} different matches, at least {size + 1} are needed")
    have = int(usable_affinities(matches).sum())
    if sample == "affine" and have < size:
        raise InputError(f"samples '{sample}' need {size} affinities, the matches have {have}; use sample='points'")
    return size


def _draw(rng: np.random.Generator, among: IntArray, size: int) -> IntArray:
    """Return BATCH samples (BATCH, size) of elements of `among`, each without repetition."""
    taken = np.zeros((BATCH, 0), dtype=np.int64)
    while taken.shape[1] < size:
        fresh = rng.integers(0, len(among) - taken.shape[1], BATCH)
        # Convert ranks among the positions not taken yet into positions.
        for passed in np.sort(taken, axis=1).T:
            fresh += fresh >= passed
        taken = np.concatenate([taken, fresh[:, None]], axis=1)
    return np.asarray(among[taken])


def _hypotheses(m: Matches, index: IntArray, kind: str, sample: Sample) -> Mat3:
    """Return all essential matrices (H, 3, 3) of samples (B, size)."""
    f1, f2 = m.rays1[index], m.rays2[index]
    rows = point_rows(f1, f2)
    if sample == "affine":
        assert m.A21 is not None
        more = affinity_rows(f1, f2, m.jacobians1[index], m.jacobians2[index], m.A21[index])
        rows = np.concatenate([rows, more.reshape(len(index), -1, 9)], axis=1)
    if kind == PoseType.PLANAR:
        rows = rows[..., np.array(PLANAR_ENTRIES)]
        if rows.shape[1] == 2:
            found = planar_from_two_rows(rows)
        else:
            found = essential_from_planar(solve_planar_batch(np.swapaxes(rows, 1, 2) @ rows)[0])[:, None]
    else:
        found = five_rows(rows) if sample == "points" else six_rows(rows)
    flat = found.reshape(-1, 3, 3)
    return np.asarray(flat[np.isfinite(flat[:, 0, 0])])


def log_false_alarms(
    matches: Matches, pose: Rigid3, inliers: BoolArray, affinity_fits: BoolArray, freedom: int, gate: float
) -> float:
    """Return the log number of false alarms: the expected number of poses with as many inliers among wrong matches.

    Infinite if there are fewer inliers than degrees of freedom.

    Parameters
    ----------
    matches : all N.
    pose : found by sampling; the length of its translation is ignored.
    inliers : (N,) matches that fit it, by point and by affinity.
    affinity_fits : (N,) whether the affinity fits; True without an affinity.
    freedom : degrees of freedom of the pose.
    gate : largest Sampson distance of a point that fits, in sigmas.

    Notes
    -----
    N C(N, k) C(k, freedom) p^(k - freedom) with k inliers (Moisan and Stival, "A probabilistic criterion to detect
    rigid point matches between two images and estimate the fundamental matrix"). The probability p that a wrong match
    fits is estimated from the points with wrong partners, and from the affinities of the points that do not fit.
    """
    n, k = len(matches), int(inliers.sum())
    if k < freedom:
        return inf
    fitting = total = 0
    for shift in range(1, min(n, SHIFTS + 1)):
        other = np.roll(np.arange(n), shift)
        wrong = replace(
            matches,
            pixels2=matches.pixels2[other],
            rays2=matches.rays2[other],
            jacobians2=matches.jacobians2[other],
            sigma2_px=matches.sigma2_px[other],
        )
        fitting += int(_fits(wrong, pose, gate).sum())
        total += n
    by_point = (fitting + 1.0) / (total + 1.0)
    outlying = ~_fits(matches, pose, gate)
    by_affinity = (affinity_fits[outlying].sum() + 1.0) / (outlying.sum() + 1.0)
    log_chance = float(np.log(by_point * by_affinity))
    return float(np.log(n)) + _log_choose(n, k) + _log_choose(k, freedom) + (k - freedom) * log_chance


def _fits(m: Matches, pose: Rigid3, gate: float) -> BoolArray:
    return np.asarray(np.abs(sampson_of_matches(essential_from_pose(pose), m, in_sigmas=True)) < gate)


def _log_choose(n: int, k: int) -> float:
    return lgamma(n + 1.0) - lgamma(k + 1.0) - lgamma(n - k + 1.0)
