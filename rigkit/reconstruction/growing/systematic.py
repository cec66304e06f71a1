"""The pose of many pairs whose errors are not independent: calibrations, compression and lenses err alike nearby.

Thousands of pairs average their noise away; what is left is what the cameras' models are off by, a smooth field over
the image. Taken for independent noise it turns the pose by many of its stated standard deviations. Here the distance
of a pair from its epipolar line is the sum of the pose's, a field of cosines over image 1, and noise. The field's
amplitude is what makes the distances most likely, with the field and the pose integrated out (empirical Bayes); its
variance falls with the wave number, so that a wide bowl is likelier than ripples. The pose's covariance contains it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, Pixels
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.relative_pose.refinement.pose_problem import cauchy_weights
from rigkit.relative_pose.refinement.residuals import level_terms, point_terms
from rigkit.relative_pose.solvers.pose import free_directions, translation_basis

MAX_WAVES = 10
"""Half waves over the image, both ways together: less than a tenth of the image wide, it is noise to a pose."""
AMPLITUDES_PX = tuple(np.geomspace(0.03, 1.0, 14))
"""Standard deviations of the field that are compared. The least is what lenses, interpolation and compression leave at
best: a field that looks like another pose leaves no trace in the distances, so that none seen is not none there."""
FIELD_STEPS = 4


@dataclass(frozen=True, eq=False, slots=True)
class SystematicPose:
    """A pose with |translation| = 1, its covariance (6, 6) of (left rotation perturbation rad, translation), and the
    standard deviation of the field over the image, px."""

    cam2_from_cam1: Rigid3
    covariance: FloatArray
    amplitude_px: float


def pose_with_field(
    matches: Matches,
    start: Rigid3,
    size_px: tuple[int, int],
    pose_type: PoseType,
    level_sigma_rad: float | None,
    overlap: float,
) -> SystematicPose:
    """Return the pose of maximum posterior probability near `start`, with the field integrated out.

    Parameters
    ----------
    matches : that agree with `start`; their sigmas are those that they show.
    size_px : of image 1.
    pose_type, level_sigma_rad : as in `refine_pose`. Without freedom the pose stays, and only the field is measured.
    overlap : pairs that share their pixels, so that their noise is that of one. To waves much longer than a window
        that is independent noise of so many times its variance.
    """
    R, t = start.rotation, unit(start.translation_mm)
    waves, falling = _waves(matches.pixels1, size_px)
    field = waves / (np.sqrt(2.0) * matches.sigma1_px[:, None])
    free = free_directions(PoseType.GENERAL if level_sigma_rad is not None else pose_type)
    count = len(free)
    amplitude = 0.0
    covariance: FloatArray = np.zeros((count, count))
    basis = translation_basis(t)
    for _ in range(FIELD_STEPS):
        basis = translation_basis(t)
        r, J = point_terms(matches, R, t, basis)
        weight = cauchy_weights(r) / overlap
        rows = np.concatenate([J[:, free], field], axis=1)
        normal, right = rows.T @ (weight[:, None] * rows), rows.T @ (weight * r)
        if level_sigma_rad is not None:
            deviation, by_pose = (v / level_sigma_rad for v in level_terms(pose_type, R, t, basis))
            normal[:count, :count] += by_pose.T @ by_pose
            right[:count] += by_pose.T @ deviation
        amplitude = min(AMPLITUDES_PX, key=lambda tau: _cost(normal, right, falling * tau**2))
        inverse = np.linalg.inv(_with_prior(normal, falling * amplitude**2))
        change = np.zeros(5)
        change[free] = -(inverse @ right)[:count]
        R, t = exp_so3(change[:3]) @ R, unit(t + change[3:] @ basis)
        covariance = np.array(inverse[:count, :count])
    to_six = np.zeros((6, 5))
    to_six[:3, :3], to_six[3:, 3:] = np.eye(3), basis.T
    spread = to_six[:, free]
    return SystematicPose(Rigid3(R, t), spread @ covariance @ spread.T, amplitude)


def _waves(pixels: Pixels, size_px: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the cosines (N, W) at pixels (N, 2), and their variances (W,), which sum up to one."""
    number = np.arange(MAX_WAVES + 1)
    along, down = (np.cos(np.pi * number * (x[:, None] + 0.5) / s) for x, s in zip(pixels.T, size_px, strict=True))
    i, j = np.nonzero(number[:, None] + number <= MAX_WAVES)
    falling = 1.0 / (1.0 + i**2 + j**2)
    return along[:, i] * down[:, j], falling / falling.sum()


def _with_prior(normal: FloatArray, variances: FloatArray) -> FloatArray:
    out = normal.copy()
    at = np.arange(len(normal) - len(variances), len(normal))
    out[at, at] += 1.0 / variances
    return out


def _cost(normal: FloatArray, right: FloatArray, variances: FloatArray) -> float:
    """Return -2 log of the likelihood of the distances, field and pose integrated out, up to a constant."""
    full = _with_prior(normal, variances)
    return float(-right @ np.linalg.solve(full, right) + np.linalg.slogdet(full)[1] + np.sum(np.log(variances)))
