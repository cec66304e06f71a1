"""Test whether the lens changed while the images were taken: a change point between earlier and later images.

The change point is searched at first order: the scores of the images, with poses eliminated, are summed in the order of
the images, and the split is where lenses of the two parts differ most. As the best of many splits is good by chance,
too, the search is repeated in random orders of the images (permutation test).

An error of the board model makes images differ, too, where they show the board in different ways. So splits in time are
compared with splits by place: boards left and right, near and far, tilted in different directions. Only a split in time
that separates more clearly than all of those is a lens that moved. The same test is done for images with two kinds of
names.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.judging.two_kinds import RIDGE_OF_STEP, SIGMAS_DO_NOT_HOLD, min_of_a_kind
from rigkit.calibration.solving.clustered import reduced_by_cluster
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.solver import FROM_OPTIMUM, solve
from rigkit.calibration.solving.state import State, weighted_squares
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.findings import Finding

MIN_IMAGES_FOR_HALVES = 10
MIN_HALF_SIGMAS = 3.0
"""Root mean squared difference of the parameters, in standard deviations, from which two parts may be of two lenses.
That of two halves of one lens is 1, at most 2."""
AGAINST_PLACE = 1.4
"""Root of the cost decrease of the split given any split by place, over that of the split by place given this one,
from which it is a change of the lens. Measured, the smallest over all splits by place: 0.3 to 1.1 in 12 REAL and
RENDERED sessions of one lens; 0.9 to 1.6 (once 1.7 in 720) in their random orders that separate as clearly by chance;
1.3 and more in nine of ten, typically 2.7, where eight of the sessions have a zoom of 3 or 15 % between two parts."""
ORDERS, CHANCE = 199, 0.02
"""Number of random orders, and the largest part of them that may separate the images as well as time does."""
DIGITS = re.compile(r"\d+")


def moved_lens(observations: Observations, fit: Fit, *, tests: int = 1) -> tuple[Finding, ...]:
    """Return a finding if the images before and from one image on, in the order given, have different intrinsics, or
    if images with two kinds of names do. `tests` is the number of models that are tested in turn: chance counts each
    (Bonferroni)."""
    images = list(dict.fromkeys(observations.images))
    if len(images) < MIN_IMAGES_FOR_HALVES:
        return ()
    place = {name: i for i, name in enumerate(images)}
    number = np.array([place[name] for name in observations.images])
    # Board shapes are held: two shapes are not two lenses.
    state = fit.state.with_boards_held()
    scores, order = _ImageScores.of(fit, number), np.arange(len(images))
    first = scores.split_at(order)
    later = order >= first
    positions = [*_places(observations, state), number % 2]

    def difference_sigmas(second: BoolArray) -> float | None:
        """Return the difference, in standard deviations, between the lenses of the images `second` (N,) and of the
        others, None unless it is significant and larger than for splits by the boards' places."""
        distance = _cost_difference(observations, fit, state, second[number])
        if not distance > MIN_HALF_SIGMAS:
            return None
        alone = scores.gain_of(second)
        for values in positions:
            other = scores.split_by(np.bincount(number, values) / np.bincount(number))
            if not other.any() or (other == second).all() or (other != second).all():
                continue
            both = scores.gain_of_both(second, other)
            if both - scores.gain_of(other) < AGAINST_PLACE**2 * (both - alone):
                return None
        return distance

    named = _of_other_name_kind(images)
    if named is not None and not (named == later).all() and not (named != later).all():
        distance = difference_sigmas(named)
        if distance is not None:
            other, one = images[int(np.argmax(named))], images[int(np.argmin(named))]
            message = (
                f"images of two cameras are mixed: the lenses of those named like '{one}' and like '{other}' differ "
                f"({distance:.0f} standard deviations)"
            )
            remedy = (
                "calibrate each camera from its own images, and images that a program changed apart from the others"
            )
            return (Finding.bad(message, remedy),)
    distance = difference_sigmas(later)
    if distance is None or (chance := tests * scores.chance(observations.clusters(), number, tests)) > CHANCE:
        return ()
    message = (
        f"the lens (or the board) changed at image '{images[first]}' ({distance:.0f} standard deviations, p <= "
        f"{chance:.2g} for a split at any image): another camera, focus, zoom or mount, or images that a program "
        f"changed; {SIGMAS_DO_NOT_HOLD}"
    )
    return (Finding.bad(message, "calibrate the images before it and those from it on separately, or retake all"),)


def moment(order: Sequence[str], some: Collection[str]) -> str:
    """Return in words that `some` of the images in `order` are the first or the last ones; "" if they are neither."""
    for at, words in ((len(some), "before '{}'"), (len(order) - len(some), "from '{}' on")):
        if 0 < at < len(order) and set(order[:at] if words.startswith("before") else order[at:]) == set(some):
            return words.format(order[at])
    return ""


@dataclass(frozen=True, eq=False, slots=True)
class _ImageScores:
    """Information (N, P, P) and score (N, P) of N images on the lens, poses eliminated, scaled so that their sum with
    the prior (P, P) has a unit diagonal; each part of a split has at least `min_images` images."""

    information: FloatArray
    score: FloatArray
    prior: FloatArray
    min_images: int

    @classmethod
    def of(cls, fit: Fit, number: IntArray) -> _ImageScores:
        """Return those of the images `number` (V,) of the views, with all other unknowns held."""
        p = fit.state.camera.parameters.size
        rows = np.r_[:p, -7:0] % fit.data.products[0].shape[-1]
        information, score = reduced_by_cluster(fit.data.products[0][:, rows[:, None], rows], p, number)
        prior = (fit.normal.gg - fit.data.gg)[:p, :p]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information.sum(axis=0) + prior), np.finfo(float).tiny))
        across = scale[:, None] * scale
        min_images = int(np.ceil(min_of_a_kind(len(score))))
        return cls(information * across, score * scale, prior * across + RIDGE_OF_STEP * np.eye(p), min_images)

    def gains(self, order: IntArray) -> FloatArray:
        """Return the first-order decrease of the cost when the first k images in this order (N,) and the others have
        separate lenses, against one common lens, for each k that leaves both parts enough images."""
        at = slice(self.min_images - 1, len(order) - self.min_images)
        return self._gain(self.information[order].cumsum(axis=0)[at], self.score[order].cumsum(axis=0)[at])

    def split_at(self, order: IntArray) -> int:
        """Return the number of images in this order (N,) before the split with the largest decrease."""
        return self.min_images + int(np.argmax(self.gains(order)))

    def split_by(self, values: FloatArray) -> BoolArray:
        """Return the images above the threshold of these `values` (N,) with the largest decrease; none if there is no
        threshold. Equal values are not split: they would be in the order of the images."""
        order = np.argsort(values, kind="stable")
        ranked = values[order]
        below = ranked[self.min_images - 1 : len(order) - self.min_images]
        above = ranked[self.min_images : len(order) - self.min_images + 1]
        gains = np.where(below < above, self.gains(order), -np.inf)
        best = int(np.argmax(gains))
        return np.asarray(values > (below[best] if np.isfinite(gains[best]) else np.inf))

    def gain_of(self, second: BoolArray) -> float:
        """Return the decrease for separate lenses of the images `second` (N,) and the others."""
        return float(self._gain(self.information[second].sum(axis=0)[None], self.score[second].sum(axis=0)[None])[0])

    def _gain(self, information: FloatArray, score: FloatArray) -> FloatArray:
        """Return the decrease for K first parts with these sums (K, P, P) and (K, P)."""
        every, pull = self.information.sum(axis=0), self.score.sum(axis=0)
        gain = -pull @ np.linalg.solve(every + self.prior, pull)
        for own, part in ((information, score), (every - information, pull - score)):
            gain = gain + (part[:, None] @ np.linalg.solve(own + self.prior, part[..., None]))[:, 0, 0]
        return np.asarray(gain)

    def gain_of_both(self, one: BoolArray, other: BoolArray) -> float:
        """Return the decrease when lenses differ by two additive effects, of the splits `one` (N,) and `other`."""
        sides = np.stack([np.ones(len(one)), one, other])
        p = self.prior.shape[0]
        every = np.einsum("av,bv,vij->aibj", sides, sides, self.information)
        # The prior of the lens applies to each effect, too.
        every += np.einsum("ab,ij->aibj", np.eye(3), self.prior)
        pull = sides @ self.score
        whole = pull.ravel() @ np.linalg.solve(every.reshape(3 * p, 3 * p), pull.ravel())
        return float(whole - pull[0] @ np.linalg.solve(every[0, :, 0], pull[0]))

    def chance(self, clusters: IntArray, number: IntArray, tests: int = 1) -> float:
        """Return the p-value of the permutation test: the part of random orders with a split at least as good as in the
        true order; 1 as soon as it exceeds `CHANCE` / `tests`. Near-duplicates, views (V,) of one cluster, stay
        together; `number` (V,) is the index of each view's image."""
        of_image = np.zeros(len(self.score), np.int64)
        of_image[number] = clusters
        found = self.gains(np.arange(len(of_image))).max()
        rng, reached = np.random.default_rng(0), 1
        for _ in range(ORDERS):
            reached += bool(self.gains(np.argsort(rng.random(of_image.max() + 1)[of_image])).max() >= found)
            if tests * reached > CHANCE * (ORDERS + 1):
                return 1.0
        return reached / (ORDERS + 1)


def _of_other_name_kind(images: Sequence[str]) -> BoolArray | None:
    """Return which images (N,) have another kind of name (without digits) than the first; None unless there are exactly
    two kinds with enough images each."""
    kinds = [DIGITS.sub("", name) for name in images]
    if len(set(kinds)) != 2:
        return None
    other = np.array([kind != kinds[0] for kind in kinds])
    return other if 2 * min(other.sum(), (~other).sum()) >= MIN_IMAGES_FOR_HALVES else None


def _places(observations: Observations, state: State) -> FloatArray:
    """Return the places of the views, (K, V): position in the image, distance from its mean, distance, tilts."""
    present = observations.present[..., None]
    count = np.maximum(present.sum(axis=1), 1)
    pixels = (observations.pixels * present).sum(axis=1) / count
    points = (state.points_in_cam(observations)[0] * present).sum(axis=1) / count
    off = np.linalg.norm(pixels - pixels.mean(axis=0), axis=1)
    return np.stack([*pixels.T, off, np.linalg.norm(points, axis=1), *state.rotation[:, :2, 2].T])


def _cost_difference(observations: Observations, fit: Fit, state: State, second: BoolArray) -> float:
    """Return the difference of the intrinsics of two sets of views in standard deviations, from the decrease of the
    cost with separate intrinsics: for one lens that is sigma^2 for each parameter."""
    whole, split, count = 0.0, 0.0, 0
    for chosen in (np.flatnonzero(~second), np.flatnonzero(second)):
        part, start = observations.subset(chosen), state.subset(chosen)
        weight = np.where(fit.kept[chosen], part.weight, 0.0)
        own = solve(part, start, weight=weight, prior_sigma_px=fit.sigma_px, cost_tolerance=FROM_OPTIMUM).state
        whole += float(weighted_squares(start, part, weight).sum())
        split += float(weighted_squares(own, part, weight).sum())
        count += 2 * int(fit.kept[chosen].sum()) - 6 * len(chosen)
    p = state.camera.parameters.size
    variance = split / max(count - 2 * p, 1)
    return float(np.sqrt(max(whole - split, 0.0) / (p * variance))) if variance > 0.0 else 0.0
