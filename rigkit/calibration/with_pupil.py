"""A camera calibrated again with its entrance pupil as two more unknowns, where the images ask for it.

The central camera is calibrated first. Where its residuals say that the lens does not look from one point (`pupil` in
`judging`), sizes of the same model and shapes of the boards are fitted anew, lens, pupil, poses and boards together,
and chosen as before. The pupil stays where both tell of it: it lowers the error on images that took no part by as much
as two more numbers of a lens must, and the images agree on it far beyond their scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.choosing.choice import MIN_SIGMAS, FittedModel, choose, described
from rigkit.calibration.choosing.models_tried import Request, compared, enough_agree, reweighted
from rigkit.calibration.choosing.one_model import ModelOutcome, chosen_of_sizes, on_same_images
from rigkit.calibration.judging.pupil import BY_CHANCE
from rigkit.calibration.result import Calibration, Candidate
from rigkit.calibration.solving.fit import fit_kept, fit_other_lens, identifiable, posed, robust_sigma
from rigkit.calibration.solving.outliers import inliers
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.moving_pupil import NearCamera, far_camera
from rigkit.core.arrays import BoolArray
from rigkit.core.errors import DegenerateError, InputError

PUPILS = ("auto", "central", "moving")
"""What may be asked for: a pupil where images tell of one; none; one."""
CENTRAL, MOVING = "one point of view", "moving pupil"
"""Names of the candidates."""


def solved_with_pupil(found: ModelOutcome, everything: Observations, request: Request) -> ModelOutcome | None:
    """Return what a camera comes to with a pupil that moves, its model's sizes and the boards' shape chosen again; None
    where the images do not tell it from the rest. Of `everything` that was seen, views that the central lens left out
    and that agree with this one are taken back."""
    start = found.chosen.fit
    options = _with_every_size(found, start.state, start.kept)
    if options and (more := _taken_back(found, everything, options)) is not None:
        found, poses, kept = more
        options = _with_every_size(found, poses, kept)
        if options:
            found = replace(found, observations=reweighted(found.observations, options))
    if not options:
        return None
    sizes = compared(found.observations, options, request.folds, request.progress)
    return chosen_of_sizes(found.observations, sizes, request, used=found.used, reasons=found.reasons)


def _with_every_size(found: ModelOutcome, poses: State, kept: BoolArray) -> list[FittedModel]:
    """Return every size of the model with a pupil that moves, fitted to the corners `kept` of flat boards."""
    observations, options = found.observations, []
    for size in found.sizes:
        lens = NearCamera.of(far_camera(size.fit.state.camera))
        start = State.start(lens, poses.rotation, poses.translation_mm, observations)
        try:
            fit = fit_kept(observations, fit_other_lens(observations, start, kept).state, kept, settle=True)
        except (InputError, DegenerateError):
            continue
        if identifiable(fit):
            options.append(FittedModel(f"{size.name}, {MOVING}", fit))
    return options


def _taken_back(
    found: ModelOutcome, everything: Observations, options: Sequence[FittedModel]
) -> tuple[ModelOutcome, State, BoolArray] | None:
    """Return the views used, with those of `everything` that were left out and agree with the best of lenses whose
    pupil moves, the poses of all, and the corners kept; None where there is none."""
    observations, left = found.observations, [everything.views[k] for k in np.flatnonzero(~found.used)]
    if not left:
        return None
    fit = min((option.fit for option in options), key=lambda one: robust_sigma(one, observations))
    others = Observations.from_views(left)
    state, _ = posed(others, fit.state.camera)
    norm = evaluate(state, others).weighted(others)
    kept = inliers(norm, others, robust_sigma(fit, observations), fit.state.camera.size_px)
    back = enough_agree(kept.sum(axis=1), others.present.sum(axis=1))
    if not back.any():
        return None
    whole = Observations.from_views([*observations.views, *(left[k] for k in np.flatnonzero(back))])
    kept_of_all = np.zeros(whole.present.shape, dtype=bool)
    # Corners stand in the order of each view, padded to the longest.
    kept_of_all[whole.present] = np.concatenate([fit.kept[observations.present], kept[back][others.present[back]]])
    poses = replace(
        fit.state,
        rotation=np.concatenate([fit.state.rotation, state.rotation[back]]),
        translation_mm=np.concatenate([fit.state.translation_mm, state.translation_mm[back]]),
    )
    reasons = tuple(reason for reason, ok in zip(found.reasons, back, strict=True) if not ok)
    used = found.used.copy()
    used[~used] = back
    return replace(found, observations=whole, used=used, reasons=reasons), poses, kept_of_all


def against_central(central: ModelOutcome, moving: ModelOutcome, request: Request) -> tuple[bool, list[Candidate]]:
    """Return whether images that took no part are shown better with the pupil, on the same corners, and both as
    candidates."""
    options = on_same_images(central, moving, (CENTRAL, MOVING))
    if moving.observations is central.observations:
        options = compared(central.observations, options, request.folds, request.progress)
    chosen = choose(options, MIN_SIGMAS)
    return chosen.name == MOVING, described(options, chosen)


def kept_central(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates of `against_central` where the lens stays central: a pupil that shows images better may do
    so by chance."""
    if not any(c.chosen and c.name == MOVING for c in candidates):
        return list(candidates)
    reasons = {CENTRAL: "images do not surely agree that the pupil moves", MOVING: "by how much it moves may be chance"}
    return [replace(c, chosen=c.name == CENTRAL, reason=reasons[c.name]) for c in candidates]


def pupil_moves_significantly(calibration: Calibration) -> bool:
    """Say whether the images agree that the pupil of a calibration moves."""
    return calibration.pupil is not None and calibration.pupil.chance(calibration.freedom) <= BY_CHANCE


def require_known(pupil: str) -> None:
    """Raise InputError for an option without a meaning."""
    if pupil not in PUPILS:
        raise InputError(f"pupil '{pupil}' is unknown; known: {', '.join(PUPILS)}")
