"""Calibrating one camera from views of chessboards, without any guess.

Every model (degree, board shape) in question is fitted; what is chosen is the one with the fewest numbers among those
whose held-out error is as good as the smallest. All are compared on the same corners. Boards that are not flat bend the
lenses to themselves: lenses are compared on flat boards first, and again on boards as they were found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from rigkit.calibration.assemble import assemble, require_determined
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.choosing.begun import BegunCalibration, about_camera, begin
from rigkit.calibration.choosing.between_models import rival_fits, rival_shapes, with_rivals
from rigkit.calibration.choosing.choice import MIN_SIGMAS, FittedModel, HeldOut, choose, described, models_of
from rigkit.calibration.choosing.lens_choice import ModelChoice, best_sizes, choose_lenses, twins
from rigkit.calibration.choosing.models_tried import Request
from rigkit.calibration.choosing.one_model import ModelOutcome, on_same_images
from rigkit.calibration.judging.moved import moved_lens
from rigkit.calibration.judging.pupil import may_move
from rigkit.calibration.judging.verdicts import judge
from rigkit.calibration.result import Calibration, Candidate
from rigkit.calibration.with_pupil import (
    against_central,
    kept_central,
    pupil_moves_significantly,
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
    views : boards as they were seen; several boards in one image are several views of one image name.
    size_px : (width, height) of the images.
    model : name of a camera model, or "auto": all of them, chosen by held-out error.
    degree : size of a model that comes in several (degree of "scaramuzza", terms of "brown"); by default chosen by
        held-out error.
    board : "flat", "warp", "released", or "auto": chosen by held-out error.
    folds : of the cross-validation over images; 0 for none: choices then rest on BIC, halves are not compared, and that
        another model may show the images as well is not in the sigmas, which are too small beyond the boards.
    pupil : "auto": the lens is central, but where residuals say that its entrance pupil moves, and images that took no
        part are shown better with it, that is two more unknowns (`Calibration.pupil`); "central": never; "moving":
        always.
    progress : told of the models tried.

    Raises
    ------
    InputError
        No view, corners outside the image, unknown model, board shape or pupil, a number of folds without a meaning.
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
    known: Sequence[BegunCalibration] = (),
    progress: Progress = silent,
) -> list[Calibration]:
    """Return the calibration of each of the cameras of a rig, (name, views, what is asked for) each: alone, but the
    models that "auto" asks for are chosen together where cameras are alike. What was `known` before of the same views
    is not done again. Errors as of `calibrate`, with the name (none for "")."""
    begun = []
    for k, (name, views, request) in enumerate(cameras):
        progress("cameras", k, len(cameras))
        done = (one.asked(name, views, request) for one in known)
        begun.append(next((one for one in done if one is not None), None) or begin(name, views, request))
    out: dict[int, Calibration] = {}
    for group in twins([choose(one.tried, MIN_SIGMAS).fit.state.camera for one in begun]):
        out |= dict(zip(group, _finish([begun[k] for k in group]), strict=True))
    progress("cameras", len(cameras), len(cameras))
    return [out[k] for k in range(len(begun))]


def _finish(group: Sequence[BegunCalibration]) -> list[Calibration]:
    """Return the calibrations of cameras that are alike, or of one."""
    tried = [one.tried for one in group]
    choices = choose_lenses(tried)
    found = [one.solved(choice.model) for one, choice in zip(group, choices, strict=True)]
    several = any(len(models_of(options)) > 1 for options in tried)
    if several and any(one.chosen.fit.state.shape.kind != "flat" for one in found):
        # Boards that are not flat bend the lenses to themselves: as they were found, another one may be the better.
        names = best_sizes(tried)
        on_boards = [begun.on_boards(choice.model, names) for begun, choice in zip(group, choices, strict=True)]
        others = choose_lenses(on_boards)
        for model in dict.fromkeys(other.model for other in others):
            changed = [k for k, c in enumerate(choices) if others[k].model == model != c.model]
            again = [group[k].solved(model) for k in changed]
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
    for begun, one, options, choice, compared in zip(group, found, tried, choices, rivals, strict=True):
        with about_camera(begun.name, begun.observations.views):
            out.append(_result(begun, one, options, compared, choice.likely))
    return out


def _better(found: Sequence[ModelOutcome], again: Sequence[ModelOutcome]) -> bool:
    """Say whether cameras that are alike are better off with the model that they were solved with again."""
    pairs = [on_same_images(now, then, ("found", "again")) for now, then in zip(found, again, strict=True)]
    if any(option.heldout is not None and len(option.heldout) < 2 for pair in pairs for option in pair):
        return False  # Nothing can be compared.
    if len(pairs) == 1:
        return choose(pairs[0], MIN_SIGMAS).name == "again"
    return HeldOut.of(pairs).chosen() == "again"


def _result(
    begun: BegunCalibration,
    found: ModelOutcome,
    tried: Sequence[FittedModel],
    rivals: Sequence[FittedModel],
    likely: Mapping[str, float],
) -> Calibration:
    """Return the result of a camera with its verdicts; with a pupil that moves where the lens has one."""
    central, request = _with_verdicts(begun, found, tried, rivals, likely), begun.request
    if request.pupil == "central" or (request.pupil == "auto" and not may_move(central)):
        return central
    moving = solved_with_pupil(found, begun.observations, request)
    if moving is not None:
        if len(models_of(tried)) == 1:
            rivals, likely = moving.sizes, HeldOut.of([moving.sizes]).likely()
        better, candidates = against_central(found, moving, request)
        moving = replace(moving, candidates=[*candidates, *moving.candidates])
        try:
            result = _with_verdicts(begun, moving, tried, rivals, likely)
        except DegenerateError:
            result = central
        if result.pupil is not None and (request.pupil == "moving" or (better and pupil_moves_significantly(result))):
            return result
        central = replace(central, candidates=(*central.candidates, *kept_central(candidates)))
    if request.pupil == "moving":
        raise DegenerateError(
            "calibration: the images do not tell how the entrance pupil moves; take boards near and far, up to the "
            'rim of the image, or pupil = "auto"'
        )
    return central


def _with_verdicts(
    begun: BegunCalibration,
    found: ModelOutcome,
    tried: Sequence[FittedModel],
    rivals: Sequence[FittedModel],
    likely: Mapping[str, float],
) -> Calibration:
    """Return the result of a camera as it was solved for, with its verdicts."""
    request, fit = begun.request, found.chosen.fit
    others = _others(tried, far_camera(fit.state.camera).model) if len(models_of(tried)) > 1 else []
    close = rival_fits(found.observations, fit, rivals, likely)
    if not begun.name:
        # What shape boards have is a question to all cameras of a rig together, which holds lenses by what each knows.
        close += rival_shapes(found.chosen, found.shapes)
    result = assemble(
        found.observations,
        fit,
        found.chosen.heldout_px,
        (*begun.dropped, *found.reasons),
        with_rivals([*others, *found.candidates], [one.rival for one in close]),
        close,
    )
    in_force = [name for name, value in (("model", request.model), ("board_shape", request.board)) if value == "auto"]
    moved = moved_lens(found.observations, fit) if request.folds else ()
    also = [*moved, *_at_the_end(found.beyond, result, in_force)]
    far, clusters = _determined(result), found.observations.clusters()
    solved_for = found.observations, fit
    order = begun.observations.images
    verdicts = judge(result, also, far=far, clusters=clusters, in_force=in_force, solved=solved_for, order=order)
    return replace(result, verdicts=verdicts)


def _others(tried: Sequence[FittedModel], model: str) -> list[Candidate]:
    """Return the lenses tried but those of the `model` chosen, against the best of those."""
    own = [option for option in tried if option.model == model]
    if not own:
        return []
    against = choose(own, MIN_SIGMAS)
    return described([*(o for o in tried if o not in own), against], against)[:-1]


def _determined(result: Calibration) -> FarProjection:
    """Return how sure the result is far away; raises DegenerateError where the views do not determine the camera."""
    far = FarProjection.of(result, from_boards=True)
    require_determined(result, far.of_parameters_px)
    return far


def _at_the_end(
    beyond: Sequence[tuple[str, type[Camera], int | None]], result: Calibration, in_force: Sequence[str]
) -> list[Finding]:
    """Say that the lens may ask for more than the model has, where the largest size of all is the best."""
    if not beyond or "model" in in_force or not any(c.name == beyond[-1][0] and c.chosen for c in result.candidates):
        return []
    return [
        Finding.look(
            f"{beyond[-1][0]} is the largest there is of its kind, and the best: the lens may ask for more, "
            "most towards its rim",
            'try model = "auto"',
        )
    ]
