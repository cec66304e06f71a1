"""Tests whether all images are of one lens: earlier and later ones, those of two kinds of names, and any two groups;
and whether they are of two cameras that took them together.

The change point is searched at first order: the scores of the images, with poses eliminated, are summed in the order of
the images, and the split is where lenses of the two parts differ most. As the best of many splits is good by chance,
too, the search is repeated in random orders of the images (permutation test). Groups in any order are those of
`two_kinds`.

An error of the board model makes images differ, too, where they show the board in different ways. So splits are
compared with splits by place: boards left and right, near and far, tilted in different directions. Only a split that
separates more clearly than all of those is of two lenses.

Two cameras on one mount see each board in two poses with always the same motion in between. In images of one camera no
motion between poses occurs twice, unless the board was moved by equal steps: then an image is the end of one step and
the start of the next, or there are other motions that occur as often. Boards that only turn about a point, as a robot's
do at each of two places, must need two lenses as well. Images in which the board hardly moved are one.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.calibration.diagnosis.two_kinds import (
    CHANCE,
    KINDS_REMEDY,
    MIN_OF_A_KIND,
    MIN_PREDICTED,
    MIN_SHARE_OF_TWO,
    ImageScores,
    explained_by_focus,
    listed,
    min_of_a_kind,
)
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.fit import Fit, fit_model
from rigkit.calibration.solving.solver import FROM_OPTIMUM, solve
from rigkit.calibration.solving.state import State, weighted_squares
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.repeats import close_pairs
from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.moving_pupil import far_camera
from rigkit.cameras.scaramuzza import Scaramuzza
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, spread_indices
from rigkit.core.errors import DegenerateError, InputError
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
AGAINST_PLACE_SEARCHED = 1.7
"""The same for a split that is the best one of all: 0.7 to 2.0 in 20 REAL and RENDERED sessions of one camera, 1.8 to
5.6 in 13 of 14 of two (earlier versions of the split). Alone it does not separate them; the other conditions do."""
DIGITS = re.compile(r"\d+")
SAME_MOTION = 0.005
"""Two motions are equal where they move the board to the same place within this part of its distance."""
MIN_MOTION = 2.0
"""A smaller multiple of that is no motion."""
MIN_PARTNERS = 3
"""Number of pairs of images with the same motion that is not chance: a motion has six parameters, and in 15 REAL sets
of one camera, of 9 to 30 images, none occurs twice."""
MIN_SHARE_PAIRED = 1.0 / 3.0
"""Part of all images that must be in such pairs: many images may be of a video, in which a board glides evenly."""
MAX_SHARE_CHAINED = 0.2
"""Part of these images that may be both start and end; more is a board moved by equal steps."""
MAX_SHARE_OTHER = 0.5
"""Largest number of pairs with another motion, as a part of theirs; more are equal steps."""
OTHER_MOTION = 3.0
"""Multiple of the distance of equal motions from which two are different: nearer ones may be equal, but less exact."""
MAX_STARTS = 24
"""Number of views from which motions are tried, spread over the places of the boards, whatever their order."""


def moved_lens(observations: Observations, fit: Fit, *, tests: int = 1) -> tuple[Finding, ...]:
    """Return a finding if the images before and from one image on, in the order given, have different intrinsics, or
    if images with two kinds of names do. `tests` is the number of models that are tested in turn: chance counts each
    (Bonferroni)."""
    images = list(dict.fromkeys(observations.images))
    if len(images) < MIN_IMAGES_FOR_HALVES:
        return ()
    place = {name: i for i, name in enumerate(images)}
    splits = _Splits.of(observations, fit, np.array([place[name] for name in observations.images]))
    order = np.arange(len(images))
    first = splits.scores.split_at(order)
    later, named, in_turns = order >= first, _of_other_name_kind(images), order % 2
    if named is not None and not (named == later).all() and not (named != later).all():
        apart = splits.difference(named, in_turns)
        if apart is not None:
            other, one = images[int(np.argmax(named))], images[int(np.argmin(named))]
            message = (
                f"images of two cameras are mixed: the lenses of those named like '{one}' and like '{other}' differ "
                f"({apart.sigmas:.0f} standard deviations)"
            )
            remedy = (
                "calibrate each camera from its own images, and images that a program changed apart from the others"
            )
            return (Finding.bad(message, remedy),)
    apart = splits.difference(later, in_turns)
    if apart is None:
        return ()
    chance = tests * splits.scores.chance(observations.clusters(), splits.number, tests)
    if chance > CHANCE:
        return ()
    message = (
        f"the lens (or the board) changed at image '{images[first]}' ({apart.sigmas:.0f} standard deviations, p <= "
        f"{chance:.2g} for a split at any image): another camera, focus, zoom or mount, or images that a program "
        "changed"
    )
    remedy = "calibrate the images before it and those from it on separately, or retake all"
    return (Finding.contradicting(message, remedy),)


def two_groups(observations: Observations, fits: Sequence[Fit], *, one_model: bool) -> tuple[Finding, ...]:
    """Return a finding if the images, in any order, are of two lenses according to the fits of all models: errors of a
    model, too, make groups, but others with another model: where `one_model` was tried, a flexible one is fitted.
    Near-duplicates count as one image."""
    number = observations.clusters()
    if number.max() + 1 < 2 * MIN_OF_A_KIND:
        return ()
    found = None
    for fit in fits:
        again = _group(_Splits.of(observations, fit, number, min_images=1))
        if again is None:
            return ()
        found = found or again
    if found is None or (one_model and not _is_flexible(fits[0]) and not _flexible_model_agrees(observations, fits[0])):
        return ()
    return (_groups_named(observations, *found),)


def _is_flexible(fit: Fit) -> bool:
    return isinstance(far_camera(fit.state.camera), KannalaBrandt | Scaramuzza)


def _flexible_model_agrees(observations: Observations, fit: Fit) -> bool:
    """Return whether the images are of two lenses by a model for all fields of view, too: two lenses explain so
    much."""
    try:
        again = fit_model(observations, fit.state.camera.size_px, KannalaBrandt, None)
    except (DegenerateError, InputError):
        return False
    found = ImageScores.of(again, observations.clusters(), 1).best_split()
    return found is not None and found[1] >= MIN_SHARE_OF_TWO


def _group(splits: _Splits) -> tuple[BoolArray, _Difference] | None:
    """Return which images (N,) are of the second of two lenses, and the lenses; None if they are of one."""
    found = splits.scores.best_split()
    if found is None or found[1] < MIN_SHARE_OF_TWO:
        return None
    apart = splits.difference(found[0], against=AGAINST_PLACE_SEARCHED)
    if apart is None or not splits.scores.is_of_two(*found, explained_by_focus(splits.fit, splits.number)):
        return None
    halves = ImageScores.of_halves(splits.observations, splits.fit, splits.number)
    if halves.predicted_across(found[0]) < MIN_PREDICTED:
        return None
    return found[0], apart


def _groups_named(observations: Observations, second: BoolArray, apart: _Difference) -> Finding:
    images = list(dict.fromkeys(observations.images))
    of_second = {name for name, at in zip(observations.images, observations.clusters(), strict=True) if second[at]}
    fewer, more = sorted(([n for n in images if (n in of_second) is side] for side in (True, False)), key=len)
    if min(np.count_nonzero(second), np.count_nonzero(~second)) < min_of_a_kind(len(second)):
        return Finding.contradicting(
            f"another camera seems to have taken {len(fewer)} of {len(images)} images: {listed(fewer)} ({apart.words})",
            "look whether they are of this camera, at its zoom and focus, and sharp; else leave them out",
        )
    return Finding.contradicting(
        f"the images form two groups that need different lens parameters, as those of two cameras: {len(fewer)} "
        f"({listed(fewer)}) and {len(more)} like '{more[0]}' ({apart.words})",
        KINDS_REMEDY,
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Difference:
    """Lenses of two parts of the images, and their difference in standard deviations."""

    cameras: tuple[Camera, Camera]
    sigmas: float

    @property
    def words(self) -> str:
        one, other = self.cameras
        focal = 100.0 * abs(np.log(one.focal_px / other.focal_px))
        shift = float(np.linalg.norm(one.axis_px - other.axis_px))
        return f"focal lengths {focal:.1f} %, principal points {shift:.0f} px apart"


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Splits:
    """Splits of N images into two parts that may be of two lenses.

    Attributes
    ----------
    observations, fit, state : of the calibration; in the state board shapes are held: two shapes are not two lenses.
    number : (V,) index of each view's image.
    scores : of the images.
    """

    observations: Observations
    fit: Fit
    state: State
    number: IntArray
    scores: ImageScores

    @classmethod
    def of(cls, observations: Observations, fit: Fit, number: IntArray, *, min_images: int | None = None) -> _Splits:
        return cls(
            observations=observations,
            fit=fit,
            state=fit.state.with_boards_held(),
            number=number,
            scores=ImageScores.of(fit, number, min_images),
        )

    def difference(
        self, second: BoolArray, *other_causes: IntArray, against: float = AGAINST_PLACE
    ) -> _Difference | None:
        """Return the difference between the lenses of the images `second` (N,) and of the others, None unless it is
        significant and larger than for splits by the boards' places and by `other_causes` (N,) (`against`: see
        `AGAINST_PLACE`). Where it is a split by place itself, it is compared with a lens that differs in proportion to
        the place."""
        parts = [np.flatnonzero(second[self.number] == side) for side in (False, True)]
        apart = _solved_apart(self.observations, self.fit, self.state, parts)
        if not apart.sigmas > MIN_HALF_SIGMAS:
            return None
        count = np.bincount(self.number)
        places = [np.bincount(self.number, values) / count for values in _places(self.observations, self.state)]
        other: FloatArray | BoolArray
        for k, values in enumerate((*places, *other_causes)):
            other = self.scores.split_by(values.astype(np.float64))
            if not other.any():
                continue
            if (other == second).all() or (other != second).all():
                if k >= len(places):
                    continue
                other = (values - values.mean()) / values.std()
            both = self.scores.gain_of_effects(second, other)
            added = both - self.scores.gain_of_effects(second)
            if both - self.scores.gain_of_effects(other) < against**2 * added:
                return None
        return apart


def _solved_apart(observations: Observations, fit: Fit, state: State, parts: Sequence[IntArray]) -> _Difference:
    """Return the lenses of two parts of the views, solved for separately; their difference, in standard deviations, by
    the decrease of the cost: for one lens sigma^2 for each parameter."""
    whole, split, count, cameras = 0.0, 0.0, 0, list[Camera]()
    for chosen in parts:
        part, start = observations.subset(chosen), state.subset(chosen)
        weight = np.where(fit.kept[chosen], part.weight, 0.0)
        own = solve(part, start, weight=weight, prior_sigma_px=fit.sigma_px, cost_tolerance=FROM_OPTIMUM).state
        whole += float(weighted_squares(start, part, weight).sum())
        split += float(weighted_squares(own, part, weight).sum())
        count += 2 * int(fit.kept[chosen].sum()) - 6 * len(chosen)
        cameras.append(own.camera)
    p = state.camera.parameters.size
    variance = split / max(count - 2 * p, 1)
    sigmas = float(np.sqrt(max(whole - split, 0.0) / (p * variance))) if variance > 0.0 else 0.0
    return _Difference((cameras[0], cameras[1]), sigmas)


def moment(order: Sequence[str], some: Collection[str]) -> str:
    """Return in words that `some` of the images in `order` are the first or the last ones; "" if they are neither."""
    for at, words in ((len(some), "before '{}'"), (len(order) - len(some), "from '{}' on")):
        if 0 < at < len(order) and set(order[:at] if words.startswith("before") else order[at:]) == set(some):
            return words.format(order[at])
    return ""


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


def two_cameras(
    calibration: Calibration, number: IntArray, solved: tuple[Observations, Fit] | None = None
) -> Iterator[Finding]:
    """Yield a finding if the images are of two synchronous cameras; `number` (V,) are the `cluster_numbers` of the
    views' images."""
    images = [view.image for view in calibration.views]
    first = dict(zip(number[::-1].tolist(), images[::-1], strict=True))
    if len(first) < 2 * MIN_PARTNERS:
        return
    one = np.array([k for k, image in enumerate(images) if image == first[int(number[k])]])
    number = number[one]
    rotation, centre = calibration.corners.rotation[one], calibration.corners.translation_mm[one]
    boards = np.unique([calibration.views[k].board_id for k in one], return_inverse=True)[1]
    start, end, weight, others = _partners(rotation, centre, boards, number)

    def places(views: IntArray) -> float:
        return float(weight[views[np.unique(number[views], return_index=True)[1]]].sum())

    together = places(np.concatenate([start, end]))
    enough = round(places(start)) >= MIN_PARTNERS and together >= MIN_SHARE_PAIRED * places(np.arange(len(one)))
    chained = places(start[np.isin(number[start], number[end])])
    if enough and chained <= MAX_SHARE_CHAINED * together and others <= MAX_SHARE_OTHER:
        of_one = list(dict.fromkeys(images[k] for k in sorted(one[start].tolist())))
        turned = _about_one_point(rotation[start], centre[start])
        if turned and solved is not None and not _of_two_lenses(*solved, of_one, {images[k] for k in one[end]}):
            return
        yield Finding.bad(
            f"images of two cameras are mixed: the board moves in the same way between '{images[one[start[0]]]}' and "
            f"'{images[one[end[0]]]}' and in {len(of_one) - 1} other pairs of images, as in stereo pairs, of which one "
            f"camera took {listed(of_one)}",
            "calibrate each camera from its own images, or both as a rig with [[cameras]]; leave out images "
            "that a program made from others",
        )


def _about_one_point(rotation: FloatArray, centre: FloatArray) -> bool:
    """Return whether boards with these poses (N, 3, 3) and (N, 3) mm turn about one of their points."""
    rows = np.concatenate([rotation, np.broadcast_to(-np.eye(3), rotation.shape)], axis=2).reshape(-1, 6)
    off = rows @ np.linalg.lstsq(rows, -centre.ravel())[0] + centre.ravel()
    return float(np.sqrt(np.mean(off**2))) < SAME_MOTION * float(np.linalg.norm(centre, axis=1).mean())


def _of_two_lenses(observations: Observations, fit: Fit, first: Collection[str], second: Collection[str]) -> bool:
    """Return whether the lenses of two sets of images differ."""
    parts = [np.flatnonzero(np.isin(observations.images, list(names))) for names in (first, second)]
    return _solved_apart(observations, fit, fit.state.with_boards_held(), parts).sigmas > MIN_HALF_SIGMAS


def _partners(
    rotation: FloatArray, centre: FloatArray, boards: IntArray, number: IntArray
) -> tuple[IntArray, IntArray, FloatArray, float]:
    """Return start and end of the pairs of views with the most common motion of the board, from poses (V, 3, 3) and
    (V, 3) mm; the weight (V,) of each view, one over the number at its place; and the number of pairs with the next
    most common motion, as a part of that with this one."""
    distance = float(np.linalg.norm(centre, axis=1).mean())
    # A pose as four points: the board's origin, and the ends of axes of half the distance.
    frame = 0.5 * distance * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    points = (frame @ np.swapaxes(rotation, -1, -2) + centre[:, None]).reshape(-1, 12)
    reach = SAME_MOTION * distance * 2.0
    weight = 1.0 / _near(points, reach, np.ones(len(points)))
    along = np.lexsort(centre.T)
    starts = along[spread_indices(len(centre), MAX_STARTS)]
    # Displacement of a frame at the boards' mean place by each motion, as products of all ends and starts: coordinates
    # first, then start, end and point.
    typical = frame + centre.mean(axis=0)
    seen_from = (typical - centre[starts, None]) @ rotation[starts]
    moved = np.swapaxes(rotation, 0, 1).reshape(-1, 3) @ seen_from.reshape(-1, 3).T
    moved = moved.reshape(3, len(centre), len(starts), len(frame))
    moved += centre.T[:, :, None, None] - typical.T[:, None, None]
    chosen = (number[:, None] != number[starts]) & (boards[:, None] == boards[starts])
    chosen &= (moved * moved).sum(axis=0).max(axis=-1) > (0.5 * MIN_MOTION * reach) ** 2
    i, j = np.nonzero(chosen.T)
    if not len(i):
        return i, j, weight, 0.0
    moved = np.moveaxis(moved[:, j, i], 0, 1).reshape(-1, 12)
    alike = _near(moved, reach, weight[starts[i]] * weight[j])
    best = np.flatnonzero(np.linalg.norm(moved - moved[int(np.argmax(alike))], axis=1) <= reach)
    # The motion closest to the median of those.
    middle = best[int(np.argmin(np.linalg.norm(moved[best] - np.median(moved[best], axis=0), axis=1)))]
    start, end = starts[i[middle]], j[middle]
    turn = rotation[end] @ rotation[start].T
    back = (typical - centre[end]) @ turn + centre[start] - typical
    off = np.minimum(*(np.linalg.norm(moved - one, axis=1) for one in (moved[middle], back.T.ravel())))
    others = float(alike[off > OTHER_MOTION * reach].max(initial=0.0) / alike.max())
    landed = ((points.reshape(-1, 4, 3) - centre[start]) @ turn.T + centre[end]).reshape(-1, 12)
    # |a - b|^2 - |a|^2, all of them as one product.
    to = ((points**2).sum(axis=1) - 2.0 * landed @ points.T).argmin(axis=1)
    found = np.flatnonzero(((landed - points[to]) ** 2).sum(axis=1) < reach**2)
    found = found[(boards[found] == boards[to[found]]) & (number[found] != number[to[found]])]
    return found, to[found], weight, others


def _near(points: FloatArray, reach: float, weight: FloatArray) -> FloatArray:
    """Return for each of the points (N, 12) the sum of the weights (N,) of those within `reach`, itself included."""
    i, j = close_pairs(points, reach)
    near = np.linalg.norm(points[i] - points[j], axis=1) <= reach
    i, j = np.concatenate([i[near], j[near]]), np.concatenate([j[near], i[near]])
    return np.asarray(weight + np.bincount(i, weight[j], minlength=len(points)))
