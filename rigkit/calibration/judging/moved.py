"""Whether the lens stayed as it was while the images were taken: the first half of them against the second.

A board that is not what the model says sets halves apart too, wherever they show it in different ways. So the halves in
time are compared with halves by place: boards left and right, near and far, tilted this way and that. Only what time
tells apart more clearly than any of those is a lens that moved. The same holds for images whose names are of two kinds.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.solver import FROM_OPTIMUM, solve
from rigkit.calibration.solving.state import State, weighted_squares
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.findings import Finding

MIN_IMAGES_FOR_HALVES = 10
MIN_HALF_SIGMAS = 3.0
"""Halves this far apart (root of the mean squared distance of the parameters, in standard deviations) may be two
lenses. Halves of one and the same are 1 apart, at most 2."""
AGAINST_PLACE = 1.4
"""They are, if no other way to halve the images sets them apart by more than a part of this. Measured: at most 1.2 for
one lens with flat, bent and wavy boards, 1.5 and more for 2 % of focal length."""
DIGITS = re.compile(r"\d+")


def moved_lens(observations: Observations, fit: Fit) -> tuple[Finding, ...]:
    """Return a verdict if the two halves of the images, in the order given, have different intrinsics, or those whose
    names are alike and the others."""
    images = list(dict.fromkeys(observations.images))
    if len(images) < MIN_IMAGES_FOR_HALVES:
        return ()
    place = {name: i for i, name in enumerate(images)}
    number = np.array([place[name] for name in observations.images])
    # The shape of the boards stays as it was found: two shapes are not two lenses.
    state = fit.state.with_boards_held()
    later = np.arange(len(images)) >= len(images) // 2
    named = _named_alike(images)
    if named is not None and not (named == later).all() and not (named != later).all():
        distance = _surely_apart(observations, fit, state, number, named)
        if distance is not None:
            other, one = images[int(np.argmax(named))], images[int(np.argmin(named))]
            message = (
                f"two cameras are mixed in these images: those called like '{one}' and those called like '{other}' are "
                f"of different lenses ({distance:.0f} standard deviations)"
            )
            return (Finding.bad(message, "calibrate each camera from its own images"),)
    distance = _surely_apart(observations, fit, state, number, later)
    if distance is None:
        return ()
    message = (
        "the lens (or the board) was another one in the second half of the images, from "
        f"'{images[len(images) // 2]}' on ({distance:.0f} standard deviations): another camera, or focus, zoom or "
        "mount moved"
    )
    return (Finding.bad(message, "calibrate the halves apart, or retake all"),)


def _named_alike(images: Sequence[str]) -> BoolArray | None:
    """Return which images (N,) have names other than the first one's but for their digits, of two kinds of names with
    a fair number each; None where there are no two such kinds."""
    kinds = [DIGITS.sub("", name) for name in images]
    if len(set(kinds)) != 2:
        return None
    other = np.array([kind != kinds[0] for kind in kinds])
    return other if 2 * min(other.sum(), (~other).sum()) >= MIN_IMAGES_FOR_HALVES else None


def _surely_apart(
    observations: Observations, fit: Fit, state: State, number: IntArray, second: BoolArray
) -> float | None:
    """Return by how many standard deviations the lenses of the images (N,) that are `second` and of the others differ,
    if by more than those of halves by place; `number` is that of the image of each view (V,)."""
    distance = _apart(observations, fit, state, second[number])
    if not distance > MIN_HALF_SIGMAS:
        return None
    for values in (*_places(observations, state), number % 2):
        of_image = np.bincount(number, values) / np.bincount(number)
        half = np.argsort(np.argsort(of_image)) >= len(second) // 2
        if (half == second).all() or (half != second).all():
            continue
        if distance < AGAINST_PLACE * _apart(observations, fit, state, half[number]):
            return None
    return distance


def _places(observations: Observations, state: State) -> FloatArray:
    """Return in what ways views differ but in time, (K, V): where in the image, how far from its middle, how far away,
    how tilted."""
    present = observations.present[..., None]
    count = np.maximum(present.sum(axis=1), 1)
    pixels = (observations.pixels * present).sum(axis=1) / count
    points = (state.points_in_cam(observations)[0] * present).sum(axis=1) / count
    off = np.linalg.norm(pixels - pixels.mean(axis=0), axis=1)
    return np.stack([*pixels.T, off, np.linalg.norm(points, axis=1), *state.rotation[:, :2, 2].T])


def _apart(observations: Observations, fit: Fit, state: State, second: BoolArray) -> float:
    """Return how far apart the intrinsics of the two sets of views are: by how much the cost falls when each has its
    own, which for one and the same lens is sigma^2 a parameter."""
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
