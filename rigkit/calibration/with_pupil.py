"""Calibration with a moving entrance pupil: two more unknowns, where the images support them.

The central camera is calibrated first. Where its residuals indicate a moving pupil (`diagnosis.pupil`), all sizes of
the same model and all board shapes are fitted again with a pupil, and chosen as before. The pupil is kept if it lowers
the held-out error as two more parameters must, and if it is significant against the scatter between images with any
displacement of a central lens free. One that is neither confirmed nor contradicted is a rival of the central lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.choosing.between_models import MIN_LIKELY, RivalFit
from rigkit.calibration.choosing.choice import MIN_SIGMAS, FittedModel, HeldOut, choose, described
from rigkit.calibration.choosing.models_tried import (
    ModelOutcome,
    Request,
    chosen_of_sizes,
    cross_validated,
    enough_agree,
    on_same_images,
    reweighted,
)
from rigkit.calibration.result import Candidate, Rival
from rigkit.calibration.solving.fit import fit_kept, fit_other_lens, identifiable, posed, robust_sigma
from rigkit.calibration.solving.outliers import inliers
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.moving_pupil import NearCamera, far_camera
from rigkit.core.arrays import BoolArray
from rigkit.core.errors import DegenerateError, InputError

PUPILS = ("auto", "central", "moving")
"""Values of the option: a pupil where the images support one, never, always."""
CENTRAL, MOVING = "fixed pupil", "moving pupil"
"""Names of the candidates."""


def solved_with_pupil(found: ModelOutcome, everything: Observations, request: Request) -> ModelOutcome | None:
    """Return the camera with a moving pupil, model size and board shape chosen again; None if it is not identifiable.

    Views of `everything` that the central lens dropped are used again if they agree with this one.
    """
    start = found.chosen.fit
    options = _with_every_size(found, start.state, start.kept)
    if options and (more := _with_dropped_views(found, everything, options)) is not None:
        found, poses, kept = more
        options = _with_every_size(found, poses, kept)
        if options:
            found = replace(found, observations=reweighted(found.observations, options))
    if not options:
        return None
    sizes = cross_validated(found.observations, options, request, "moving pupils")
    return chosen_of_sizes(found.observations, sizes, request, used=found.used, reasons=found.reasons)


def _with_every_size(found: ModelOutcome, poses: State, kept: BoolArray) -> list[FittedModel]:
    """Return every size of the model with a moving pupil, fitted to the corners `kept` of flat boards."""
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


def _with_dropped_views(
    found: ModelOutcome, everything: Observations, options: Sequence[FittedModel]
) -> tuple[ModelOutcome, State, BoolArray] | None:
    """Return the outcome with the dropped views of `everything` that agree with the best option added, the poses of all
    views, and the corners kept; None where no dropped view agrees."""
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
    # Views are padded to the longest one, which may be another one now.
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


def against_central(
    central: ModelOutcome, moving: ModelOutcome, request: Request
) -> tuple[bool, list[Candidate], list[RivalFit]]:
    """Return whether the held-out error is lower with the moving pupil, on the same corners, both as candidates, and
    the lens with the pupil as a rival of the central one, if it is probable."""
    options = on_same_images(central, moving, (CENTRAL, MOVING))
    if moving.observations is central.observations:
        options = cross_validated(central.observations, options, request, "pupils")
    chosen, likely = choose(options, MIN_SIGMAS), HeldOut.of([options]).likely().get(MOVING, 0.0)
    # Views that the central lens dropped come last.
    state = moving.chosen.fit.state.subset(np.arange(len(central.observations.views)))
    far = replace(state, camera=far_camera(state.camera))
    rivals = [RivalFit(Rival(MOVING, far.camera, likely), far)] if likely >= MIN_LIKELY else []
    return chosen.name == MOVING, described(options, chosen), rivals


def kept_central(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates of `against_central` with the central lens as the chosen one."""
    if not any(c.chosen and c.name == MOVING for c in candidates):
        return list(candidates)
    reasons = {CENTRAL: "a moving pupil is not significant", MOVING: "movement not significant"}
    return [replace(c, chosen=c.name == CENTRAL, reason=reasons[c.name]) for c in candidates]


def require_known(pupil: str) -> None:
    """Raise InputError for an unknown value of the option `pupil`."""
    if pupil not in PUPILS:
        raise InputError(f"pupil '{pupil}' is unknown; known: {', '.join(PUPILS)}")
