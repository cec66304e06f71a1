"""Which lens model and which board shape: of those that predict other images best, the one with the fewest numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.departures import SMALLEST_PX
from rigkit.calibration.result import Candidate
from rigkit.calibration.solving.fit import Fit
from rigkit.core.arrays import BoolArray, FloatArray

MARGIN = 0.02
"""A model or a board shape with more numbers must lower the held-out error by this part to be chosen,"""
MIN_SIGMAS = 1.0
"""or, a model, by this many standard errors of the difference, as images have it: a lens that is not quite right hides
in the poses, and 0.3 % of held-out error may be three times the error of the lens."""
MORE_NUMBERS = 1
"""Models of other kinds come with a number more or less for the same freedom; large ones of a kind swing where no board
was."""
BOOTSTRAP_DRAWS = 2000
"""Draws that tell how likely an option is the best one: to 0.01."""
CLEARLY = 2.0
"""A camera has a lens of its own, and not that of its twins, where theirs errs by so many standard errors more."""


@dataclass(frozen=True, eq=False, slots=True)
class FittedModel:
    """A camera model with boards of one shape, in the running: its name and how it fits."""

    name: str
    fit: Fit
    heldout: FloatArray | None = None
    """Squared held-out residuals of each image, px^2."""

    @property
    def model(self) -> str:
        """The camera model, of whatever size."""
        return self.fit.state.camera.model

    @property
    def heldout_px(self) -> float | None:
        return None if self.heldout is None else float(np.sqrt(self.heldout.sum() / self.fit.kept.sum()))

    @property
    def count(self) -> int:
        return int(self.fit.state.camera.parameters.size + self.fit.state.shape.count)


def models_of(options: Sequence[FittedModel]) -> list[str]:
    """Return the camera models among the options."""
    return list(dict.fromkeys(option.model for option in options))


def settled(options: Sequence[FittedModel]) -> Sequence[FittedModel]:
    """Return the options whose solver converged, where any did. The others creep along a ridge: a model with more
    numbers than the lens has (a double sphere for a lens without distortion) shows the images with many of them."""
    return [option for option in options if option.fit.convergence.converged] or options


def choose(options: Sequence[FittedModel], min_sigmas: float | None = None) -> FittedModel:
    """Return the option with the fewest numbers among those whose held-out error is the smallest, within MARGIN and
    (if given) `min_sigmas` standard errors of the difference; with too few images for that, the one with the
    smallest BIC. One whose solver was stopped is taken only where all were; two images leave too much open to say
    that of it.

    Reference: L. Breiman et al., "Classification and Regression Trees" (1984), section 3.4.3: the one-standard-error
    rule, here paired over images.
    """
    if len(options) == 1:
        return options[0]
    judged = [o for o in settled(options) if o.heldout is not None]
    if not judged:
        return min(options, key=_bic)
    good = _as_good(np.array([o.heldout for o in judged]), min_sigmas)
    return min((o for o, fine in zip(judged, good, strict=True) if fine), key=lambda o: o.count)


def _as_good(heldout: FloatArray, min_sigmas: float | None) -> BoolArray:
    """Return which of M options are as good as the best, from their squared held-out residuals (M, N) of N images."""
    total = heldout.sum(axis=1)
    within = total <= float(total.min()) * (1.0 + MARGIN) ** 2
    if min_sigmas is None:
        return np.asarray(within)
    more, chance = _against(heldout, int(total.argmin()))
    return np.asarray(within & (more <= min_sigmas * chance))


def _against(heldout: FloatArray, best: int) -> tuple[FloatArray, FloatArray]:
    """Return by how much more options (M, N) err than the `best` one, and the standard error of that, (M,) each."""
    more = heldout - heldout[best]
    return more.sum(axis=1), np.sqrt(more.shape[1]) * more.std(axis=1, ddof=1)


@dataclass(frozen=True, eq=False, slots=True)
class HeldOut:
    """What the images of one camera, or of several that are alike, say of the options that all of them have: names,
    numbers (most of the cameras') and squared held-out residuals (M, N). Those of each camera are in units of its
    smallest mean, as cameras differ in how sharp they are. Options whose means differ by less than `alike` err as if by
    rounding. Those whose solver was stopped say nothing where others converged."""

    names: list[str]
    counts: list[int]
    heldout: FloatArray
    alike: float = 0.0

    @classmethod
    def of(cls, cameras: Sequence[Sequence[FittedModel]]) -> HeldOut:
        """Put the evidence of cameras with their options together."""
        known = [{o.name: o for o in settled(options) if o.heldout is not None} for options in cameras]
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
        """Return the name that `choose` prefers."""
        good = np.flatnonzero(_as_good(self.heldout, MIN_SIGMAS)).tolist()
        return self.names[min(good, key=lambda k: self.counts[k])]

    def contradicts(self, name: str, own: str) -> bool:
        """Say whether `name` is clearly worse than `own`."""
        more, chance = _against(self.heldout, self.names.index(own))
        k = self.names.index(name)
        return bool(more[k] > CLEARLY * chance[k])

    def likely(self) -> dict[str, float]:
        """Return how likely each option is the best one: how often it has the smallest held-out error where images
        count by chance more or less (the Bayesian bootstrap). Where others with about as many numbers err as little but
        for rounding, images do not decide between them, sure as the order may be: they share.

        References: S. T. Buckland, K. P. Burnham, N. H. Augustin, "Model selection: an integral part of inference",
        Biometrics 53 (1997): weights by how often data like these would choose each model. D. B. Rubin, "The Bayesian
        bootstrap", Annals of Statistics 9 (1981).
        """
        if not self.names:
            return {}
        drawn = np.random.default_rng(0).dirichlet(np.ones(self.heldout.shape[1]), BOOTSTRAP_DRAWS)
        # Sorted: the draws of an image are not to depend on where it stands among the others.
        error = drawn @ self.heldout[:, np.lexsort(self.heldout)].T
        least = error.min(axis=1, keepdims=True)
        few = np.array(self.counts) <= self.counts[self.names.index(self.chosen())] + MORE_NUMBERS
        best = (error == least) | (few & (error <= least + self.alike))
        share = (best / best.sum(axis=1, keepdims=True)).mean(axis=0)
        return dict(zip(self.names, share.tolist(), strict=True))


def _bic(option: FittedModel) -> float:
    """Return Schwarz's criterion, n log(mean squared residual) + parameters log n."""
    n = 2 * int(option.fit.kept.sum())
    error = option.fit.rms_px
    return float(n * np.log(error**2 + np.finfo(float).tiny) + option.count * np.log(n))


def described(options: list[FittedModel], chosen: FittedModel, *, rivals: bool = False) -> list[Candidate]:
    """Return what was tried, and why it was chosen or not; `rivals`: others than these were tried as well."""
    out = []
    for o in options:
        if len(options) == 1 and not rivals:
            reason = "the only one tried"
        elif chosen.fit.convergence.converged and not o.fit.convergence.converged:
            reason = "its solver was stopped before it converged"
        elif o.heldout_px is None or chosen.heldout_px is None:
            reason = "too few images to cross-validate: " + ("smallest BIC" if o is chosen else "larger BIC")
        elif o is chosen:
            reason = "fewest numbers among those whose held-out error is as good as the smallest"
        else:
            reason = f"held-out error {100.0 * (o.heldout_px / chosen.heldout_px - 1.0):+.1f} % against the chosen one"
            if o.heldout_px < chosen.heldout_px:
                more = o.count - chosen.count
                reason += f", too little for {'one number' if more == 1 else f'{more} numbers'} more"
        out.append(Candidate(o.name, o.count, o.fit.rms_px, o.heldout_px, o is chosen, reason))
    return out
