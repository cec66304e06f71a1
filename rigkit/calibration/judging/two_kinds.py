"""Images of two kinds, through two lenses or at two settings of one: turned, cropped, undistorted, of another camera.

Nothing says which image is of which kind; the residuals do. Each image has an amount by which its lens lies on the way
from the one kind to the other, and where there are two kinds those amounts lie at two places, far apart against their
scatter. What else is not as the model says, a lens, a board, a motion, scatters them without a gap. So the unit that
counts is the image, not the corner. Two places are held against one by the scatter of the amounts, and against what
else tells the images apart: a lens unlike its model differs between boards here and there, near and far, tilted this
way and that, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.judging.view_evidence import CHANGE_COLUMNS, COMMON, ViewEvidence, columns_of
from rigkit.calibration.result import Calibration
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.findings import Finding

MIN_OF_A_KIND, MIN_SHARE_OF_A_KIND = 3, 0.1
"""Fewer images that are unlike the others are named one by one."""
OF_UNIFORM = 1.0 + np.log(2.0 * np.pi) - np.log(12.0)
"""By so much for each image amounts that lie anywhere between two ends are likelier evenly spread than normal (twice
the logarithm): a lens that changes little by little is not of two kinds."""
MIN_LEAD = 6.0
"""By so much the Bayesian information criterion of two kinds is below that of one, and of each other cause: strong
evidence (Kass and Raftery, "Bayes factors", J. Am. Stat. Assoc. 90, 1995). Of amounts drawn normal, evenly or with
Student's tails, one kind has shown -8 at 8 images and -9 at 20 in 400 draws each, in a hundredth of them 0 to -4."""
KINDS_REMEDY = (
    "look for another camera, another zoom or focus, or images that a program has turned, mirrored, cropped, resized "
    "or undistorted, and calibrate each kind from its own images"
)
"""What to do about images of two kinds."""
SIGMAS_DO_NOT_HOLD = "the uncertainties that are stated do not hold"
"""What follows for everything that was calculated."""
SIDES_ROUNDS = 8
"""Images change sides in so many rounds at most."""
RIDGE_OF_STEP = 1e-9
"""Part of its own (or all) information that keeps what the images leave open at rest."""


@dataclass(frozen=True, eq=False, slots=True)
class Kinds:
    """Two kinds of images.

    Attributes
    ----------
    second : which views (V,) are of the second kind.
    amounts, weight : (V,) how far each lies on the way to it, 0 and 1 on average, and what it counts.
    step : by how much the second kind's lens differs, in the units of the rows it was looked for among.
    cost : Bayesian information criterion less that of one kind.
    """

    second: BoolArray
    amounts: FloatArray
    weight: FloatArray
    step: FloatArray
    cost: float


def min_of_a_kind(images: int) -> float:
    """Return how many of the images a kind has at least."""
    return max(MIN_OF_A_KIND, MIN_SHARE_OF_A_KIND * images)


def two_kinds(calibration: Calibration, evidence: ViewEvidence) -> Finding | None:
    """Return a finding where the images are of two kinds; None where they are not, or where it may be something else
    by which they differ."""
    if len(evidence.views) < 2 * MIN_OF_A_KIND:
        return None
    columns = columns_of(evidence.own.shape[1])
    lenses = {
        "focus": columns["focus"],
        "shift": columns["shift"],
        "lens": columns["lens"],
        "camera": _camera_rows(evidence),
    }
    known = evidence.common_covariance()
    found = {name: kinds for name, rows in lenses.items() if (kinds := split_in_two(evidence, rows, known)) is not None}
    name = min(found, key=lambda name: found[name].cost, default=None)
    if name is None or (best := found[name]).cost > -MIN_LEAD:
        return None
    if best.cost > _otherwise(calibration, evidence, best) - MIN_LEAD:
        return None
    how = f" (focal lengths {100.0 * abs(best.step[0]):.1f} % apart)" if name in ("focus", "lens") else ""
    views = [calibration.views[k] for k in evidence.views]
    sides = [[v.image for v, of in zip(views, best.second, strict=True) if of == kind] for kind in (False, True)]
    like = " and ".join(f"{len(set(images))} like '{images[0]}'" for images in sides)
    return Finding.bad(
        f"the images are of two kinds, as if two lenses had taken them, or one at two settings: {like}{how}; "
        f"{SIGMAS_DO_NOT_HOLD}",
        KINDS_REMEDY,
    )


def split_in_two(evidence: ViewEvidence, rows: slice, known: FloatArray) -> Kinds | None:
    """Return the two kinds of images whose lenses differ in these rows; None where there are no two. `known` (C, C) is
    how well what is common to all images is known.

    In turn, from each of several first guesses: the difference that explains most, and each image to the side that
    explains more of it.
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
    # What an image does not know it does not say; those that know much scatter by the misfit of the model all the same.
    weight = information / (information + np.median(information))
    amount, chosen = pull[best] / information, second[best]
    part = float(chosen.mean())
    # Whichever kind each image is of is known from the residuals alone, and costs its entropy.
    entropy = -2.0 * len(chosen) * (part * np.log(part) + (1.0 - part) * np.log1p(-part))
    cost = entropy + len(step[best]) * np.log(len(chosen)) + OF_UNIFORM * len(chosen)
    cost += _explained(amount, weight, chosen[None].astype(float))[0]
    return Kinds(chosen, amount, weight, step[best], float(cost))


def _best_steps(
    own: FloatArray, across: FloatArray, follow: FloatArray, along: FloatArray, second: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return for each guess (S, V) of which images are of the second kind the difference (S, K) of its lens that
    explains most, and how much each image's residuals lie along it (S, V), all that is common following."""
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
    """Return what each of the causes (C, V) takes off the deviance of the amounts (V,), as a line of its own: the
    degrees of freedom left times the logarithm of what it leaves of their squares."""
    mean = amount - np.average(amount, weights=weight)
    centred = causes - (causes @ weight / weight.sum())[:, None]
    along = (centred * weight) @ mean
    squares = np.maximum((centred**2) @ weight, np.finfo(float).tiny)
    left = 1.0 - along**2 / squares / max(float(weight @ mean**2), np.finfo(float).tiny)
    return np.asarray((len(amount) - 2) * np.log(np.maximum(left, np.finfo(float).eps)))


def _otherwise(calibration: Calibration, evidence: ViewEvidence, kinds: Kinds) -> float:
    """Return the criterion of the best other cause of the amounts: where the boards were, how far away, how tilted,
    which board it was; a line along it, or a step between two sides of it."""
    at = np.array(evidence.views)
    corners = calibration.corners
    middle = np.array([calibration.views[k].pixels.mean(axis=0) for k in at])
    off = middle - middle.mean(axis=0)
    shift = corners.translation_mm[at]
    boards = np.unique([calibration.views[k].board_id for k in at], return_inverse=True)[1]
    places = np.stack(
        [*off.T, np.hypot(*off.T), np.linalg.norm(shift, axis=1), *corners.rotation[at, :2, 2].T, boards.astype(float)]
    )
    # Between values that differ: where all images show one board, no step is the order of the images.
    steps = places[:, None] >= np.sort(places, axis=1)[:, 1:, None]
    line = _explained(kinds.amounts, kinds.weight, places).min() + np.log(len(at))
    step = _explained(kinds.amounts, kinds.weight, steps.reshape(-1, len(at)).astype(float)).min()
    return float(min(line, step + 2.0 * np.log(len(at))))


def _camera_rows(evidence: ViewEvidence) -> slice:
    """Return where the camera's parameters are among the rows of the evidence."""
    return slice(COMMON.start, COMMON.start + len(evidence.scale) - CHANGE_COLUMNS["bend"])
