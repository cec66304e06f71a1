"""Images of two kinds, from two lenses or two settings of one: which image is of which kind, and whether by chance.

With its pose eliminated, each image has a score and an information on the lens: to first order, how much better it is
explained by any other lens. Which images go together is found by alternating, as k-means does, between the two lenses
that explain most and the assignment of each image to the lens that explains it better. Two lenses explain nearly all of
what a lens of its own for every image would explain. Other errors (of lens or board model, motion) scatter the images
without a gap, and two lenses explain less of that; how much, with the search among all splits, is known from images
whose lenses are spread evenly instead (as in the "gap statistic" of Tibshirani, Walther and Hastie, J. R. Stat. Soc. B
63, 2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.solving.clustered import reduced_by_cluster, root_of_inverse
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.linearise import view_products
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.moving_pupil import far_camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray

MIN_OF_A_KIND, MIN_SHARE_OF_A_KIND = 3, 0.1
"""Smallest number, and part, of images of a kind; fewer are reported one by one."""
KINDS_REMEDY = (
    "look for another camera, zoom or focus, or images that a program rotated, mirrored, cropped, resized or "
    "undistorted; calibrate each group separately"
)
"""Remedy for images of two kinds."""
MAX_NAMES = 20
"""Maximal number of images that are listed by name."""
SIDES_ROUNDS, STARTS = 8, 4
"""Maximal number of rounds in which images change sides, and number of first guesses: the best splits along so many
principal axes of the scores."""
RIDGE_OF_STEP = 1e-9
"""Ridge, as a part of the information, that keeps undetermined directions at zero."""
MIN_OWN_INFORMATION = 1e-6
"""Relative eigenvalue of one image's information up to which it does not determine a combination."""
MIN_SHARE_OF_TWO = 2.0 / np.pi
"""Part of what a lens for each image explains that two lenses must explain: two points explain so much of a normal
distribution along one axis, less along several. REAL: 0.16 to 0.55 in 15 sessions of one camera; of two cameras in
equal parts 0.71 to 0.94, cylinder's 0.60 to 0.71, bumblebee2's 0.60 to 0.69."""
AS_MUCH_BY_FOCUS = 0.85
"""Part of what two lenses explain, from which another focal length for every image explains as much. SIMULATED, 16
sessions with 20 focal lengths: 0.93 to 1.5; REAL images of two cameras: 0.13 to 0.72."""
FOCUS_GRID = (16, 12)
"""Pixels (columns, rows) at which an enlarged image is compared."""
MIN_PREDICTED = 0.75
"""Part of the images, weighted by how clearly their other halves tell, whose halves must tell the same lens, minus the
part that tell different ones: 1 where each image is of one of two lenses, 0 where its halves agree by chance. REAL:
-1.0, -0.4, 0.62 and 0.64 for groups in parts of sessions of one camera, 0.93 to 1.0 where all of two are named."""
DRAWS, CHANCE = 199, 0.02
"""Number of random draws or orders, and the largest part of these orders that may separate the images as well as time
does."""
CHANCE_OF_GROUPS = 0.01
"""The largest part of the draws that two lenses may explain as well."""
CHANCE_ALONG = 0.25
"""The same of draws in which lenses are spread evenly between the two. 0.02 to 0.2 where all of two REAL cameras are
named (one 0.31); 0.44 to 0.85 where boards that move before a rolling shutter, SIMULATED in REAL sessions, or
stabilised images were taken for two groups: normally distributed changes look less like two than even ones."""


def min_of_a_kind(images: int) -> float:
    """Return the smallest number of images of a kind, for so many `images`."""
    return max(MIN_OF_A_KIND, MIN_SHARE_OF_A_KIND * images)


def listed(images: Sequence[str]) -> str:
    """Return the names of images, or of the first of them."""
    return ", ".join(f"'{name}'" for name in images[:MAX_NAMES]) + (", ..." if len(images) > MAX_NAMES else "")


@dataclass(frozen=True, eq=False, slots=True)
class ImageScores:
    """Information (N, P, P) and score (N, P) of N images on the lens, poses eliminated, in coordinates in which their
    sum with the prior (P, P) is the identity; each part of a split has at least `min_images` images."""

    information: FloatArray
    score: FloatArray
    prior: FloatArray
    min_images: int

    @classmethod
    def of(cls, fit: Fit, number: IntArray, min_images: int | None = None) -> ImageScores:
        """Return those of the images `number` (V,) of the views, with all other unknowns held; by default a part has at
        least `min_of_a_kind` images."""
        return cls.scaled(*_of_images(fit, number), _prior(fit), min_images)

    @classmethod
    def of_halves(cls, observations: Observations, fit: Fit, number: IntArray) -> ImageScores:
        """Return those of one half of each image `number` (V,) of the views, and then those of the other (2 N, ...):
        every board is cut across its longer direction in the image, and both parts may have poses of their own."""
        first, weight, count = _first_halves(observations, fit.kept), fit.weight(observations), number.max() + 1
        parts = [view_products(observations, fit.state, np.where(half, weight, 0.0)) for half in (first, ~first)]
        p = fit.state.camera.parameters.size
        of_halves = reduced_by_cluster(np.concatenate(parts), p, np.r_[number, count + number])
        return cls.scaled(*of_halves, _prior(fit), 1)

    @classmethod
    def scaled(
        cls,
        information: FloatArray,
        score: FloatArray,
        prior: FloatArray,
        min_images: int | None = None,
    ) -> ImageScores:
        """Return those of images with this information (N, P, P), score (N, P) and prior (P, P) in any coordinates."""
        root = root_of_inverse(information.sum(axis=0) + prior)
        ridge = RIDGE_OF_STEP * np.eye(root.shape[1])
        if min_images is None:
            min_images = int(np.ceil(min_of_a_kind(len(score))))
        return cls(root.T @ information @ root, score @ root, root.T @ prior @ root + ridge, min_images)

    def gains(self, order: IntArray) -> FloatArray:
        """Return the first-order decrease of the cost when the first k images in this order (..., N) and the others
        have separate lenses, against one common lens, for each k that leaves both parts enough images."""
        at = slice(self.min_images - 1, order.shape[-1] - self.min_images)
        information, score = self.information[order].cumsum(axis=-3), self.score[order].cumsum(axis=-2)
        return self._gain(information[..., at, :, :], score[..., at, :])

    def split_at(self, order: IntArray) -> int:
        """Return the number of images in this order (N,) before the split with the largest decrease."""
        return self.min_images + int(np.argmax(self.gains(order)))

    def split_by(self, values: FloatArray) -> BoolArray:
        """Return the images above the threshold of these `values` (..., N) with the largest decrease; none if there is
        no threshold. Equal values are not split: they would be in the order of the images."""
        order = np.argsort(values, kind="stable")
        ranked = np.take_along_axis(values, order, axis=-1)
        below = ranked[..., self.min_images - 1 : -self.min_images]
        above = ranked[..., self.min_images : values.shape[-1] - self.min_images + 1]
        gains = np.where(below < above, self.gains(order), -np.inf)
        best = np.argmax(gains, axis=-1)[..., None]
        split = np.isfinite(np.take_along_axis(gains, best, axis=-1))
        return np.asarray(values > np.where(split, np.take_along_axis(below, best, axis=-1), np.inf))

    def gain_of(self, second: BoolArray) -> float:
        """Return the decrease for separate lenses of the images `second` (N,) and the others."""
        return float(self._gain(self.information[second].sum(axis=0), self.score[second].sum(axis=0)))

    def _gain(self, information: FloatArray, score: FloatArray) -> FloatArray:
        """Return the decrease (...) for first parts with these sums (..., P, P) and (..., P)."""
        every, pull = self.information.sum(axis=0), self.score.sum(axis=0)
        gain = -pull @ np.linalg.solve(every + self.prior, pull)
        for own, part in ((information, score), (every - information, pull - score)):
            gain = gain + (part[..., None, :] @ np.linalg.solve(own + self.prior, part[..., None]))[..., 0, 0]
        return np.asarray(gain)

    def gain_of_effects(self, *effects: FloatArray | BoolArray) -> float:
        """Return the decrease when lenses differ by additive effects, each in proportion to its values (N,)."""
        sides = np.stack([np.ones(len(self.score)), *effects]).astype(np.float64)
        k, p = len(sides), self.prior.shape[0]
        every = np.einsum("av,bv,vij->aibj", sides, sides, self.information)
        # The prior of the lens applies to each effect, too.
        every += np.einsum("ab,ij->aibj", np.eye(k), self.prior)
        pull = sides @ self.score
        whole = pull.ravel() @ np.linalg.solve(every.reshape(k * p, k * p), pull.ravel())
        return float(whole - pull[0] @ np.linalg.solve(every[0, :, 0], pull[0]))

    def best_split(self, to_own: FloatArray | None = None) -> tuple[BoolArray, float] | None:
        """Return which images (N,) are of the second kind in the split that explains most, and the part that it
        explains of what a lens for each image does; None with too few images, or where nothing is to be explained.
        `to_own` is the first result of `_own_roots`, if known."""
        if len(self.score) < 2 * self.min_images:
            return None
        own = self._own_amounts(self._own_roots()[0] if to_own is None else to_own)
        explained, axes = float((own**2).sum()), np.linalg.svd(own, full_matrices=False)[2][:STARTS]
        across = np.einsum("kp,npq,kq->kn", axes, self.information, axes, optimize=True)
        amounts = axes @ self.score.T / np.maximum(across, np.finfo(float).tiny)
        guesses = self.split_by(amounts)
        guesses = guesses[guesses.any(axis=1)]
        if not len(guesses) or not explained > 0.0:
            return None
        found = self._alternated(guesses)
        gains = self._gain(np.tensordot(found, self.information, 1), found @ self.score)
        return found[np.argmax(gains)], float(gains.max()) / explained

    def predicted_across(self, second: BoolArray) -> float:
        """Return how well one half of an image tells the lens, of the images `second` (N,) or of the others, that
        explains its other half better: 1 always, 0 by chance. These are scores of halves (2 N); the two lenses are
        those of all other images. One without another of its lens does not count."""
        n, sides = len(second), np.stack([~second, second])
        information, score = self.information.reshape(2, n, *self.prior.shape), self.score.reshape(2, n, -1)
        others = sides.astype(np.float64)[:, None] * (1.0 - np.eye(n))
        every = np.einsum("skn,npq->skpq", others, information.sum(axis=0), optimize=True) + self.prior
        lens = np.linalg.solve(every, (others @ score.sum(axis=0))[..., None])[..., 0]
        explained = np.einsum("hkp,skp->hsk", score, lens)
        explained -= 0.5 * np.einsum("skp,hkpq,skq->hsk", lens, information, lens, optimize=True)
        lead = (explained[:, 1] - explained[:, 0])[:, others.any(axis=2).all(axis=0)]
        whole = float(np.abs(lead).sum())
        return float((np.sign(lead) * lead[::-1]).sum()) / whole if whole > 0.0 else 0.0

    def is_of_two(self, second: BoolArray, share: float, explained_by_focus: float = 0.0) -> bool:
        """Return whether images whose lenses are spread evenly would hardly be explained as well by two lenses as these
        are by the best split `second` (N,) with this `share`.

        Evenly spread are either the lenses along the difference of the two, with all else in the scores kept, or the
        images' own amounts along their principal axes, with the same second moments. In the first no error of the model
        becomes smaller, in the second an image that determines its lens better than others is not larger. Where other
        focal lengths from image to image explain as much as the two lenses (`explained_by_focus`), the first decides.
        """
        to_own, back = self._own_roots()
        own = self._own_amounts(to_own)
        first, other = self._lenses(second)
        along = self.information @ (other - first)
        amount, explained = _amounts(along, other - first, self.score)
        by_focus = explained_by_focus >= AS_MUCH_BY_FOCUS * self.gain_of(second)
        spread = np.sqrt(explained / float((along @ (other - first)).sum())) * (other - first)[None]
        rest, chance = self.score - along * amount[:, None], CHANCE_OF_GROUPS if by_focus else CHANCE_ALONG
        if not self._rarely_reached(share, rest, self.information, spread, chance):
            return False
        _, size, axes = np.linalg.svd(own, full_matrices=False)
        spread = (size / np.sqrt(len(own)))[:, None] * axes
        return by_focus or self._rarely_reached(share, np.zeros_like(own), back, spread, CHANCE_OF_GROUPS)

    def _rarely_reached(
        self, share: float, rest: FloatArray, back: FloatArray, spread: FloatArray, chance: float
    ) -> bool:
        """Return whether no more than this part of random draws have a best split with this share: scores are `rest`
        (N, P) and those by `back` (N, P, Q) of amounts that are uniformly distributed along `spread` (K, Q)."""
        rng, reached, (to_own, _) = np.random.default_rng(0), 1, self._own_roots()
        for _ in range(DRAWS):
            even = np.sqrt(12.0) * (rng.random((len(rest), len(spread))) - 0.5) @ spread
            score = rest + (back @ even[..., None])[..., 0]
            # Of one lens that was fitted to all of them.
            drawn = replace(self, score=score - self.information @ score.sum(axis=0)).best_split(to_own)
            reached += drawn is not None and drawn[1] >= share
            if reached > chance * (DRAWS + 1):
                return False
        return True

    def _own_amounts(self, to_own: FloatArray) -> FloatArray:
        """Return the images' scores on combinations of unit information (N, P), whose squares are what a lens of its
        own explains of each image."""
        return np.asarray((to_own @ self.score[..., None])[..., 0])

    def _own_roots(self) -> tuple[FloatArray, FloatArray]:
        """Return the matrices (N, P, P) that make amounts of `_own_amounts` of scores, and those that make scores of
        them."""
        values, vectors = np.linalg.eigh(self.information)
        size, turned = np.sqrt(np.maximum(values, np.finfo(float).tiny)), np.swapaxes(vectors, -1, -2)
        inverse = np.where(values > MIN_OWN_INFORMATION * values[:, -1:], 1.0 / size, 0.0)
        return (vectors * inverse[:, None]) @ turned, (vectors * size[:, None]) @ turned

    def _alternated(self, second: BoolArray) -> BoolArray:
        """Return the splits (G, N) that alternating leads to from first guesses."""
        for _ in range(SIDES_ROUNDS):
            lenses = self._lenses(second)
            along = np.tensordot(lenses, self.information, (2, 1))
            explained = lenses @ self.score.T - 0.5 * (along @ lenses[..., None])[..., 0]
            closer = explained[1] > explained[0]
            size = closer.sum(axis=1)
            moved = (size >= self.min_images) & (size <= closer.shape[1] - self.min_images)
            moved &= (closer != second).any(axis=1)
            if not moved.any():
                break
            second = np.where(moved[:, None], closer, second)
        return second

    def _lenses(self, second: BoolArray) -> FloatArray:
        """Return the lens that explains most of the images that are not `second` (..., N), and that of those,
        (2, ..., P)."""
        sides = np.stack([~second, second]).astype(np.float64)
        information = np.tensordot(sides, self.information, 1) + self.prior
        return np.asarray(np.linalg.solve(information, (sides @ self.score)[..., None])[..., 0])

    def chance(self, clusters: IntArray, number: IntArray, tests: int = 1) -> float:
        """Return the p-value of the permutation test: the part of random orders with a split at least as good as in the
        true order; 1 as soon as it exceeds `CHANCE` / `tests`. Near-duplicates, views (V,) of one cluster, stay
        together; `number` (V,) is the index of each view's image."""
        of_image = np.zeros(len(self.score), np.int64)
        of_image[number] = clusters
        found = self.gains(np.arange(len(of_image))).max()
        rng, reached = np.random.default_rng(0), 1
        for _ in range(DRAWS):
            reached += bool(self.gains(np.argsort(rng.random(of_image.max() + 1)[of_image])).max() >= found)
            if tests * reached > CHANCE * (DRAWS + 1):
                return 1.0
        return reached / (DRAWS + 1)


def _of_images(fit: Fit, number: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return information (N, P, P) and score (N, P) of the images `number` (V,) of the views."""
    p = fit.state.camera.parameters.size
    return reduced_by_cluster(fit.data.products[0], p, number, fit.normal.covariance[2])


def explained_by_focus(fit: Fit, number: IntArray) -> float:
    """Return what another focal length for every image explains, of the images `number` (V,) of the views."""
    information, score = _of_images(fit, number)
    step = _longer_focus(fit.state.camera)
    return _amounts(information @ step, step, score)[1]


def _prior(fit: Fit) -> FloatArray:
    """Return the prior information (P, P) on the lens."""
    p = fit.state.camera.parameters.size
    return np.asarray((fit.normal.gg - fit.data.gg)[:p, :p])


def _first_halves(observations: Observations, kept: BoolArray) -> BoolArray:
    """Return the corners (V, C) that are beyond the median of the `kept` ones along the view's longer direction."""
    count = np.maximum(kept.sum(axis=1), 1)[:, None]
    off = np.where(kept[..., None], observations.pixels, 0.0)
    off = np.where(kept[..., None], off - (off.sum(axis=1) / count)[:, None], 0.0)
    longest = np.linalg.eigh(np.swapaxes(off, 1, 2) @ off)[1][..., -1:]
    along = (off @ longest)[..., 0]
    ranked = np.sort(np.where(kept, along, np.inf), axis=1)
    return np.asarray(along >= np.take_along_axis(ranked, count // 2, axis=1))


def _amounts(along: FloatArray, step: FloatArray, score: FloatArray) -> tuple[FloatArray, float]:
    """Return the amount (N,) of a `step` (P,) that explains each image best, from the images' information `along` it
    (N, P) and `score` (N, P), and what these amounts explain."""
    pull = score @ step
    amount = pull / np.maximum(along @ step, np.finfo(float).tiny)
    return amount, float(pull @ amount)


def _longer_focus(camera: Camera) -> FloatArray:
    """Return the change of the parameters (P,) that comes nearest to an enlarged image."""
    lens = far_camera(camera)
    pixels = grid_pixels(lens.size_px, FOCUS_GRID)
    rays, valid = lens.unproject(pixels)
    pixels, inside, _, d_pixels_d_parameters = lens.project_with_jacobians(rays[valid])
    rows = np.swapaxes(d_pixels_d_parameters[inside], 0, 1).reshape(-1, d_pixels_d_parameters.shape[-1])
    length = np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)
    step = np.linalg.lstsq(rows / length, (pixels[inside] - lens.axis_px).T.ravel(), rcond=MIN_OWN_INFORMATION)[0]
    return np.append(step / length, np.zeros(camera.parameters.size - len(step)))
