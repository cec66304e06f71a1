"""Images of two kinds, from two lenses or two settings of one: turned, cropped, undistorted, of another camera.

Which image is of which kind is estimated from the residuals. Each image gives an amount along the difference between
the two lenses. If there are two kinds, the amounts form two clusters that are far apart compared with their scatter;
other errors of the model (lens, board, motion) scatter them without a gap. So images are the units, not corners. Two
clusters are compared with one by the scatter of the amounts, and with other causes of differences between images: an
error of the lens model, too, differs with the boards' position, distance and tilt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.judging.view_evidence import CHANGE_COLUMNS, COMMON, ViewEvidence, columns_of
from rigkit.calibration.result import Calibration
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.findings import Finding, Severity

MIN_OF_A_KIND, MIN_SHARE_OF_A_KIND = 3, 0.1
"""Smallest number, and part, of images of a kind; fewer are reported one by one."""
OF_UNIFORM = 1.0 + np.log(2.0 * np.pi) - np.log(12.0)
"""Twice the log likelihood ratio, for each image, of a uniform against a normal distribution for uniformly distributed
amounts: a lens that changes gradually is not of two kinds."""
MIN_LEAD = 6.0
"""Difference of the Bayesian information criterion of two kinds to that of one, and of each other cause: strong
evidence (Kass and Raftery, "Bayes factors", J. Am. Stat. Assoc. 90, 1995). For SIMULATED amounts of one kind (normal,
uniform, or Student's) it was -8 with 8 images and -9 with 20 at the least in 400 draws each, 0 to -4 in a hundredth."""
KINDS_REMEDY = (
    "look for another camera, zoom or focus, or images that a program rotated, mirrored, cropped, resized or "
    "undistorted; calibrate each group separately"
)
"""Remedy for images of two kinds."""
SIGMAS_DO_NOT_HOLD = "the stated uncertainties are invalid"
"""Consequence for the result, in messages."""
SIDES_ROUNDS = 8
"""Maximal number of rounds in which images change sides."""
RIDGE_OF_STEP = 1e-9
"""Ridge, as a part of the information, that keeps undetermined directions at zero."""


@dataclass(frozen=True, eq=False, slots=True)
class Kinds:
    """Two kinds of images.

    Attributes
    ----------
    second : (V,) which views are of the second kind.
    amounts, weight : (V,) amount of each view along the difference, 0 for the first kind and 1 for the second on
        average, and its weight.
    step : difference of the second kind's lens, in the units of the rows tested.
    cost : Bayesian information criterion less that of one kind.
    """

    second: BoolArray
    amounts: FloatArray
    weight: FloatArray
    step: FloatArray
    cost: float


def min_of_a_kind(images: int) -> float:
    """Return the smallest number of images of a kind, for so many `images`."""
    return max(MIN_OF_A_KIND, MIN_SHARE_OF_A_KIND * images)


def contradicting_images(verdicts: Sequence[Finding]) -> Finding | None:
    """Return the headline of a calibration whose images contradict each other, without its error; None for others."""
    first = verdicts[0]
    if first.severity is not Severity.BAD or SIGMAS_DO_NOT_HOLD not in first.message:
        return None
    return replace(first, message=first.message.partition(", but ")[2])


def two_kinds(calibration: Calibration, evidence: ViewEvidence) -> Finding | None:
    """Return a finding where the images are of two kinds; None where they are not, or another cause explains it."""
    if len(evidence.views) < 2 * MIN_OF_A_KIND:
        return None
    columns = columns_of(evidence.own.shape[1])
    lenses = {
        "focus": columns["focus"],
        "shift": columns["shift"],
        "lens": columns["lens"],
        "camera": slice(COMMON.start, COMMON.start + len(evidence.scale) - CHANGE_COLUMNS["bend"]),
    }
    known = evidence.common_covariance()
    found = {name: kinds for name, rows in lenses.items() if (kinds := split_in_two(evidence, rows, known)) is not None}
    name = min(found, key=lambda name: found[name].cost, default=None)
    if name is None or (best := found[name]).cost > -MIN_LEAD:
        return None
    if best.cost > _criterion_of_other_causes(calibration, evidence, best) - MIN_LEAD:
        return None
    how = f" (focal lengths {100.0 * abs(best.step[0]):.1f} % apart)" if name in ("focus", "lens") else ""
    views = [calibration.views[k] for k in evidence.views]
    sides = [[v.image for v, of in zip(views, best.second, strict=True) if of == kind] for kind in (False, True)]
    like = " and ".join(f"{len(set(images))} like '{images[0]}'" for images in sides)
    return Finding.bad(
        f"the images form two groups that need different lens parameters: {like}{how}; {SIGMAS_DO_NOT_HOLD}",
        KINDS_REMEDY,
    )


def split_in_two(evidence: ViewEvidence, rows: slice, known: FloatArray) -> Kinds | None:
    """Return the best split of the images into two kinds whose lenses differ in these rows; None if one has too few.
    `known` (C, C) is the `common_covariance` of the evidence.

    From each of several first guesses it alternates (like k-means) between the difference that explains most, and the
    assignment of each image to the kind that explains more.
    """
    own, across, along = evidence.own[:, rows, rows], evidence.own[:, rows, COMMON], evidence.along[:, rows]
    follow = across @ known
    amounts = along / np.maximum(np.diagonal(own, axis1=1, axis2=2), np.finfo(float).tiny)
    second = (amounts > np.median(amounts, axis=0)).T
    for _ in range(SIDES_ROUNDS):
        step, pull = _best_steps(own, across, follow, along, second)
        closer = pull > 0.5 * ((own @ step.T) * step.T).sum(axis=1).T
        if (closer == second).all():
            break
        second = closer
    least = np.minimum(second.sum(axis=1), (~second).sum(axis=1))
    enough = least >= min_of_a_kind(len(own))
    if not enough.any():
        return None
    step, pull = _best_steps(own, across, follow, along, second)
    gain = np.einsum("sk,sk->s", step, second.astype(np.float64) @ along)
    best = int(np.argmax(np.where(enough, gain, -np.inf)))
    information = np.maximum(np.einsum("k,vkl,l->v", step[best], own, step[best]), np.finfo(float).tiny)
    # Weights saturate: the amounts of images with much information scatter by errors of the model.
    weight = information / (information + np.median(information))
    amount, chosen = pull[best] / information, second[best]
    cost = split_entropy(chosen) + len(step[best]) * np.log(len(chosen)) + OF_UNIFORM * len(chosen)
    cost += _explained(amount, weight, chosen[None].astype(float))[0]
    return Kinds(chosen, amount, weight, step[best], float(cost))


def split_entropy(second: BoolArray) -> float:
    """Return twice the entropy of a split into two kinds that both occur (V,), which is added to an information
    criterion: the kind of each image is estimated from the same residuals."""
    part = float(second.mean())
    return float(-2.0 * len(second) * (part * np.log(part) + (1.0 - part) * np.log1p(-part)))


def _best_steps(
    own: FloatArray, across: FloatArray, follow: FloatArray, along: FloatArray, second: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return for each guess (S, V) of the images of the second kind the difference (S, K) of its lens that explains
    most, and the score of each image along it (S, V), with everything common to all images eliminated."""
    sides = second.astype(np.float64)
    shared, followed = np.tensordot(sides, across, axes=1), np.tensordot(sides, follow, axes=1)
    information = np.tensordot(sides, own, axes=1) - shared @ np.swapaxes(followed, 1, 2)
    size = np.maximum(np.diagonal(information, axis1=1, axis2=2), np.finfo(float).tiny)
    information = information + RIDGE_OF_STEP * size[:, :, None] * np.eye(own.shape[1])
    step = np.linalg.solve(information, (sides @ along)[..., None])[..., 0]
    common = (np.swapaxes(followed, 1, 2) @ step[..., None])[..., 0]
    pull = along @ step.T + ((np.swapaxes(across, 1, 2) @ step.T) * common.T).sum(axis=1)
    return np.asarray(step), np.asarray(pull.T)


def _explained(amount: FloatArray, weight: FloatArray, causes: FloatArray) -> FloatArray:
    """Return the change of the deviance of the amounts (V,) by a linear regression on each of the causes (C, V): the
    degrees of freedom times the logarithm of the part of the squares that it leaves."""
    mean = amount - np.average(amount, weights=weight)
    centred = causes - (causes @ weight / weight.sum())[:, None]
    along = (centred * weight) @ mean
    squares = np.maximum((centred**2) @ weight, np.finfo(float).tiny)
    left = 1.0 - along**2 / squares / max(float(weight @ mean**2), np.finfo(float).tiny)
    return np.asarray((len(amount) - 2) * np.log(np.maximum(left, np.finfo(float).eps)))


def _criterion_of_other_causes(calibration: Calibration, evidence: ViewEvidence, kinds: Kinds) -> float:
    """Return the information criterion of the best other cause of the amounts: position, distance and tilt of the
    boards, and which board it was; each as a linear function or as a step."""
    at = np.array(evidence.views)
    corners = calibration.corners
    middle = np.array([calibration.views[k].pixels.mean(axis=0) for k in at])
    off = middle - middle.mean(axis=0)
    shift = corners.translation_mm[at]
    boards = np.unique([calibration.views[k].board_id for k in at], return_inverse=True)[1]
    places = np.stack(
        [*off.T, np.hypot(*off.T), np.linalg.norm(shift, axis=1), *corners.rotation[at, :2, 2].T, boards.astype(float)]
    )
    # Steps only between different values: with one board they would follow the order of the images.
    steps = places[:, None] >= np.sort(places, axis=1)[:, 1:, None]
    line = _explained(kinds.amounts, kinds.weight, places).min() + np.log(len(at))
    step = _explained(kinds.amounts, kinds.weight, steps.reshape(-1, len(at)).astype(float)).min()
    return float(min(line, step + 2.0 * np.log(len(at))))
