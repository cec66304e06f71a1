"""Calibration of one camera from views of boards, without initial values.

Every candidate model (its degree, the boards' shape) is fitted to the same corners. Chosen is the one with the fewest
parameters among those whose held-out error is as good as the smallest. A board that is not flat biases the lens, and
not every model alike: models are compared with flat boards first, and again with the board shapes that were found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from rigkit.calibration.assemble import assemble, require_determined
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.choosing.between_models import (
    RivalFit,
    rival_fits,
    rival_shapes,
    same_model,
    with_other_lens,
    with_rivals,
)
from rigkit.calibration.choosing.candidate_fits import (
    CandidateFits,
    ModelChoice,
    best_sizes,
    camera_named_in_errors,
    choose_lenses,
    fit_candidates,
    like_cameras,
)
from rigkit.calibration.choosing.choice import MIN_SIGMAS, FittedModel, HeldOut, choose, described, models_of
from rigkit.calibration.choosing.models_tried import ModelOutcome, Request, on_same_images
from rigkit.calibration.diagnosis.moved import moved_lens, two_groups
from rigkit.calibration.diagnosis.pupil import may_move, pupil_is_significant, solved_again
from rigkit.calibration.diagnosis.verdicts import diagnose
from rigkit.calibration.result import Calibration, Candidate
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.with_pupil import (
    against_central,
    kept_central,
    require_known,
    solved_with_pupil,
)
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import far_camera
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.core.findings import Finding
from rigkit.core.progress import Progress, silent

FOLDS = 5


def calibrate(
    views: Sequence[BoardView],
    size_px: tuple[int, int],
    *,
    model: str = "scaramuzza",
    degree: int | None = None,
    board: str = "auto",
    folds: int = FOLDS,
    pupil: str = "auto",
    progress: Progress = silent,
) -> Calibration:
    """Return the calibration of a camera from views of boards.

    Parameters
    ----------
    views : detected boards; several boards in one image are several views with the same image name.
    size_px : (width, height) of the images.
    model : name of a camera model, or "auto": all of them, chosen by held-out error.
    degree : size of a model that has several (degree of "scaramuzza", terms of "brown"); by default chosen by held-out
        error.
    board : "flat", "warp", "released", or "auto": chosen by held-out error.
    folds : number of folds of the cross-validation over images. 0 disables it: BIC then selects the model, a lens that
        moved between images is not looked for, and the sigmas do not include the uncertainty of the model selection,
        so that they are too small outside the part of the image that boards covered.
    pupil : "central": all rays meet in one point; "moving": the entrance pupil moves along the axis with the angle, two
        more parameters (`Calibration.pupil`); "auto": moving where the residuals indicate it and the held-out error
        confirms it.
    progress : called with the stage and the counts of models done and in all.

    Raises
    ------
    InputError
        No view, corners outside the image, an unknown model, board shape or pupil, or an invalid number of folds.
    DegenerateError
        The views do not determine the camera.
    """
    require_known(pupil)
    request = Request(
        size_px=size_px, model=model, degree=degree, board=board, folds=folds, progress=progress, pupil=pupil
    )
    return calibrate_together([("", views, request)])[0]


def calibrate_together(
    cameras: Sequence[tuple[str, Sequence[BoardView], Request]],
    *,
    known: Sequence[CandidateFits] = (),
    progress: Progress = silent,
) -> list[Calibration]:
    """Return the calibration of each camera of a rig, given as (name, views, options).

    Each is calibrated by itself, but `like_cameras` choose among the models of "auto" together. `known` are earlier
    calibrations; one of the same views and options is not repeated. Raises as `calibrate`, with the camera's name in
    the message unless it is "".
    """
    fits = []
    for k, (name, views, request) in enumerate(cameras):
        progress("cameras", k, len(cameras))
        done = (one.for_request(name, views, request) for one in known)
        fits.append(next((one for one in done if one is not None), None) or fit_candidates(name, views, request))
    out: dict[int, Calibration] = {}
    for group in like_cameras([choose(one.tried, MIN_SIGMAS).fit.state.camera for one in fits]):
        out |= dict(zip(group, _finish([fits[k] for k in group]), strict=True))
    progress("cameras", len(cameras), len(cameras))
    return [out[k] for k in range(len(fits))]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Solution:
    """The solution of one camera, and what it was chosen from.

    Attributes
    ----------
    fits : all candidate models of the camera.
    outcome : of the chosen model.
    tried : the candidates, one size of each model or all of one model, compared on the same boards.
    rivals, likely : options of which some may be as good as the chosen one, and the probability of each by name.
    """

    fits: CandidateFits
    outcome: ModelOutcome
    tried: Sequence[FittedModel]
    rivals: Sequence[FittedModel]
    likely: Mapping[str, float]

    def assembled(self, more: Sequence[RivalFit] = ()) -> tuple[Calibration, FarProjection]:
        """Return the result without verdicts, with `more` rivals, and the uncertainty of its projection of far points;
        raises DegenerateError if the views do not determine it."""
        outcome, fit = self.outcome, self.outcome.chosen.fit
        others = _others(self.tried, far_camera(fit.state.camera).model) if len(models_of(self.tried)) > 1 else []
        close = [*rival_fits(outcome.observations, fit, self.rivals, self.likely), *more]
        if not self.fits.name:
            # In a rig all cameras together choose the boards' shapes.
            close += rival_shapes(outcome.chosen, outcome.shapes)
        result = assemble(
            outcome.observations,
            fit,
            outcome.chosen.heldout_px,
            (*self.fits.dropped, *outcome.reasons),
            with_rivals([*others, *outcome.candidates], [one.rival for one in close]),
            close,
        )
        result = replace(result, disagreeing=tuple(image for image, _ in outcome.reasons))
        # Its views are those observed.
        vars(result)["clusters"] = outcome.observations.clusters()
        far = FarProjection.of(result, from_boards=True)
        require_determined(result, far.of_parameters_px)
        return result, far

    def with_verdicts(self, result: Calibration, far: FarProjection, *, may_move: bool = True) -> Calibration:
        """Return what `assembled` returned, with its verdicts if the request asks for them; `may_move` as of
        `diagnose`."""
        request, outcome = self.fits.request, self.outcome
        if not request.diagnosed:
            return result
        automatic = (("model", request.model), ("board_shape", request.board))
        in_force = [name for name, value in automatic if value == "auto"]
        observations, fit = outcome.observations, outcome.chosen.fit
        moved = _moved(observations, fit, self.tried, in_halves=request.folds > 0)
        verdicts = diagnose(
            result,
            [*moved, *_largest_size_chosen(outcome.beyond, result, in_force)],
            far=far,
            in_force=in_force,
            solved=(observations, fit),
            order=self.fits.observations.images,
            may_move=may_move,
        )
        return replace(result, verdicts=verdicts)

    def with_pupil(self, moving: ModelOutcome) -> _Solution:
        """Return the solution with the outcome for a moving pupil."""
        if len(models_of(self.tried)) > 1:
            return replace(self, outcome=moving)
        return replace(self, outcome=moving, rivals=moving.sizes, likely=HeldOut.of([moving.sizes]).likely())


def _finish(group: Sequence[CandidateFits]) -> list[Calibration]:
    """Return the calibrations of a group of like cameras."""
    tried = [one.tried for one in group]
    choices = choose_lenses(tried)
    found = [one.outcome_of(choice.model) for one, choice in zip(group, choices, strict=True)]
    several = any(len(models_of(options)) > 1 for options in tried)
    if several and any(one.chosen.fit.state.shape.kind != "flat" for one in found):
        # A board that is not flat biases the lens: with the shapes found, another model may be the best one.
        names = best_sizes(tried)
        on_boards = [one.on_boards_of(choice.model, names) for one, choice in zip(group, choices, strict=True)]
        others = choose_lenses(on_boards)
        for model in dict.fromkeys(other.model for other in others):
            changed = [k for k, c in enumerate(choices) if others[k].model == model != c.model]
            # The images that agree with another model alone may not determine it.
            with suppress(DegenerateError):
                again = [group[k].outcome_of(model) for k in changed]
                if changed and _better([found[k] for k in changed], again):
                    for k, one in zip(changed, again, strict=True):
                        found[k], tried[k] = one, on_boards[k]
        choices, rivals = others, on_boards
    elif several:
        rivals = tried
    else:
        rivals = [one.sizes for one in found]
        choices = [ModelChoice(c.model, HeldOut.of([r]).likely()) for c, r in zip(choices, rivals, strict=True)]
    out = []
    for fits, outcome, options, choice, compared in zip(group, found, tried, choices, rivals, strict=True):
        with camera_named_in_errors(fits.name, fits.observations.views):
            out.append(
                _result(_Solution(fits=fits, outcome=outcome, tried=options, rivals=compared, likely=choice.likely))
            )
    return out


def _better(found: Sequence[ModelOutcome], again: Sequence[ModelOutcome]) -> bool:
    """Return whether like cameras have a lower held-out error in `again` than in `found`."""
    pairs = [on_same_images(now, then, ("found", "again")) for now, then in zip(found, again, strict=True)]
    if any(option.heldout is not None and len(option.heldout) < 2 for pair in pairs for option in pair):
        return False  # The standard error of a difference needs two images.
    if len(pairs) == 1:
        return choose(pairs[0], MIN_SIGMAS).name == "again"
    evidence = HeldOut.of(pairs)
    return bool(evidence.names) and evidence.chosen() == "again"


def _result(solution: _Solution) -> Calibration:
    """Return the result of a camera with its verdicts, with a moving pupil if requested or confirmed."""
    central, far = solution.assembled()
    request = solution.fits.request
    if request.pupil == "central":
        return solution.with_verdicts(central, far)
    if request.pupil == "auto" and not may_move(central, far):
        return solution.with_verdicts(central, far, may_move=False)
    moving = solved_with_pupil(solution.outcome, solution.fits.observations, request)
    compared: Sequence[Candidate] = ()
    if moving is not None:
        better, candidates, possible = against_central(solution.outcome, moving, request)
        compared = kept_central(candidates)
        other = solution.with_pupil(replace(moving, candidates=[*candidates, *moving.candidates]))
        with suppress(DegenerateError):
            result, far_of_moving = other.assembled()
            confirmed = request.pupil == "moving" or (better and pupil_is_significant(result, central))
            if confirmed and result.pupil is not None:
                return other.with_verdicts(result, far_of_moving)
            if possible and solved_again(result) is not None:
                central, far = solution.assembled(possible)
                compared = with_rivals(compared, [one.rival for one in possible])
    if request.pupil == "moving":
        raise DegenerateError(
            "calibration: the images do not determine how the entrance pupil moves; take boards near and far, up to "
            'the rim of the image, or pupil = "auto"'
        )
    central = solution.with_verdicts(central, far)
    return replace(central, candidates=(*central.candidates, *compared))


def _moved(
    observations: Observations, fit: Fit, tried: Sequence[FittedModel], *, in_halves: bool
) -> tuple[Finding, ...]:
    """Return a finding where the lens changed during the session (if looked for `in_halves`) by the chosen model, or
    else by the model with the least scatter, or where the images are of two lenses by both. Of images of two lenses a
    small model may predict best, whose error differs with the boards' places and hides the change."""
    one_model = len(models_of(tried)) == 1
    if not in_halves:
        return two_groups(observations, [fit], one_model=one_model)
    camera = far_camera(fit.state.camera)
    best = far_camera(min(tried, key=lambda option: option.fit.sigma_px).fit.state.camera)
    other = None if same_model(best, camera) else with_other_lens(observations, fit, best)
    fits = [fit] if other is None else [fit, other]
    moved = next((found for one in fits if (found := moved_lens(observations, one, tests=len(fits)))), ())
    return moved or two_groups(observations, fits, one_model=one_model)


def _others(tried: Sequence[FittedModel], model: str) -> list[Candidate]:
    """Return as candidates the options of other camera models than `model`, compared with the best option of it."""
    own = [option for option in tried if option.model == model]
    if not own:
        return []
    against = choose(own, MIN_SIGMAS)
    return described([*(o for o in tried if o not in own), against], against)[:-1]


def _largest_size_chosen(
    beyond: Sequence[tuple[str, type[Camera], int | None]], result: Calibration, in_force: Sequence[str]
) -> Iterator[Finding]:
    """Yield a finding where the largest size of the model was chosen: the lens may need a larger one."""
    if not beyond or "model" in in_force or not any(c.name == beyond[-1][0] and c.chosen for c in result.candidates):
        return
    yield Finding.look(
        f"{beyond[-1][0]}, the largest size of this model, was chosen: the lens may need more parameters, mostly "
        "near the image border",
        'try model = "auto"',
    )
