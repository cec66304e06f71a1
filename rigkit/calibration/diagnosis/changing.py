"""Changes between images: focus, image stabilisation, rolling shutter, a board that bends.

The model has one lens and one board for all images. For each kind of change, the residuals of every image (after its
pose) are regressed on it: another focal length, a shift of the image, a motion during readout, another bend of the
board. An error of the lens or board model that is common to all images explains a little of each kind; a real change
explains far more by one kind than by all others.

A focal length that drifts over a session (a zoom or focus that is turned little by little, a lens that warms up) is a
trend over time of these amounts. An error of the model gives amounts that differ with the board's distance, place and
tilt: the trend is tested beside these.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from rigkit.calibration.assemble import with_solution
from rigkit.calibration.diagnosis.flipped import flipped_images
from rigkit.calibration.diagnosis.view_evidence import (
    NO_CHANGE,
    ViewChange,
    ViewEvidence,
    columns_of,
    predicted_by_others,
    view_evidence,
)
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.solver import solve
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import image_center
from rigkit.core.findings import Finding

MIN_VARIANCE_RATIO = 6.0
"""Variance explained by a kind of change, for each degree of freedom, over that of the rest."""
MIN_SHARE_EXPLAINED = 0.5
"""Part of the sum of squares that it must explain; less may be a side effect of another cause. A board held by hand in
front of two cameras is bent according to the residuals of one, sheared according to the other, a third each."""
MIN_RATIO_TO_OTHERS = 3.0
"""Variance ratio, over the largest one of the other kinds, from which it may explain less: an error of the lens or
board model explains about as much by every kind, for each degree of freedom."""
MIN_NEIGHBOUR_CORRELATION = 0.1
"""All kinds of change are smooth over a board: if one explains half of the squares, the residuals of neighbouring
corners have a correlation of 0.25 and more. That of noise is 0, slightly less after fitting a pose."""
MIN_LEAD_OF_CRITERION = 10.0
"""Difference of its Bayesian information criterion to that of no change and of every other kind: very strong evidence
(Kass and Raftery, "Bayes factors", J. Am. Stat. Assoc. 90, 1995)."""
MIN_LEAD_OF_GAIN = 0.1
"""The same as a part of the difference to no change: kinds that explain the images almost equally well cannot be
distinguished, however many corners there are."""


MAX_LEFT_OF_CONTROL = 0.85
"""Sum of squares that a motion over rows leaves, over that left by a motion over columns (the control): both explain
about half of any error of the lens or board model, also in captures without motion."""
MIN_SHARE_TRIED = 0.2
"""A change of the lens that explains this much at first order is solved for in every image."""
LENS_ROUNDS, LENS_TOLERANCE = 2, 1e-6
"""The effect of a focal length that differs by a hundredth is not linear: two rounds are needed."""


NOT_AS_ITS_MODEL = Finding.look(
    "the lens is not as its model: one smooth distortion, the same in all images",
    "calibrate without a window, dome or mirror before the lens; a lens that is tilted or not round itself remains "
    "uncertain by what no model describes, which its sigmas include",
)
"""What is wrong in all images alike looks like a change of each: windows and tilted lenses, like motion with a rolling
shutter. But a change is not predicted by other images."""
CHANGES = {
    "focus": Finding.look(
        "the focal length differs from image to image",
        "switch autofocus and zoom off (fix the focus with a screw or tape), and retake all images",
    ),
    "lens": Finding.look(
        "focal length and principal point differ from image to image (focus, zoom, stabilisation, cropping, or images "
        "of another camera)",
        "switch autofocus, zoom and image stabilisation off, and retake all images, unless some are another camera's, "
        "or a program cropped, rotated or resized some",
    ),
    "shift": Finding.look(
        # After its pose a board determines two parameters of the image's change at first order: those of a shear.
        "the principal point differs from image to image (stabilisation, cropping, or images of another camera), or "
        "images are sheared by a rolling shutter",
        "switch image stabilisation off, hold camera and board still, and retake all images, unless some are another "
        "camera's, or a program rotated or cropped some",
    ),
    "rows": Finding.look(
        "boards are sheared as by motion with a rolling shutter",
        "fix camera and board (tripod) for each image",
    ),
    "bend": Finding.look(
        "the board bends differently in every image", "glue it to something stiff, and retake all images"
    ),
}
"""Finding for each kind of change of `ViewEvidence.changes` ("lens" is focus and shift)."""

OF_LENS = ("focus", "shift", "lens")
"""The last is both of the others, for a zoom about another centre than that of the lens."""
MOTION = ("rows", NO_CHANGE)
MOVED = replace(CHANGES["rows"], message="the board or the camera moved while the image was read out (rolling shutter)")
"""After the pose, motions over rows and over columns are hard to distinguish. Where rows are best, and both explain
nearly everything, far better than all else, it is a motion, unless a bend of each board explains most of it, too: that
is an error of the lens or board model."""
MIN_SHARE_MOVED = 0.9
"""Part of the squares that a motion explains in that case: 0.97 and more where SIMULATED boards in hand move by
pixels."""
CHANCE_OF_DRIFT = 0.001
"""Largest p-value of the trend."""
MIN_FOCUS_RATIO = 6.0
"""Variance that the focal lengths of single images explain, for each degree of freedom, over that of the rest."""
MIN_IMAGES_OF_TREND = 10


def changing(
    calibration: Calibration, solved: tuple[Observations, Fit] | None = None, but: Collection[str] = ()
) -> list[Finding]:
    """Return a finding where something changes between images that the calibration assumes constant, unless it is in
    `but`. With `solved`, observations and fit of the calibration, a change of the lens is solved for, not only tested
    at first order."""
    smooth = calibration.corners.neighbour_correlation > MIN_NEIGHBOUR_CORRELATION
    evidence = view_evidence(calibration) if smooth else None
    changes = dict(evidence.changes) if evidence is not None else {}
    if evidence is None or not changes:
        return []
    if solved is not None:
        shifted = changes["shift"].ratio >= MIN_VARIANCE_RATIO
        flipped = flipped_images(calibration, evidence, *solved, shifted=shifted)
        if flipped is not None:
            return [flipped]
    if not but and (drift := drifting(calibration, evidence)):
        return [drift]
    if solved is not None and changes["lens"].ratio >= MIN_VARIANCE_RATIO and changes["lens"].share >= MIN_SHARE_TRIED:
        changes |= {kind: _solved_for(kind, evidence, calibration, *solved, changes[kind]) for kind in OF_LENS}
    best = min(changes, key=lambda kind: changes[kind].criterion)
    if best in OF_LENS and _leads(changes, best, but=OF_LENS):
        # A zoom about another centre is both; if one of them explains nearly as much, it is that one.
        alone = [kind for kind in OF_LENS[:2] if _leads(changes, kind, but=("lens",))]
        found = CHANGES[alone[0] if alone else best]
    elif best == "rows" and changes["rows"].left <= MAX_LEFT_OF_CONTROL * changes[NO_CHANGE].left:
        if _leads(changes, best):
            found = CHANGES[best]
        elif (
            all(_leads(changes, kind, but=MOTION) and changes[kind].share >= MIN_SHARE_MOVED for kind in MOTION)
            and changes["bend"].share < MIN_SHARE_EXPLAINED
        ):
            found = MOVED
        else:
            return []
    elif best == "bend" and _leads(changes, best):
        found = CHANGES[best]
    else:
        return []
    if best in but:
        return []
    if common := not_as_its_model(calibration, evidence):
        return common
    message = f"{found.message}: explains {100.0 * changes[best].share:.0f} % of the sum of squared residuals"
    return [replace(found, message=message)]


def not_as_its_model(calibration: Calibration, evidence: ViewEvidence | None) -> list[Finding]:
    """Return a finding where one distortion of all images predicts most of the residuals of each."""
    share = predicted_by_others(calibration, evidence) if evidence is not None else 0.0
    if share < MIN_SHARE_EXPLAINED:
        return []
    message = f"{NOT_AS_ITS_MODEL.message}, predicts {100.0 * share:.0f} % of the squared residuals of images left out"
    return [replace(NOT_AS_ITS_MODEL, message=message)]


def _leads(changes: Mapping[str, ViewChange], kind: str, but: Collection[str] = ()) -> bool:
    """Return whether a kind of change explains most of the residuals, far better than all others except `but`."""
    found = changes[kind]
    others = [change for name, change in changes.items() if name != kind and name not in but]
    lead = max(MIN_LEAD_OF_CRITERION, -MIN_LEAD_OF_GAIN * found.criterion)
    return (
        found.ratio >= MIN_VARIANCE_RATIO
        and (
            found.share >= MIN_SHARE_EXPLAINED
            or (
                found.share >= MIN_SHARE_TRIED
                and found.ratio >= MIN_RATIO_TO_OTHERS * max(other.ratio for other in others)
            )
        )
        and min(0.0, *(other.criterion for other in others)) - found.criterion >= lead
    )


def _solved_for(
    kind: str,
    evidence: ViewEvidence,
    calibration: Calibration,
    observations: Observations,
    fit: Fit,
    at_first: ViewChange,
) -> ViewChange:
    """Return what a change of the lens explains when everything is solved with it, or `at_first` (order) if that is
    more."""
    weight, start, residuals, left = fit.weight(observations), fit.state, fit.residuals, at_first.left
    before = ((fit.residuals.px**2).sum(axis=-1) * weight**2).sum(axis=1)
    freedom, columns = evidence.freedom, columns_of(evidence.own.shape[1])[kind]
    _, directions, amounts = evidence.explained(columns)
    for rounds in range(LENS_ROUNDS):
        if rounds:
            now = evidence.again(with_solution(calibration, observations, start, residuals, fit.kept))
            if now is None:
                return at_first
            evidence, (_, _, amounts) = now, now.explained(columns)
        views = evidence.views
        zoom = amounts[:, 0] if kind != "shift" else np.zeros(len(views))
        shift = amounts[:, -2:] if kind != "focus" else np.zeros((len(views), 2))
        centre = start.camera.axis_px
        pixels = observations.pixels.copy()
        pixels[views] -= zoom[:, None, None] * (pixels[views] - centre) + shift[:, None]
        observations = replace(observations, pixels=pixels)
        solution = solve(observations, start, weight=weight, prior_sigma_px=fit.sigma_px, cost_tolerance=LENS_TOLERANCE)
        start, residuals = solution.state, solution.data.residuals[0]
        squares = ((residuals.px**2).sum(axis=-1) * weight**2).sum(axis=1)
        left = min(left, float(squares.sum() / before.sum()))
    return ViewChange.of(left, freedom, directions) if left < at_first.left else at_first


def drifting(calibration: Calibration, evidence: ViewEvidence) -> Finding | None:
    """Return a finding where the focal length changes with the order of the images."""
    # Imported here: scipy is slow to import, and most calibrations need no test.
    from scipy.special import stdtr

    columns = columns_of(evidence.own.shape[1])["focus"]
    if evidence.changes["focus"].ratio < MIN_FOCUS_RATIO:
        return None
    views = [calibration.views[k] for k in evidence.views]
    amounts = evidence.explained(columns)[2][:, 0]
    images = {name: k for k, name in enumerate(dict.fromkeys(view.image for view in calibration.views))}
    shown, number = np.unique([images[view.image] for view in views], return_inverse=True)
    freedom = len(shown) - 5
    if len(shown) < MIN_IMAGES_OF_TREND:
        return None
    centre = image_center(calibration.camera.size_px)
    places = np.array(
        [
            (
                np.linalg.norm(view.pixels.mean(axis=0) - centre),
                np.linalg.norm(view.cam_from_board.translation_mm),
                view.cam_from_board.rotation[2, 2],
            )
            for view in views
        ]
    )
    rows = np.column_stack([np.ones(len(views)), shown[number] / (len(images) - 1.0), places, amounts])
    each = np.stack([np.bincount(number, column) for column in rows.T], axis=1) / np.bincount(number)[:, None]
    system, amount = each[:, :-1], each[:, -1]
    system[:, 2:] /= np.maximum(np.abs(system[:, 2:]).max(axis=0), np.finfo(float).tiny)
    step, _, rank, _ = np.linalg.lstsq(system, amount, rcond=None)
    if rank < system.shape[1]:
        return None
    variance = float(((amount - system @ step) ** 2).sum()) / freedom
    sigma = float(np.sqrt(variance * np.linalg.inv(system.T @ system)[1, 1]))
    chance = 2.0 * float(stdtr(freedom, -abs(step[1]) / max(sigma, np.finfo(float).tiny)))
    if chance > CHANCE_OF_DRIFT:
        return None
    return Finding.bad(
        f"the focal length drifts over the session, by {100.0 * abs(step[1]):.1f} % from the first image to the last "
        f"(p = {chance:.1g}): zoom, focus or temperature; the stated uncertainties are invalid",
        "fix zoom and focus, let the camera warm up, and retake all images",
    )
