"""Model selection by cross-validation: among the options with the smallest error on images that were left out of the
fit, the one with the fewest parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.certainty.departures import SMALLEST_PX
from rigkit.calibration.result import Candidate
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.poses import refine_poses
from rigkit.calibration.solving.solver import FROM_OPTIMUM, solve
from rigkit.calibration.solving.state import weighted_squares
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray, FloatArray

MARGIN = 0.02
"""A model or a board shape with more parameters must lower the held-out error by this part to be chosen,"""
MIN_SIGMAS = 1.0
"""or, a model, by this many standard errors of the difference between images: the poses absorb much of the error of a
lens, so that 0.3 % of held-out error may be three times the error of the lens."""
MORE_NUMBERS = 1
"""Models of different kinds with the same flexibility differ by one parameter; larger ones of a kind oscillate where no
board was."""
BOOTSTRAP_DRAWS = 2000
"""Bootstrap samples: probabilities are accurate to 0.01."""
CLEARLY = 2.0
"""Standard errors by which the common model of like cameras must be worse than its own for a camera to leave them."""
MIN_IMAGES_OF_FIT = 3
"""Smallest number of images for leave-one-out: two others still determine a camera."""


@dataclass(frozen=True, eq=False, slots=True)
class FittedModel:
    """An option of the model selection: a camera model of one size with boards of one shape, and its fit."""

    name: str
    fit: Fit
    heldout: FloatArray | None = None
    """Squared held-out residuals of each image, px^2."""

    @property
    def model(self) -> str:
        """Name of the camera model, without its size."""
        return self.fit.state.camera.model

    @property
    def heldout_px(self) -> float | None:
        return None if self.heldout is None else float(np.sqrt(self.heldout.sum() / self.fit.kept.sum()))

    @property
    def count(self) -> int:
        return int(self.fit.state.camera.parameters.size + self.fit.state.shape.count)


def heldout_squares(observations: Observations, fit: Fit, folds: int) -> FloatArray | None:
    """Return the sum of squared held-out residuals, px^2, of the inliers of each image: camera and board shapes are
    those of the other folds, only the poses of its boards are fitted. Near-duplicate images are in one fold. With fewer
    images than folds each image is a fold. None with less than MIN_IMAGES_OF_FIT different images.

    Residuals are weighted as in the solution, so that blurred images count less.
    """
    if folds < 2:
        return None
    images = list(dict.fromkeys(observations.images))
    if int(observations.clusters().max()) + 1 < MIN_IMAGES_OF_FIT:
        return None
    place = {name: i for i, name in enumerate(images)}
    image = np.array([place[name] for name in observations.images])
    fold = observations.folds(folds)
    squared = np.zeros(len(images))
    weight = fit.weight(observations)
    for k in range(int(fold.max()) + 1):
        train, test = np.flatnonzero(fold != k), np.flatnonzero(fold == k)
        solved = solve(
            observations.subset(train),
            fit.state.subset(train),
            weight=weight[train],
            prior_sigma_px=fit.sigma_px,
            cost_tolerance=FROM_OPTIMUM,
        ).state
        part = observations.subset(test)
        start = fit.state.subset(test)
        moved = replace(solved, rotation=start.rotation, translation_mm=start.translation_mm)
        found, _ = refine_poses(part, moved, weight[test])
        np.add.at(squared, image[test], weighted_squares(found, part, weight[test]))
    return squared


def models_of(options: Sequence[FittedModel]) -> list[str]:
    """Return the names of the camera models of the options, each once."""
    return list(dict.fromkeys(option.model for option in options))


def converged_ones(options: Sequence[FittedModel]) -> Sequence[FittedModel]:
    """Return the options whose solver converged, if any did. The others are unidentifiable: a model with more
    parameters than the lens needs (a double sphere for a lens without distortion) has many solutions."""
    return [option for option in options if option.fit.convergence.converged] or options


def choose(options: Sequence[FittedModel], min_sigmas: float | None = None) -> FittedModel:
    """Return the option with the fewest parameters among those with the smallest held-out error, within MARGIN and (if
    given) `min_sigmas` standard errors of the difference; with too few images for cross-validation, the option with
    the smallest BIC. Options whose solver did not converge are excluded if others did, except with too few images.

    Reference: L. Breiman et al., "Classification and Regression Trees" (1984), section 3.4.3: the one-standard-error
    rule, here paired over images.
    """
    if len(options) == 1:
        return options[0]
    compared = [o for o in converged_ones(options) if o.heldout is not None]
    if not compared:
        return min(options, key=_bic)
    good = _as_good_as_best(np.array([o.heldout for o in compared]), min_sigmas)
    return min((o for o, fine in zip(compared, good, strict=True) if fine), key=lambda o: o.count)


def _as_good_as_best(heldout: FloatArray, min_sigmas: float | None) -> BoolArray:
    """Return which of M options are as good as the best, from their squared held-out residuals (M, N) of N images."""
    total = heldout.sum(axis=1)
    within = total <= float(total.min()) * (1.0 + MARGIN) ** 2
    if min_sigmas is None:
        return np.asarray(within)
    more, chance = _against(heldout, int(total.argmin()))
    return np.asarray(within & (more <= min_sigmas * chance))


def _against(heldout: FloatArray, best: int) -> tuple[FloatArray, FloatArray]:
    """Return the excess of the options' squared residuals (M, N) over the `best` one's, and its standard error, (M,)
    each."""
    more = heldout - heldout[best]
    return more.sum(axis=1), np.sqrt(more.shape[1]) * more.std(axis=1, ddof=1)


@dataclass(frozen=True, eq=False, slots=True)
class HeldOut:
    """Held-out errors of one camera, or of several like ones, for the M options that all of them have.

    Attributes
    ----------
    names, counts : names of the options and their numbers of parameters, the largest of all cameras.
    heldout : (M, N) squared held-out residuals of all N images, those of each camera in units of its smallest mean, as
        cameras differ in sharpness. Options whose solver did not converge are left out if others did.
    alike : differences of the means below this are rounding.
    """

    names: list[str]
    counts: list[int]
    heldout: FloatArray
    alike: float = 0.0

    @classmethod
    def of(cls, cameras: Sequence[Sequence[FittedModel]]) -> HeldOut:
        """Combine the held-out errors of several cameras."""
        known = [{o.name: o for o in converged_ones(options) if o.heldout is not None} for options in cameras]
        names = [name for name in known[0] if all(name in own for own in known)]
        counts = [max(own[name].count for own in known) for name in names]
        parts = [np.array([own[name].heldout for name in names]) for own in known]
        if not names:
            return cls(names, counts, np.empty((0, 0)))
        unit = [max(float(part.mean(axis=1).min()), np.finfo(float).tiny) for part in parts]
        scaled = np.concatenate([part / one for part, one in zip(parts, unit, strict=True)], axis=1)
        corners = [max(int(o.fit.kept.sum()) for o in own.values()) for own in known]
        rounding = sum(2.0 * SMALLEST_PX**2 * n / one for n, one in zip(corners, unit, strict=True))
        return cls(names, counts, scaled, rounding / scaled.shape[1])

    def chosen(self) -> str:
        """Return the name of the option that `choose` would choose."""
        good = np.flatnonzero(_as_good_as_best(self.heldout, MIN_SIGMAS)).tolist()
        return self.names[min(good, key=lambda k: self.counts[k])]

    def contradicts(self, name: str, own: str) -> bool:
        """Return whether the option `name` is significantly worse than `own`."""
        more, chance = _against(self.heldout, self.names.index(own))
        k = self.names.index(name)
        return bool(more[k] > CLEARLY * chance[k])

    def likely(self) -> dict[str, float]:
        """Return the probability of each option to be the best one: the part of the Bayesian bootstrap samples
        in which it has the smallest held-out error. Options with about as many parameters and an error equal within
        rounding share a sample.

        References: S. T. Buckland, K. P. Burnham, N. H. Augustin, "Model selection: an integral part of inference",
        Biometrics 53 (1997): bootstrap selection frequencies as weights. D. B. Rubin, "The Bayesian bootstrap", Annals
        of Statistics 9 (1981).
        """
        if not self.names:
            return {}
        drawn = np.random.default_rng(0).dirichlet(np.ones(self.heldout.shape[1]), BOOTSTRAP_DRAWS)
        # Sorted, so that the result does not depend on the order of the images.
        error = drawn @ self.heldout[:, np.lexsort(self.heldout)].T
        least = error.min(axis=1, keepdims=True)
        few = np.array(self.counts) <= self.counts[self.names.index(self.chosen())] + MORE_NUMBERS
        best = (error == least) | (few & (error <= least + self.alike))
        share = (best / best.sum(axis=1, keepdims=True)).mean(axis=0)
        return dict(zip(self.names, share.tolist(), strict=True))


def _bic(option: FittedModel) -> float:
    """Return the Bayesian information criterion, n log(mean squared residual) + parameters log n."""
    n = 2 * int(option.fit.kept.sum())
    error = option.fit.rms_px
    return float(n * np.log(error**2 + np.finfo(float).tiny) + option.count * np.log(n))


def described(options: list[FittedModel], chosen: FittedModel, *, rivals: bool = False) -> list[Candidate]:
    """Return the options as candidates, with the reason for choosing each or not; `rivals`: other models than these
    were tried too."""
    out = []
    for o in options:
        if len(options) == 1 and not rivals:
            reason = "the only one tried"
        elif chosen.fit.convergence.converged and not o.fit.convergence.converged:
            reason = "its solver was stopped before it converged"
        elif o.heldout_px is None or chosen.heldout_px is None:
            reason = "too few images to cross-validate: " + ("smallest BIC" if o is chosen else "larger BIC")
        elif o is chosen:
            reason = "fewest parameters among those with the lowest held-out error, within its uncertainty"
        else:
            reason = f"held-out error {o.heldout_px / chosen.heldout_px:.3f} times that of the chosen one"
            if o.heldout_px < chosen.heldout_px:
                more = o.count - chosen.count
                reason += f", not significant for {'one more parameter' if more == 1 else f'{more} more parameters'}"
        out.append(Candidate(o.name, o.count, o.fit.rms_px, o.heldout_px, o is chosen, reason))
    return out
