"""Selection of the pose type of matches, and a test of the declared type.

The evidence of a type is the marginal likelihood of the points (Laplace's approximation) under the hypothesis that the
pose is of this type up to the sigma of a spirit level. A type is preferred over a more general one if its deviations
are consistent with noise and level, since its prior is more concentrated. The noise is that of the matches' sigmas,
scaled by the variance factor of the general fit. A declared type is contradicted if the deviations of the general fit
from it are not consistent with noise and level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import DegenerateError, InputError, RigkitError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType, axis_of
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import rotation_angle, unit
from rigkit.relative_pose.refinement.refine import (
    POSE_FREEDOM,
    RefinedPose,
    estimate_pose,
    refine_pose,
    variance_factor,
)
from rigkit.relative_pose.refinement.residuals import level_terms
from rigkit.relative_pose.solvers.pose import pose_directions

DEFAULT_LEVEL_RAD = float(np.radians(0.2))
"""Default sigma of the level: that of a carefully set spirit level on a tripod."""

EXACT_LEVEL_RAD = float(np.radians(0.02))
"""Sigma that tests a type declared as exact: a tenth of a careful level, and a third of a pixel of a lens of 1000 px,
by which calibrations from pictures err."""

CONTRADICTION_P = 1e-3
"""Significance level of the test of a declared type: its false alarm rate."""

SELECTED_TYPES = (PoseType.GENERAL, PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD)


@dataclass(frozen=True, eq=False, slots=True)
class Deviations:
    """Deviations (K,) of the general fit from a pose type, rad, as of `level_terms`, and their covariance (K, K) due to
    noise and level."""

    values: FloatArray
    covariance: FloatArray

    def p_value(self, of_cameras: FloatArray | float = 0.0) -> float:
        """Return the probability of deviations at least this large, with a further covariance (K, K)."""
        from scipy.special import gammaincc

        distance2 = float(self.values @ np.linalg.solve(self.covariance + of_cameras, self.values))
        return float(gammaincc(0.5 * len(self.values), 0.5 * distance2))


@dataclass(frozen=True, eq=False, slots=True)
class TypeEvidence:
    """Evidence of the matches for one pose type.

    Attributes
    ----------
    log_evidence : log marginal likelihood relative to that of the best type, whose value is 0.
    probability : posterior probability for equal prior probabilities of the four types.
    deviation_rad : deviation of the general fit from the type, see `type_deviation_rad`. Zero for the general type.
    p_value : probability of deviations at least this large, due to noise and level, under the type.
    deviations : what it is of; None for the general type.
    """

    pose_type: PoseType
    log_evidence: float
    probability: float
    deviation_rad: float
    p_value: float
    deviations: Deviations | None = None


@dataclass(frozen=True, eq=False, slots=True)
class PoseTypeEvidence:
    """Evidence for every pose type that could be fitted, best first.

    Attributes
    ----------
    types : one entry per type, by decreasing evidence.
    level_sigma_rad : the assumed sigma of the level.
    """

    types: tuple[TypeEvidence, ...]
    level_sigma_rad: float

    @property
    def choice(self) -> PoseType:
        """The type with the highest evidence."""
        return self.types[0].pose_type

    def of(self, pose_type: PoseType | str) -> TypeEvidence | None:
        """Return the evidence for one type; None if it could not be fitted."""
        return next((entry for entry in self.types if entry.pose_type == str(pose_type)), None)

    def contradiction(self, declared: PoseType | str) -> str | None:
        """Return a sentence with deviation and p-value if the matches contradict the declared type, else None."""
        if str(declared) in (PoseType.AUTO, PoseType.GENERAL):
            return None
        entry = self.of(declared)
        if entry is None:
            return f"declared '{declared}', but no pose of that type puts the points in front of both cameras"
        if entry.p_value >= CONTRADICTION_P:
            return None
        instead = (
            "although no other type fits better" if str(declared) == self.choice else f"they support '{self.choice}'"
        )
        off, level = np.degrees(entry.deviation_rad), np.degrees(self.level_sigma_rad)
        return (
            f"declared '{declared}', but the matches show a deviation of {off:.2f} deg from it (level {level:.2f} deg; "
            f"chance {entry.p_value:.1e}); {instead}"
        )


def pose_type_evidence(matches: Matches, level_sigma_rad: float | None = None) -> PoseTypeEvidence:
    """Return the evidence of the points of `matches` for general, planar, standard and forward.

    Affinities are not used, being far less accurate than points. `level_sigma_rad` None is DEFAULT_LEVEL_RAD.

    Raises DegenerateError, InputError: no type can be fitted (no baseline, too few matches).
    """
    level = DEFAULT_LEVEL_RAD if level_sigma_rad is None else float(level_sigma_rad)
    if not level > 0.0:
        raise InputError(f"level sigma must be positive, got {level} rad")
    fits = _fits(matches, level)
    general = fits.get(PoseType.GENERAL)
    noise2 = 1.0 if general is None else variance_factor(general.cost, len(matches) - POSE_FREEDOM)
    raw = {kind: _log_evidence(fit, kind, level, noise2) for kind, fit in fits.items()}
    top = max(raw.values())
    total = sum(np.exp(value - top) for value in raw.values())
    entries = []
    for kind, value in sorted(raw.items(), key=lambda item: -item[1]):
        probability = float(np.exp(value - top) / total)
        entry = TypeEvidence(kind, value - top, probability, deviation_rad=0.0, p_value=1.0)
        if general is not None and kind != PoseType.GENERAL:
            off, own = type_deviation_rad(general.cam2_from_cam1, kind), _deviations(general, kind, level, noise2)
            entry = replace(entry, deviation_rad=off, p_value=own.p_value(), deviations=own)
        entries.append(entry)
    return PoseTypeEvidence(tuple(entries), level)


def _fits(matches: Matches, level: float) -> dict[PoseType, RefinedPose]:
    """Return the fit of each pose type, with the level as a prior; types that cannot be fitted are left out."""
    fits: dict[PoseType, RefinedPose] = {}
    failure: RigkitError | None = None
    for kind in reversed(SELECTED_TYPES):
        try:
            soft = None if kind == PoseType.GENERAL else level
            fits[kind] = estimate_pose(matches, kind, soft, weights="points")
        except (DegenerateError, InputError) as error:
            failure = error
    if not fits:
        raise failure or DegenerateError("no pose type fits the matches")
    # A general fit that is worse than that of another type is a local optimum.
    for kind, fit in list(fits.items()):
        best = fits.get(PoseType.GENERAL)
        if best is None or fit.cost - _prior_cost(fit, kind, level) < best.cost:
            try:
                fits[PoseType.GENERAL] = refine_pose(replace(matches, A21=None, sigma_A=None), fit.cam2_from_cam1)
            except (DegenerateError, InputError):
                continue
    return fits


def level_parts(fit: RefinedPose, kind: PoseType) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return deviations (K,), their Jacobian (K, 5), and the covariance (5, 5) of the pose."""
    pose = fit.cam2_from_cam1
    to_five = pose_directions(pose.translation_mm)
    values, jacobian = level_terms(kind, pose.rotation, pose.translation_mm, to_five[3:, 3:])
    return values, jacobian, to_five @ fit.covariance @ to_five.T


def _prior_cost(fit: RefinedPose, kind: PoseType, level: float) -> float:
    return float(np.sum((level_parts(fit, kind)[0] / level) ** 2))


def _log_evidence(fit: RefinedPose, kind: PoseType, level: float, noise2: float) -> float:
    """Return the log marginal likelihood by Laplace's approximation, up to a constant that all types share."""
    values, jacobian, covariance = level_parts(fit, kind)
    prior, prior_cost = jacobian.T @ jacobian / level**2, np.sum((values / level) ** 2)
    # The refinement assumed the stated sigmas; the variance factor scales the data's part of the curvature only.
    curvature = (np.linalg.inv(covariance) - prior) / noise2 + prior
    log = -0.5 * (fit.cost - prior_cost) / noise2 - 0.5 * prior_cost
    log += 2.5 * np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(curvature)[1]
    # Prior density: uniform in the free parameters of the type (rotations 8 pi^2, directions 4 pi, each angle 2 pi, the
    # sign of a fixed direction 2), Gaussian in the deviations.
    free = {PoseType.GENERAL: np.log(32.0 * np.pi**3), PoseType.PLANAR: np.log(4.0 * np.pi**2)}.get(kind, np.log(2.0))
    return float(log - free - len(values) * 0.5 * np.log(2.0 * np.pi * level**2))


def _deviations(general: RefinedPose, kind: PoseType, level: float, noise2: float) -> Deviations:
    values, jacobian, covariance = level_parts(general, kind)
    return Deviations(values, noise2 * jacobian @ covariance @ jacobian.T + level**2 * np.eye(len(values)))


def type_deviation_rad(pose: Rigid3, kind: PoseType) -> float:
    """Return the largest angle (rad) between a pose and its type; zero for the general type.

    Planar: the tilt of the vertical axis, and the elevation of the translation. Standard and forward: the rotation, and
    the angle of the translation to the x or z axis, regardless of sign.
    """
    R, t = pose.rotation, unit(pose.translation_mm)
    if kind == PoseType.PLANAR:
        tilt = np.arctan2(np.hypot(R[0, 1], R[2, 1]), R[1, 1])
        return float(max(tilt, np.arctan2(abs(t[1]), np.hypot(t[0], t[2]))))
    if (along := axis_of(kind)) is not None:
        return float(max(rotation_angle(R), np.arctan2(np.linalg.norm(np.delete(t, along)), abs(t[along]))))
    return 0.0
