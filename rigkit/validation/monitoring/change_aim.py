"""Which images to check a camera or a rig with: those that estimate changes of lenses and mounts most precisely.

With C the covariance of the calibration, A the information of the fresh frames and P = (C^-1 + A)^-1, the estimated
amounts of a hypothesis D have the covariance N^-1, N = D^T (C + A^-1)^-1 D = D^T (C^-1 - C^-1 P C^-1) D. Frames that
make it small for every hypothesis are not those that improve the calibration most: well-known parameters may change.

Reference: A. C. Atkinson, A. N. Donev, R. D. Tobias, "Optimum Experimental Designs, with SAS" (2007), section 10.3
(the designs for parts of the parameters).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.reach import Reach
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import Plan, choose_views, covariance_of
from rigkit.validation.monitoring.evidence import FreshEvidence, Monitored
from rigkit.validation.monitoring.frames import Frames
from rigkit.validation.monitoring.hypotheses import Hypothesis, hypotheses_of, lens_goals, turn_weight
from rigkit.validation.monitoring.power import LENS_KINDS, Power, powers_of
from rigkit.validation.monitoring.verdict import ALARM_CHANCE
from rigkit.validation.monitoring.whitened import NULL_RANK


@dataclass(frozen=True, eq=False, slots=True)
class ChangeAim:
    """The precision with which the size of a change is estimated.

    Attributes
    ----------
    shown : for each hypothesis C^-1 D (T, m), D in px over the image, and D^T C^-1 D (m, m).
    what : description of `error`.
    """

    shown: tuple[tuple[FloatArray, FloatArray], ...]
    what: str
    unit: str = "px"

    @classmethod
    def of(cls, monitored: Monitored, inverse: FloatArray, of_all: FloatArray) -> ChangeAim:
        """Return the aim for all lenses and mounts, from the `inverse` (T, T) of their covariance. Hypotheses on which
        even `of_all` (T, T), the information of all candidate frames, has no effect are left out."""
        by_all, shown = covariance_of(inverse + of_all), []
        for hypothesis in hypotheses_of(monitored):
            metric = _metric(monitored, hypothesis)
            if metric is None:
                continue
            size, axes = np.linalg.eigh(metric)
            seen = size > NULL_RANK * size[-1]
            by_px = hypothesis.directions @ (axes[:, seen] / np.sqrt(size[seen]))
            one = (inverse @ by_px, by_px.T @ inverse @ by_px)
            if _explained_variances(*one, by_all).min() > NULL_RANK * np.trace(one[1]):
                shown.append(one)
        changes = "intrinsics or extrinsics" if monitored.is_rig else "intrinsics"
        return cls(tuple(shown), f"standard error of a change of {changes}, over the image")

    def error(self, covariance: FloatArray) -> FloatArray:
        """Return the root of the summed variances of all hypotheses, each the geometric mean over its directions, so
        that none is neglected for the others; very large where the frames do not show one of the hypotheses."""
        variance = np.zeros(covariance.shape[:-2])
        for by_theta, whole in self.shown:
            gained = np.maximum(_explained_variances(by_theta, whole, covariance), NULL_RANK * np.trace(whole))
            variance = variance + np.exp(-np.log(gained).mean(axis=-1))
        return np.asarray(np.sqrt(variance))


def _explained_variances(by_theta: FloatArray, whole: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the eigenvalues (..., m) of N, with P the `covariance` (..., T, T)."""
    return np.asarray(np.linalg.eigvalsh(whole - by_theta.T @ covariance @ by_theta))


def _metric(monitored: Monitored, hypothesis: Hypothesis) -> FloatArray | None:
    """Return the quadratic form (m, m), px^2, that maps amounts of a hypothesis to the mean square displacement over
    the image: after the best rotation for a lens, of distant points for a turned mount; None for other hypotheses."""
    c = monitored.names.index(hypothesis.camera or monitored.names[0])
    if hypothesis.kind in LENS_KINDS:
        return np.asarray(hypothesis.directions.T @ lens_goals(monitored)[c].weight @ hypothesis.directions)
    return np.radians(1.0) ** 2 * turn_weight(monitored.cameras[c]) if hypothesis.kind == "rotation" else None


def informative_views(
    monitored: Monitored, boards: Sequence[Board], count: int, reach: Reach | None = None
) -> tuple[Plan, tuple[Power, ...]]:
    """Return the images to check a camera or a rig with, and the power of the check with them. An image of a rig is
    one of every camera at one moment, of one board.

    Raises InputError without boards or for a `count` below 1, DegenerateError where no board fits into any image at the
    allowed distances or the covariance cannot be inverted.
    """
    if not boards or count < 1:
        raise InputError("plan: at least one board and one picture are needed")
    frames, sigma = Frames.of(monitored, boards, reach or Reach()), monitored.fresh_sigma_px
    inverse, gained = covariance_of(monitored.covariance), frames.information / sigma**2
    aim = ChangeAim.of(monitored, inverse, gained.sum(axis=0))
    taken, errors = choose_views(inverse, gained, aim, count)
    views = frames.proposals(monitored, boards, taken, errors)
    evidence = FreshEvidence(
        information=frames.information[taken],
        score=np.zeros((len(taken), monitored.layout.count)),
        variance_px2=sigma**2,
        rms_px=float(np.sqrt(2.0) * sigma),
        expected_px=float(np.sqrt(2.0) * sigma),
        corners=sum(view.board.corner_count for view in views),
        left_out=0,
        overdispersion=monitored.overdispersion,
        freedom=monitored.freedom,
    )
    # Without any image the error is infinite.
    knowledge = Knowledge(monitored.cameras[0], inverse, CornerError(sigma))
    return Plan(knowledge, aim, float("inf"), tuple(views)), powers_of(
        monitored, evidence, hypotheses_of(monitored), ALARM_CHANCE
    )
