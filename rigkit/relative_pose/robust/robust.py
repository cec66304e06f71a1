"""Robust relative pose from contaminated matches: minimal samples, a marginalised threshold, local optimisation.

No threshold between inlier and outlier is set: hypotheses are ranked, improved and refined under the marginalised loss
(marginal.py), whose weights the maximum likelihood refinement takes as well. Several local optima are kept until the
noise of the matches is known, counting only what lies in front of both cameras. Deterministic under a seeded
generator. References: Fischler and Bolles; Chum, Matas, Kittler ("Locally optimized RANSAC"); Barath, Noskova, Matas
("MAGSAC++").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Mat3
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType, axis_of
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.pose import five_rows, six_rows
from rigkit.optim.robust_scale import MEDIAN_OF_NORMAL
from rigkit.relative_pose.refinement.local import SampsonRows
from rigkit.relative_pose.refinement.marginal import QUANTILE, MarginalLoss, marginal_quality
from rigkit.relative_pose.refinement.refine import SIGNIFICANT, RefinedPose, refine_pose
from rigkit.relative_pose.solvers.planar import planar_from_two_rows, solve_planar_batch
from rigkit.relative_pose.solvers.planar_ambiguity import compare_poses, other_ambiguous_poses
from rigkit.relative_pose.solvers.pose import cheirality_margin, choose_pose, essential_from_pose
from rigkit.relative_pose.solvers.registry import fundamental_for
from rigkit.relative_pose.solvers.rows import PLANAR_ENTRIES, affinity_rows, essential_from_planar, point_rows
from rigkit.relative_pose.solvers.weights import affinity_distances, usable_affinities

Sample = Literal["points", "affine"]
"""What minimal samples consist of: points, or affine correspondences. Of these two are enough instead of five, one
instead of two."""
SAMPLE_SIZES: dict[tuple[str, Sample], int] = {
    ("general", "points"): 5,
    ("general", "affine"): 2,
    ("planar", "points"): 2,
    ("planar", "affine"): 1,
}
CONFIDENCE = 0.999
"""Of having drawn a sample without outliers, given the share of inliers found so far."""
MAX_TRIALS = 4000

NO_POSE = (
    "no pose that enough matches agree with, from in front of both cameras, in {} samples; check that the cameras are "
    "those of the images, and the order of the images"
)
BATCH = 96
"""Samples at a time: a little more than 40 % of wrong matches ask for."""
WIDE = 4.0
"""Factor of the highest noise level at which minimal samples, noisy themselves, are ranked and improved first."""
LOCAL_TRIES = 8
PROMISING = 0.6
"""Of a batch the best few are improved, if they rank as high as this share of the best so far."""
FINALISTS = 4
"""Local optima kept at each of the two noise levels."""
SAME_QUALITY = 1e-3
"""In matches: optima that differ by less are one, to the precision of the local optimisation."""
MIN_NOISE = 1.5
"""Noise level over the noise that the matches show: the loss still sees the tails, and few wrong matches."""
NOISE_ROUNDS = 3
"""Each leaves out what the noise of the round before does not explain."""
GOOD_AFFINE = 0.1
"""Share of clean samples with an affinity that lead to the optimum (measured: a third at 0.05 noise of A)."""


@dataclass(frozen=True, eq=False, slots=True)
class RobustPose:
    """A pose found among contaminated matches.

    Attributes
    ----------
    refined : the pose, refined on the weighted matches.
    inliers : (N,) bool, matches that fit at one and a half times the noise that the fitting ones show, lie in front of
        both cameras (by more than noise) and, where there are affinities with sigmas, agree by them.
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
    """Return the pose that most matches agree with.

    Raises InputError: too few matches or affinities for a sample, or a noise level that is not above the sigmas;
    DegenerateError: no sample gave a pose, or the matches that fit leave another one open, all on one plane, or have no
    baseline.

    Parameters
    ----------
    matches : contaminated; their sigmas are the smallest noise expected.
    pose_type : general or planar are sampled; standard and forward have nothing to sample and are only refined.
    max_noise : highest noise level considered, in sigmas of the matches.
    """
    if not (np.isfinite(max_noise) and max_noise > 1.0):
        raise InputError(f"robust estimation: max_noise is in sigmas of the matches and above 1, got {max_noise}")
    kind = str(pose_type)
    rows = SampsonRows.of(matches)
    finalists, trials = _finalists(matches, rows, rng, kind, sample, max_noise)
    noise = _shown_noise(rows, finalists, max_noise)
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
                found, qualities = _preferred((found, qualities), (other, others))
        return found
    raise DegenerateError(NO_POSE.format(trials))


def _finalists(
    matches: Matches, rows: SampsonRows, rng: np.random.Generator, kind: str, sample: Sample, max_noise: float
) -> tuple[Mat3, int]:
    """Return the best essential matrices (H, 3, 3) of the samples, and how many were drawn; options of `robust_pose`.

    Raises DegenerateError where there are none.
    """
    if axis_of(kind) is not None:
        return fundamental_for(kind).solve(matches, "points").E21[None], 0
    size = _sample_size(matches, kind, sample)
    finalists, trials = _ConsensusSearch(matches, rows, kind, sample, size, max_noise).run(rng)
    if not len(finalists):
        raise DegenerateError(f"no pose in {trials} samples of {len(matches)} matches; check how they were matched")
    return finalists, trials


def _shown_noise(rows: SampsonRows, finalists: Mat3, max_noise: float) -> float:
    """Return the noise, in sigmas, that the matches show which fit the best of the finalists.

    The search allowed for much noise; at the level that there is the local optima, nearly equal before, part company.
    """
    noise = max_noise
    for _ in range(NOISE_ROUNDS):
        fitting = np.abs(rows.residuals(finalists[:1])[0])
        fitting = fitting[fitting < QUANTILE * noise]
        shown = float(np.median(fitting)) / MEDIAN_OF_NORMAL if fitting.size else max_noise
        noise = min(max_noise, max(MIN_NOISE * shown, MIN_NOISE))
    return noise


def _pose(found: RobustPose) -> Rigid3:
    return found.refined.cam2_from_cam1


def _preferred(
    first: tuple[RobustPose, FloatArray], second: tuple[RobustPose, FloatArray]
) -> tuple[RobustPose, FloatArray]:
    """Return the better one of two poses of a plane, each with the qualities of all matches.

    Raises DegenerateError if neither is: noise, and wrong matches that fit one of them by chance, prefer either alike.
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
    """Return the best poses of `E21` (H, 3, 3), best first, and which matches each may be true for (N,).

    Epipolar lines alone do not tell a plane's two poses apart, and have twice the wrong matches on them by chance.
    """
    found: list[tuple[float, Rigid3, BoolArray]] = []
    total, best = rows.quality(E21, noise), 0.0
    for k in _different(total):
        # What is plausible is a part of all.
        if total[k] <= best:
            break
        r = np.abs(rows.residuals(E21[k : k + 1])[0])
        # Cheirality by the matches that fit best: those that only might fit are half in front by chance.
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


def _different(quality: FloatArray) -> IntArray:
    """Return the indices of different optima, best first: many starts lead to the same one."""
    order = np.argsort(-quality, kind="stable")
    return np.asarray(order[np.append(True, -np.diff(quality[order]) > SAME_QUALITY)])


def _plausible(matches: Matches, pose: Rigid3, max_noise: float) -> BoolArray:
    """Return which matches (N,) are not certainly wrong, wherever they lie on their epipolar lines.

    Certainly wrong: behind a camera by a parallax that is no noise, or with an affinity that is off by more than the
    highest noise level.
    """
    sigmas = QUANTILE * max_noise
    seen = cheirality_margin(matches, pose) <= sigmas
    if matches.sigma_A is None:
        return np.asarray(seen)
    off = affinity_distances(matches, essential_from_pose(pose)) * np.sqrt(0.5)
    return np.asarray(seen & ~(off > sigmas))


@dataclass(frozen=True, eq=False, slots=True)
class _ConsensusSearch:
    """Sampling with local optimisation of promising hypotheses."""

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
            # A sample's own noise can hide a good hypothesis at the final noise level: rank at a wider one.
            rank = self.rows.quality(candidates, WIDE * self.max_noise)
            tried = np.argsort(-rank, kind="stable")[:LOCAL_TRIES]
            tried = tried[rank[tried] >= PROMISING * best_rank]
            if len(tried):
                best = self.best(np.concatenate([best, self.improved(candidates[tried])]))
                best_rank = float(self.rows.quality(best[:1], WIDE * self.max_noise)[0])
            share = float(np.mean(np.abs(self.rows.residuals(best[:1])[0]) < QUANTILE * self.max_noise))
            # Affinities are noisy: of the samples without outliers only some are good enough to start from.
            hit = share**self.size * (1.0 if self.sample == "points" else GOOD_AFFINE)
            needed = min(MAX_TRIALS, float(np.log(1.0 - CONFIDENCE) / np.log1p(-np.clip(hit, 1e-12, 1 - 1e-12))))
        return best, trials

    def improved(self, E21: Mat3) -> Mat3:
        """Return what `E21` (H, 3, 3) lead to, (4 H, 3, 3), at the highest noise level and on to the least.

        Widely first, which forgives a poor start; and at once, which an outlier with leverage cannot lure.
        """
        widely = self.rows.improved(E21, self.kind, WIDE * self.max_noise, self.max_noise, MIN_NOISE)[1:]
        at_once = self.rows.improved(E21, self.kind, self.max_noise, MIN_NOISE)
        return np.concatenate([*widely, *at_once])

    def best(self, E21: Mat3) -> Mat3:
        """Return the best few of `E21` (H, 3, 3) at the highest noise level, the best first, and then at the least."""
        kept = []
        for quality in self.rows.quality_ahead(E21, QUANTILE * self.max_noise, self.max_noise, MIN_NOISE):
            kept.append(_different(quality)[:FINALISTS])
        return np.asarray(E21[np.concatenate(kept)])


def _sample_size(matches: Matches, kind: str, sample: Sample) -> int:
    """Return how many matches a sample holds; raises InputError where the matches cannot provide it."""
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
    """Return indices (BATCH, size) of `among`, without repetition in a row."""
    taken = np.zeros((BATCH, 0), dtype=np.int64)
    while taken.shape[1] < size:
        fresh = rng.integers(0, len(among) - taken.shape[1], BATCH)
        # The fresh-th of the numbers not taken yet.
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
