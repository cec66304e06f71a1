"""Which pose type do the matches speak for, and does the declared one hold?

Each type has the marginal likelihood of the points (Laplace's approximation) under "the pose is of this type up to the
spirit level's sigma". A type is preferred over a more general one if its deviations are no larger than noise and level
allow, because it spends no probability on poses that were not taken. The noise is that of the matches' sigmas,
corrected by what the general fit leaves over. A declared type is contradicted if the deviations of the general fit from
it cannot come from noise and level together.
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
from rigkit.relative_pose.refinement.noise_level import POSE_FREEDOM, variance_factor
from rigkit.relative_pose.refinement.refine import RefinedPose, estimate_pose, refine_pose
from rigkit.relative_pose.refinement.residuals import level_terms
from rigkit.relative_pose.solvers.pose import translation_basis

DEFAULT_LEVEL_RAD = float(np.radians(0.2))
"""What a carefully set spirit level on a tripod holds to, where nobody says."""

CONTRADICTION_P = 1e-3
"""Chance with which a true declaration would be called contradicted."""

SELECTED_TYPES = (PoseType.GENERAL, PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class TypeEvidence:
    """What the matches say about one pose type.

    Attributes
    ----------
    pose_type : which.
    log_evidence : log marginal likelihood, relative to the best type (so 0 for the best, negative for the others).
    probability : posterior probability if all four types were equally likely beforehand.
    deviation_rad : largest angle of the general fit off the type, see `type_deviation_rad`. Zero for the general type.
    p_value : chance of deviations at least this large from noise and level, if the type were true.
    """

    pose_type: PoseType
    log_evidence: float
    probability: float
    deviation_rad: float
    p_value: float


@dataclass(frozen=True, eq=False, slots=True)
class PoseTypeEvidence:
    """Evidence for every pose type that could be fitted, best first.

    Attributes
    ----------
    types : one entry a type, by falling evidence.
    level_sigma_rad : the level that was assumed.
    """

    types: tuple[TypeEvidence, ...]
    level_sigma_rad: float

    @property
    def choice(self) -> PoseType:
        """The type with the highest evidence."""
        return self.types[0].pose_type

    def of(self, pose_type: PoseType | str) -> TypeEvidence | None:
        """Return the evidence for one type; None where it could not be fitted."""
        return next((entry for entry in self.types if entry.pose_type == str(pose_type)), None)

    def contradiction(self, declared: PoseType | str) -> str | None:
        """Return a sentence with the figures if the matches contradict the declared type, else None."""
        if str(declared) in (PoseType.AUTO, PoseType.GENERAL):
            return None
        entry = self.of(declared)
        if entry is None:
            return f"declared '{declared}', but no pose of that type puts the points in front of both cameras"
        if entry.p_value >= CONTRADICTION_P:
            return None
        instead = (
            "though no other type fits better" if str(declared) == self.choice else f"they speak for '{self.choice}'"
        )
        off, level = np.degrees(entry.deviation_rad), np.degrees(self.level_sigma_rad)
        return (
            f"declared '{declared}', but the matches show a deviation of {off:.2f} deg from it "
            f"(level {level:.2f} deg; chance {entry.p_value:.1e}); {instead}"
        )


def pose_type_evidence(matches: Matches, level_sigma_rad: float | None = None) -> PoseTypeEvidence:
    """Return the evidence of the points of `matches` for general, planar, standard and forward.

    Affinities are not used: what matters here is far better known from the points. `level_sigma_rad` None stands for
    DEFAULT_LEVEL_RAD.

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
    for kind in fits:
        deviation, p = _deviation(general, kind, level, noise2)
        probability = float(np.exp(raw[kind] - top) / total)
        entries.append(
            TypeEvidence(
                pose_type=kind,
                log_evidence=raw[kind] - top,
                probability=probability,
                deviation_rad=deviation,
                p_value=p,
            )
        )
    entries.sort(key=lambda entry: -entry.log_evidence)
    return PoseTypeEvidence(tuple(entries), level)


def _fits(matches: Matches, level: float) -> dict[PoseType, RefinedPose]:
    """Return the soft fit of every type that has one."""
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
    # The general optimum is no worse than any other type's: where it is, it was a local one.
    for kind, fit in list(fits.items()):
        best = fits.get(PoseType.GENERAL)
        if best is None or fit.cost - _prior_cost(fit, kind, level) < best.cost:
            try:
                fits[PoseType.GENERAL] = refine_pose(replace(matches, A21=None, sigma_A=None), fit.cam2_from_cam1)
            except (DegenerateError, InputError):
                continue
    return fits


def _level_parts(fit: RefinedPose, kind: PoseType) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return deviations (K,), their Jacobian (K, 5), and the covariance (5, 5) of the pose."""
    pose = fit.cam2_from_cam1
    basis = translation_basis(pose.translation_mm)
    values, jacobian = level_terms(kind, pose.rotation, pose.translation_mm, basis)
    to_five = np.zeros((5, 6))
    to_five[:3, :3], to_five[3:, 3:] = np.eye(3), basis
    return values, jacobian, to_five @ fit.covariance @ to_five.T


def _prior_cost(fit: RefinedPose, kind: PoseType, level: float) -> float:
    values, _, _ = _level_parts(fit, kind)
    return float(np.sum((values / level) ** 2))


def _log_evidence(fit: RefinedPose, kind: PoseType, level: float, noise2: float) -> float:
    """Return the log marginal likelihood by Laplace's approximation, up to what all types share."""
    values, jacobian, covariance = _level_parts(fit, kind)
    prior = jacobian.T @ jacobian / level**2
    # The refinement took the stated sigmas; the noise level corrects the data's share only.
    data = (np.linalg.inv(covariance) - prior) / noise2
    curvature = data + prior
    log = -0.5 * (fit.cost - np.sum((values / level) ** 2)) / noise2 - 0.5 * np.sum((values / level) ** 2)
    log += 2.5 * np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(curvature)[1]
    # Prior density: uniform over what the type leaves free (rotations 8 pi^2, directions 4 pi, each angle 2 pi, the
    # sign of a fixed direction 2), Gaussian in what it fixes.
    free = {PoseType.GENERAL: np.log(32.0 * np.pi**3), PoseType.PLANAR: np.log(4.0 * np.pi**2)}.get(kind, np.log(2.0))
    return float(log - free - len(values) * 0.5 * np.log(2.0 * np.pi * level**2))


def _deviation(general: RefinedPose | None, kind: PoseType, level: float, noise2: float) -> tuple[float, float]:
    """Return the largest deviation of the general fit from the type, rad, and its chance under the type."""
    from scipy.special import gammaincc

    if general is None or kind == PoseType.GENERAL:
        return 0.0, 1.0
    values, jacobian, covariance = _level_parts(general, kind)
    spread = noise2 * jacobian @ covariance @ jacobian.T + level**2 * np.eye(len(values))
    distance2 = float(values @ np.linalg.solve(spread, values))
    return type_deviation_rad(general.cam2_from_cam1, kind), float(gammaincc(0.5 * len(values), 0.5 * distance2))


def type_deviation_rad(pose: Rigid3, kind: PoseType) -> float:
    """Return the largest angle by which a pose is off its type, rad; zero for the general type.

    Planar: the tilt of the vertical axis, and of the translation out of the horizontal plane. Standard and forward: the
    rotation, and the translation against the x or the z axis, either way along it.
    """
    R, t = pose.rotation, unit(pose.translation_mm)
    if kind == PoseType.PLANAR:
        tilt = np.arctan2(np.hypot(R[0, 1], R[2, 1]), R[1, 1])
        return float(max(tilt, np.arctan2(abs(t[1]), np.hypot(t[0], t[2]))))
    if (along := axis_of(kind)) is not None:
        return float(max(rotation_angle(R), np.arctan2(np.linalg.norm(np.delete(t, along)), abs(t[along]))))
    return 0.0
