"""Which lens model and which board shape: of those that predict other images best, the one with the fewest numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.fit import Fit
from rigkit.calibration.observations import Observations
from rigkit.calibration.result import Candidate
from rigkit.core.arrays import FloatArray

MARGIN = 0.02
"""A model or a board shape with more numbers must lower the held-out error by this part to be chosen,"""
SURELY = 1.0
"""or, a model, by this many standard errors of the difference, as images have it: a lens that is not quite right hides
in the poses, and 0.3 % of held-out error may be three times the error of the lens."""


@dataclass(frozen=True, eq=False, slots=True)
class Option:
    """A model, or a board shape, in the running: its name and how it fits."""

    name: str
    fit: Fit
    heldout: FloatArray | None = None
    """Squared held-out residuals of each image, px^2."""

    @property
    def heldout_px(self) -> float | None:
        return None if self.heldout is None else float(np.sqrt(self.heldout.sum() / self.fit.kept.sum()))

    @property
    def count(self) -> int:
        return int(self.fit.state.camera.parameters.size + self.fit.state.shape.count)


def choose(observations: Observations, options: list[Option], surely: float | None = None) -> Option:
    """Return the option with the fewest numbers among those whose held-out error is the smallest, within MARGIN and
    (if given) `surely` standard errors of the difference; with too few images for that, the one with the smallest BIC.

    Reference: L. Breiman et al., "Classification and Regression Trees" (1984), section 3.4.3: the one-standard-error
    rule, here paired over images.
    """
    judged = [(o.heldout, o) for o in options if o.heldout is not None]
    if not judged:
        return min(options, key=lambda o: _bic(observations, o))
    best = min((heldout for heldout, _ in judged), key=lambda heldout: float(heldout.sum()))
    good = []
    for heldout, option in judged:
        more = heldout - best
        chance = float(np.sqrt(len(more)) * more.std(ddof=1))
        within = float(heldout.sum()) <= float(best.sum()) * (1.0 + MARGIN) ** 2
        if within and (surely is None or float(more.sum()) <= surely * chance):
            good.append(option)
    return min(good, key=lambda o: o.count)


def _bic(observations: Observations, option: Option) -> float:
    """Return Schwarz's criterion, n log(mean squared residual) + parameters log n."""
    n = 2 * int(option.fit.kept.sum())
    error = option.fit.rms_px
    return float(n * np.log(error**2 + np.finfo(float).tiny) + option.count * np.log(n))


def described(options: list[Option], chosen: Option, *, rivals: bool = False) -> list[Candidate]:
    """Return what was tried, and why it was chosen or not; `rivals`: others than these were tried as well."""
    out = []
    for o in options:
        if len(options) == 1 and not rivals:
            reason = "the only one tried"
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
