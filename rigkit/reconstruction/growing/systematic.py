"""Estimate the pose from many pairs whose errors are correlated by smooth lens errors.

Noise averages out over thousands of pairs, errors of the camera models do not. If they are treated as independent
noise, the pose is wrong by many of its standard deviations. Here a pair's epipolar distance is the sum of the pose's
error, smooth errors of both lenses (`lens_errors`), and noise. The pose is its posterior mean with the lens errors and
their amplitudes, one for each family, marginalised; its covariance includes their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew, unit
from rigkit.geometry.sampson import epipolar_normals
from rigkit.reconstruction.growing.lens_errors import ErrorModes, error_modes
from rigkit.relative_pose.refinement.pose_problem import cauchy_weights
from rigkit.relative_pose.refinement.residuals import level_terms, point_terms
from rigkit.relative_pose.solvers.pose import free_directions, pose_directions

AMPLITUDES_PX = np.geomspace(0.003, 1.0, 9)
"""Grid of the RMS amplitude of a family of lens errors over the image."""
TYPICAL_PX = 0.07
"""Scale of the half-normal prior on these: careful calibrations leave 1/20 px per axis. Lens errors equivalent to a
pose change are not visible in the distances; with a heavy-tailed prior (half-Cauchy) a tilt of pixels changed the pose
by half a degree."""
LENS_STEPS = 3


@dataclass(frozen=True, eq=False, slots=True)
class SystematicPose:
    """A pose with |translation| = 1.

    Attributes
    ----------
    covariance : (6, 6) of (left rotation perturbation rad, translation).
    epipolar_rms_px : RMS displacement of pairs from their epipolar lines by the lens errors.
    by_distance : (6, N) derivative of the pose by the pairs' whitened distances (`point_terms`).
    """

    cam2_from_cam1: Rigid3
    covariance: FloatArray
    epipolar_rms_px: float
    by_distance: FloatArray


def pose_with_lens_errors(
    matches: Matches,
    cameras: tuple[Camera, Camera],
    start: Rigid3,
    pose_type: PoseType,
    level_sigma_rad: float | None,
    overlap: float,
) -> SystematicPose:
    """Return the posterior mean of the pose close to `start`, with the lens errors marginalised.

    Parameters
    ----------
    matches : inliers of `start`, with sigmas scaled to their residuals.
    cameras : of both images.
    pose_type, level_sigma_rad : as in `refine_pose`. Without degrees of freedom the pose is kept, and only the lens
        errors are estimated.
    overlap : number of pairs that share the same pixels and so their noise. For lens errors much wider than a window
        the variance of independent noise is multiplied by it.
    """
    R, t = start.rotation, unit(start.translation_mm)
    free = free_directions(PoseType.GENERAL if level_sigma_rad is not None else pose_type)
    # The first three directions are rotations.
    free_to_turn = bool(np.isin(range(3), free).all())
    lenses = (
        error_modes(cameras[0], matches.pixels1, free_to_turn=free_to_turn),
        error_modes(cameras[1], matches.pixels2, free_to_turn=free_to_turn),
    )
    rows_of_lenses, families = _lens_rows(matches, lenses, R, t)
    count = len(free)
    # If the pose is fixed, the weights do not change: one step.
    for _ in range(LENS_STEPS if count else 1):
        to_five = pose_directions(t)
        basis = to_five[3:, 3:]
        r, J = point_terms(matches, R, t, basis)
        weight = cauchy_weights(r) / overlap
        rows = np.concatenate([J[:, free], rows_of_lenses], axis=1)
        normal, right = rows.T @ (weight[:, None] * rows), rows.T @ (weight * r)
        if level_sigma_rad is not None:
            deviation, by_pose = (v / level_sigma_rad for v in level_terms(pose_type, R, t, basis))
            normal[:count, :count] += by_pose.T @ by_pose
            right[:count] += by_pose.T @ deviation
        found = _posterior(normal, right, count, families)
        change = np.zeros(5)
        change[free] = found.mean
        R, t = exp_so3(change[:3]) @ R, unit(t + change[3:] @ basis)
    covariance = found.covariance + _covariance_of_frames(lenses, found.variances, R, t, basis)[np.ix_(free, free)]
    spread = to_five[free].T
    by_row = -found.inverse @ (rows * weight[:, None]).T
    # Sampson's distance moves both pixels.
    in_px = np.sqrt(2.0) * matches.sigma1_px[:, None] * rows_of_lenses
    moment = found.inverse[count:, count:] + np.outer(found.modes, found.modes)
    residual = np.sqrt(np.mean(np.sum(in_px @ moment * in_px, axis=1)))
    return SystematicPose(Rigid3(R, t), spread @ covariance @ spread.T, float(residual), spread @ by_row[:count])


def _lens_rows(
    matches: Matches, lenses: tuple[ErrorModes, ErrorModes], R: FloatArray, t: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return the whitened epipolar displacements (N, K) by the modes of both lenses, and the families (K,) of these, in
    order."""
    m = matches
    _, n1, n2 = epipolar_normals(skew(t) @ R, m.rays1, m.rays2, m.jacobians1, m.jacobians2)
    sigma = np.sqrt(m.sigma1_px**2 * np.sum(n1**2, axis=1) + m.sigma2_px**2 * np.sum(n2**2, axis=1))
    sigma = np.where(sigma > 0.0, sigma, np.inf)[:, None]
    rows = [np.einsum("ni,nik->nk", n / sigma, lens.displacements) for n, lens in zip((n1, n2), lenses, strict=True)]
    families = np.concatenate([lens.families for lens in lenses])
    order = np.argsort(families, kind="stable")
    return np.concatenate(rows, axis=1)[:, order], families[order]


def _covariance_of_frames(
    lenses: tuple[ErrorModes, ErrorModes], variances: FloatArray, R: FloatArray, t: FloatArray, basis: FloatArray
) -> FloatArray:
    """Return the covariance (5, 5) of the pose by the rotations of the cameras that were removed from the modes, for
    the variance of each family."""
    out = np.zeros((5, 5))
    for lens, turn, swing in ((lenses[0], R, np.zeros((2, 3))), (lenses[1], np.eye(3), -basis @ skew(t))):
        by_mode = np.concatenate([turn, swing]) @ lens.turns
        out += by_mode @ (variances[lens.families][:, None] * by_mode.T)
    return out


class _PoseAndLenses(NamedTuple):
    """Mean (P,) and covariance (P, P) of the pose's change; posterior mean variance of each family, px^2; and for the
    likeliest amplitudes the inverse of the normal equations with their prior, and the modes' coefficients (K,)."""

    mean: FloatArray
    covariance: FloatArray
    variances: FloatArray
    inverse: FloatArray
    modes: FloatArray


def _posterior(normal: FloatArray, right: FloatArray, count: int, families: IntArray) -> _PoseAndLenses:
    """Return the posterior, over all amplitudes, from normal equations of `count` pose parameters and the modes.

    Notes
    -----
    For amplitudes s, with D their prior's inverse variances and F = N + D, -2 log of the likelihood with pose and modes
    integrated out is -b^T F^-1 b + log |F| - log |D|, up to a constant. The many modes of the last family are
    eliminated first.
    """
    size = np.bincount(families)
    few = len(normal) - int(size[-1])
    others = np.array(list(product(AMPLITUDES_PX, repeat=len(size) - 1)))
    each = np.repeat(others, size[:-1], axis=1)
    at = np.arange(count, few)
    scores, means, covariances, amplitudes = [], [], [], []
    for last in AMPLITUDES_PX:
        many = normal[few:, few:] + np.eye(size[-1]) / last**2
        solved = np.linalg.solve(many, np.concatenate([normal[few:, :few], right[few:, None]], axis=1))
        full = np.broadcast_to(
            normal[:few, :few] - normal[:few, few:] @ solved[:, :few], (len(others), few, few)
        ).copy()
        full[:, at, at] += each**-2.0
        inverse = np.linalg.inv(full)
        b = right[:few] - normal[:few, few:] @ solved[:, few]
        mean = -inverse @ b
        cost = mean @ b - right[few:] @ solved[:, few] + np.linalg.slogdet(full)[1] + np.linalg.slogdet(many)[1]
        cost += 2.0 * (np.log(each).sum(axis=1) + size[-1] * np.log(last))
        amplitudes.append(np.column_stack([others, np.full(len(others), last)]))
        scores.append(-0.5 * cost + _log_prior(amplitudes[-1]))
        means.append(mean[:, :count])
        covariances.append(inverse[:, :count, :count])
    score = np.concatenate(scores)
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    mean = np.concatenate(means)
    middle = weight @ mean
    off = mean - middle
    covariance = np.einsum("k,kij->ij", weight, np.concatenate(covariances)) + off.T @ (weight[:, None] * off)
    every = np.concatenate(amplitudes)
    whole = normal.copy()
    at = np.arange(count, len(normal))
    whole[at, at] += every[score.argmax()][families] ** -2.0
    known = np.asarray(np.linalg.inv(whole))
    return _PoseAndLenses(middle, covariance, weight @ every**2, known, -(known @ right)[count:])


def _log_prior(amplitudes_px: FloatArray) -> FloatArray:
    """Return the log prior density (A,) of the logarithms of amplitudes (A, F)."""
    return np.asarray(np.sum(np.log(amplitudes_px) - 0.5 * (amplitudes_px / TYPICAL_PX) ** 2, axis=1))
