"""The outcome of one camera model: the views that agree with it, its best size, and the best board shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.choosing.board_orientation import misnumbered_views, with_boards_renumbered
from rigkit.calibration.choosing.choice import MIN_SIGMAS, FittedModel, choose, described
from rigkit.calibration.choosing.models_tried import (
    CandidateModel,
    Request,
    agreeing_views,
    cross_validated,
    fit_all,
    larger_sizes,
    reweighted,
)
from rigkit.calibration.result import Candidate
from rigkit.calibration.solving.evidence import fit_shapes
from rigkit.calibration.solving.fit import Fit
from rigkit.calibration.solving.linearise import normal_equations
from rigkit.calibration.solving.shape import in_enough_views
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray


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
