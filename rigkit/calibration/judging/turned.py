"""Images of one camera of which some were turned by half a turn, as viewers do that follow a tag of the file.

A turned picture is one of the same lens whose principal point lies on the other side of its middle. No number is free
but which ones were turned: so nobody need see two clusters of principal points, which few images, or boards that are
tilted the other way once they are turned, do not show surely.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.assemble import board_shapes, view_results
from rigkit.calibration.choosing.board_orientation import with_views_turned
from rigkit.calibration.judging.two_kinds import MIN_LEAD, split_in_two
from rigkit.calibration.judging.view_evidence import ViewEvidence, columns_of, view_evidence
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.normal_equations import Residuals
from rigkit.calibration.solving.solver import solve
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray, IntArray
from rigkit.core.findings import Finding

TOLERANCE = 1e-4
"""Relative to the cost: turned back, the squares of the residuals fall by a factor, if that was the cause."""
MAX_STILL_SHIFTED = 0.2
"""What a shifted picture explains once pictures are turned back is less than this part of what turning them explains.
Shifts anywhere between two ends, cut in two, leave a third, normal ones more than half; REAL sessions of which half
was turned leave 0.003 to 0.1."""
ROUNDS = 3
"""Images change sides in so many rounds at most."""


@dataclass(frozen=True, eq=False, slots=True)
class _Back:
    """Observations whose pictures of the views `at` (V,) are turned back, what they are solved to, and the sum of the
    squared residuals."""

    at: BoolArray
    observations: Observations
    state: State
    residuals: Residuals
    squares: float


def turned_pictures(
    calibration: Calibration,
    evidence: ViewEvidence,
    observations: Observations,
    fit: Fit,
    clusters: IntArray | None = None,
) -> Finding | None:
    """Return a finding where some of the pictures were turned by half a turn; None where that is no cause.

    `clusters` are as for `view_evidence`, whose `evidence` is of the calibration as it is.
    """
    shift = columns_of(evidence.own.shape[1])["shift"]
    kinds = split_in_two(evidence, shift, evidence.common_covariance())
    before = float((fit.weight(observations) ** 2 * (fit.residuals.px**2).sum(axis=-1)).sum())
    if kinds is None or not before > 0.0:
        return None
    at = np.zeros(len(observations.views), dtype=bool)
    at[np.array(evidence.views)[kinds.second]] = True
    for _ in range(ROUNDS):
        back = _turned_back(observations, fit, at)
        solved = replace(
            calibration.with_near(back.state.camera),
            views=view_results(back.observations, back.state, back.residuals, fit.kept),
            boards=board_shapes(back.observations, back.state.shape, back.state.unknowns),
        )
        now = view_evidence(solved, clusters)
        if now is None:
            return None
        evidence = now
        # A picture on the wrong side has its principal point where the turned one has it.
        off = np.array(calibration.camera.size_px) - 1.0 - 2.0 * back.state.camera.axis_px
        wrong = evidence.along[:, shift] @ off > 0.5 * (evidence.own[:, shift, shift] @ off) @ off
        if not wrong.any():
            break
        at[np.array(evidence.views)[wrong]] ^= True
    return _judged(back, before, evidence)


def _judged(back: _Back, before: float, evidence: ViewEvidence) -> Finding | None:
    """Return the finding, where turning pictures back explains the residuals, and nothing like it is left in them."""
    at, changes = back.at, evidence.changes()
    left, part = max(back.squares / before, np.finfo(float).eps), float(at.mean())
    if not 0.0 < part < 1.0 or not changes:
        return None
    # Which pictures were turned is known from the residuals alone, and costs its entropy.
    entropy = -2.0 * len(at) * (part * np.log(part) + (1.0 - part) * np.log1p(-part))
    # Corners of an image err together; each image says two numbers of where its principal point lies.
    if 2.0 * len(at) * np.log(left) + entropy > -MIN_LEAD:
        return None
    # A picture that moves on the sensor by any way moves on, whatever was turned.
    if left * max(changes[way].share for way in ("shift", "lens")) > MAX_STILL_SHIFTED * (1.0 - left):
        return None
    names = [view.image for view in back.observations.views]
    turned = list(dict.fromkeys(name for name, of in zip(names, at, strict=True) if of == (part <= 0.5)))
    return Finding.bad(
        f"{len(turned)} of {len(set(names))} images are turned by half a turn, like '{turned[0]}', or all but these: "
        f"turned back they are of one lens, and {100.0 * (1.0 - left):.0f} % of the squares of all residuals are gone",
        "take them as the camera wrote them, and calibrate again",
    )


def _turned_back(observations: Observations, fit: Fit, at: BoolArray) -> _Back:
    """Return what is found with the pictures of the views `at` (V,) turned back: the better of two where a board looks
    the same turned, and may be counted from either end."""
    state, pixels = fit.state, observations.pixels.copy()
    pixels[at] = np.array(state.camera.size_px) - 1.0 - pixels[at]
    half = np.where(at[:, None], [-1.0, -1.0, 1.0], 1.0)
    views = tuple(
        replace(view, pixels=np.array(state.camera.size_px) - 1.0 - view.pixels) if of else view
        for view, of in zip(observations.views, at, strict=True)
    )
    back = replace(observations, pixels=pixels, views=views)
    start = replace(state, rotation=half[:, :, None] * state.rotation, translation_mm=half * state.translation_mm)
    same = at & np.array([2 in view.board.turns for view in views])
    weight, found = fit.weight(observations), []
    for trial, begun in [(back, start), *([with_views_turned(back, start, same, 2)] if same.any() else [])]:
        solution = solve(trial, begun, weight=weight, prior_sigma_px=fit.sigma_px, cost_tolerance=TOLERANCE)
        residuals = solution.data.residuals[0]
        squares = float((weight**2 * (residuals.px**2).sum(axis=-1)).sum())
        found.append(_Back(at.copy(), trial, solution.state, residuals, squares))
    return min(found, key=lambda one: one.squares)
