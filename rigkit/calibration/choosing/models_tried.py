"""Candidate camera models: each is fitted to all views, and all are compared on the same corners. The outcome of one
model: the views that agree with it, its best size, and the best board shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rigkit.calibration.choosing.board_orientation import misnumbered_views, with_boards_renumbered
from rigkit.calibration.choosing.choice import MIN_SIGMAS, FittedModel, choose, described, heldout_squares
from rigkit.calibration.result import Candidate
from rigkit.calibration.solving.evidence import fit_shapes
from rigkit.calibration.solving.fit import Fit, fit_kept, fit_model, identifiable, not_identifiable, robust_sigma
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.shape import SHAPES, in_enough_views
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.cameras.registry import MODELS, camera_model, check_order
from rigkit.core.arrays import BoolArray, IntArray
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.progress import Progress, silent

COMPARABLE = 1.5
"""A corner is an outlier only if it is one for every model whose scatter is within this factor of the smallest."""
MIN_KEPT_SHARE = 0.5
"""A view with a smaller part of inliers is dropped."""
DEGREES_TRIED: dict[str, tuple[int | None, ...]] = {"scaramuzza": (4, 5, 6, 7, 8), "brown": (5,)}
"""Sizes tried of models that have several, if none is given,"""
DEGREES_BEYOND: dict[str, tuple[int, ...]] = {"scaramuzza": (9, 10)}
"""and those tried if the largest of them is the best: for precise corners, or lenses of more than 200 degrees."""


class CandidateModel(NamedTuple):
    """A camera model of one size (`order`, None if it has only one) to be fitted, and its name."""

    name: str
    camera: type[Camera]
    order: int | None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Request:
    """The options of `calibrate`."""

    size_px: tuple[int, int]
    model: str
    degree: int | None = None
    board: str
    folds: int
    progress: Progress = silent
    pupil: str = "central"
    """Or "auto", "moving": see `calibrate`."""
    diagnosed: bool = True
    """Whether the result has verdicts, which take a third of the time of a fit without cross-validation."""


def wanted_models(request: Request) -> list[CandidateModel]:
    """Return the camera models to fit. Raises InputError for invalid options."""
    if request.board not in (*SHAPES, "auto"):
        raise InputError(f"board shape '{request.board}' is unknown; known: auto, {', '.join(SHAPES)}")
    if request.folds < 0 or request.folds == 1:
        raise InputError(f"cross-validation in {request.folds} folds: give 2 or more, or 0 for none")
    if request.degree is not None:
        check_order(request.model, request.degree)
    out: list[CandidateModel] = []
    for name in list(MODELS) if request.model == "auto" else [request.model]:
        cls = camera_model(name)
        orders = (request.degree,) if request.degree is not None else DEGREES_TRIED.get(name, (None,))
        out += [CandidateModel(name if order is None else f"{name} {order}", cls, order) for order in orders]
    return out


def larger_sizes(chosen: FittedModel) -> list[CandidateModel]:
    """Return the larger sizes to try of the chosen model, if it is of the largest size tried so far."""
    camera = chosen.fit.state.camera
    tried, more = DEGREES_TRIED.get(camera.model, (None,)), DEGREES_BEYOND.get(camera.model, ())
    if chosen.name != f"{camera.model} {tried[-1]}":
        return []
    return [CandidateModel(f"{camera.model} {order}", type(camera), order) for order in more]


def fit_all(
    observations: Observations, request: Request, wanted: Sequence[CandidateModel], known: Sequence[FittedModel] = ()
) -> tuple[list[FittedModel], list[Candidate]]:
    """Return the options `known` and those `wanted`, fitted, and the failed ones; raises the last error if there is no
    option at all."""
    options = list(known)
    failed: list[Candidate] = []
    error: Exception | None = None
    for i, (name, cls, order) in enumerate(wanted):
        request.progress("models", i, len(wanted))
        try:
            fit = fit_model(observations, request.size_px, cls, order)
            if not identifiable(fit):
                raise not_identifiable(name)
            options.append(FittedModel(name, fit))
        except (DegenerateError, InputError) as caught:
            error = caught
            failed.append(Candidate(name, 0, float("nan"), None, False, str(caught)))
    request.progress("models", len(wanted), len(wanted))
    if not options:
        assert error is not None
        raise error
    return options, failed


def agreeing_views(
    observations: Observations, options: list[FittedModel]
) -> tuple[BoolArray, tuple[tuple[str, str], ...]]:
    """Return which views agree with the model of the least scatter, and (image, reason) of the others."""
    best = _best(observations, options)
    kept = best.fit.kept.sum(axis=1)
    total = observations.present.sum(axis=1)
    keep = enough_agree(kept, total)
    reasons = tuple(
        (view.image, f"only {k} of {n} corners of board '{view.board.board_id}' agree with the other views; retake it")
        for view, k, n, ok in zip(observations.views, kept, total, keep, strict=True)
        if not ok
    )
    if not keep.any():
        raise DegenerateError("calibration: no view agrees with the others; check the board's size and the images")
    return keep, reasons


def enough_agree(kept: IntArray, total: IntArray) -> BoolArray:
    """Return which views have enough inliers `kept` (V,) among their `total` (V,) corners."""
    return np.asarray(kept >= np.maximum(MIN_KEPT_SHARE * total, 4))


def _best(observations: Observations, options: list[FittedModel]) -> FittedModel:
    """Return the option with the least scatter."""
    if len(options) == 1:
        return options[0]
    return min(options, key=lambda o: robust_sigma(o.fit, observations))


def reweighted(observations: Observations, options: list[FittedModel]) -> Observations:
    """Return the observations with weights that include the error common to all corners, from the best model's
    residuals."""
    if float(np.ptp(observations.sigma_px[observations.present])) == 0.0:
        return observations
    best = _best(observations, options)
    squared = (best.fit.residuals.px**2).sum(axis=-1)
    return observations.with_common_error(squared, best.fit.kept)


def cross_validated(
    observations: Observations, options: list[FittedModel], request: Request, what: str
) -> list[FittedModel]:
    """Return the options refitted to the same corners where they are not yet, with their held-out errors; `what` they
    are is said with the progress."""
    stage = f"cross-validation of {what}"
    sigma = [robust_sigma(o.fit, observations) for o in options] if len(options) > 1 else [0.0]
    near = [o.fit.kept for o, s in zip(options, sigma, strict=True) if s <= COMPARABLE * min(sigma)]
    kept = np.any(near, axis=0)
    out = []
    unequal = float(np.ptp(observations.weight[observations.present])) > 0.0
    for i, option in enumerate(options):
        request.progress(stage, i, len(options))
        if option.heldout is not None and (option.fit.kept == kept).all():
            out.append(option)
            continue
        same = (option.fit.kept == kept).all() and not unequal
        fit = option.fit if same else fit_kept(observations, option.fit.state, kept)
        out.append(replace(option, fit=fit, heldout=heldout_squares(observations, fit, request.folds)))
    request.progress(stage, len(options), len(options))
    return out


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ModelOutcome:
    """The outcome of one camera model.

    Attributes
    ----------
    observations, used, reasons : the views used, which of all views (V,) these are, and (image, reason) of the others.
    chosen : the best size with the best board shape.
    candidates : all options tried.
    beyond : larger sizes that were tried.
    sizes, shapes : the sizes compared with flat boards, and the board shapes compared.
    """

    observations: Observations
    used: BoolArray
    reasons: tuple[tuple[str, str], ...]
    chosen: FittedModel
    candidates: list[Candidate]
    beyond: Sequence[CandidateModel]
    sizes: list[FittedModel]
    shapes: list[FittedModel]


def solved(
    observations: Observations,
    options: list[FittedModel],
    wanted: Sequence[CandidateModel],
    failed: list[Candidate],
    request: Request,
) -> ModelOutcome:
    """Return the outcome of one camera model, independent of the other models."""
    model = options[0].model
    keep, reasons = agreeing_views(observations, options)
    if reasons:
        observations = observations.subset(np.flatnonzero(keep))
        options, failed = fit_all(observations, request, wanted)
    observations = reweighted(observations, options)
    options = cross_validated(observations, options, request, model)
    beyond = [] if request.degree is not None else larger_sizes(choose(options, MIN_SIGMAS))
    if beyond:
        options, unfit = fit_all(observations, request, beyond, options)
        options = cross_validated(observations, options, request, f"larger {model}")
        failed = [*failed, *unfit]
    return chosen_of_sizes(observations, options, request, used=keep, reasons=reasons, failed=failed, beyond=beyond)


def chosen_of_sizes(
    observations: Observations,
    sizes: list[FittedModel],
    request: Request,
    *,
    used: BoolArray,
    reasons: tuple[tuple[str, str], ...],
    failed: Sequence[Candidate] = (),
    beyond: Sequence[CandidateModel] = (),
) -> ModelOutcome:
    """Return the outcome with the best of the `sizes`, compared with flat boards, and then the best board shape."""
    chosen = choose(sizes, MIN_SIGMAS)
    candidates = [*described(sizes, chosen, rivals=request.model == "auto"), *failed]
    observations, chosen, shapes, tried = with_board_shape(observations, chosen, request)
    return ModelOutcome(
        observations=observations,
        used=used,
        reasons=reasons,
        chosen=chosen,
        candidates=[*candidates, *tried],
        beyond=beyond,
        sizes=sizes,
        shapes=shapes,
    )


def on_same_images(found: ModelOutcome, again: ModelOutcome, names: tuple[str, str]) -> list[FittedModel]:
    """Return the chosen options of two outcomes, with the given `names` and the held-out errors of the images that both
    used: each drops views that disagree with its own model."""
    images = [list(dict.fromkeys(one.observations.images)) for one in (found, again)]
    out = []
    for name, one, own, other in zip(names, (found, again), images, images[::-1], strict=True):
        both, heldout = [k for k, image in enumerate(own) if image in set(other)], one.chosen.heldout
        out.append(replace(one.chosen, name=name, heldout=None if heldout is None else heldout[both]))
    return out


def with_board_shape(
    observations: Observations, flat: FittedModel, request: Request
) -> tuple[Observations, FittedModel, list[FittedModel], list[Candidate]]:
    """Return the views, the fit with the board shape requested from that with `flat` boards, the shapes compared, and
    those as candidates. With "auto" the shape has the smallest held-out error. In the views returned, boards with
    rotational symmetry are numbered from the same corner."""
    if request.board == "flat" or not in_enough_views(observations).any():
        return observations, flat, [flat], []
    observations, flat, fits = _fit_shapes(observations, flat, request.board)
    shapes, untried = _shapes(observations, flat, fits, request)
    chosen = choose(shapes)
    candidates = [*(c for c in described(shapes, chosen) if "board" in c.name), *untried]
    # Corners that are inliers only of another shape were added for the comparison: the flat fit is without them.
    return observations, flat if chosen.name == flat.name else chosen, shapes, candidates


def _fit_shapes(
    observations: Observations, flat: FittedModel, board: str
) -> tuple[Observations, FittedModel, dict[str, Fit]]:
    """Return the fits by shape, and views and flat fit with boards of rotational symmetry numbered from the same corner
    where the shapes determine it."""
    fits = fit_shapes(observations, flat.fit, board)
    for quarter_turns in (1, 2):
        *_, richest = fits.values()
        views = misnumbered_views(observations, richest, quarter_turns)
        if views.any():
            observations, state = with_boards_renumbered(observations, flat.fit.state, views, quarter_turns)
            data = normal_equations(observations, state, flat.fit.weight(observations))
            flat = replace(flat, fit=replace(flat.fit, state=state, data=data))
            fits = fit_shapes(observations, flat.fit, board)
    return observations, flat, fits


def _shapes(
    observations: Observations, flat: FittedModel, fits: dict[str, Fit], request: Request
) -> tuple[list[FittedModel], list[Candidate]]:
    """Return the shapes compared on the same corners, and as a candidate the one that was not tried."""
    options, untried = [FittedModel(f"board {kind}", fit) for kind, fit in fits.items()], list[Candidate]()
    if request.board == "auto":
        options = [flat, *options]
        if "released" not in fits:
            reason = "not tried: residuals of the warp are consistent with noise"
            untried = [Candidate("board released", 0, float("nan"), None, False, reason)]
    return cross_validated(observations, options, request, "board shapes"), untried
