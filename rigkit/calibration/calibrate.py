"""Calibrating one camera from views of chessboards, without any guess.

Every model (degree, board shape) in question is fitted; what is chosen is the one with the fewest numbers among those
whose held-out error is as good as the smallest. All are compared on the same corners. Boards that are not flat bend the
lenses to themselves: lenses are compared on flat boards first, and again on boards as they were found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.assemble import assemble, clusters_of, identifiable, not_identifiable, require_determined
from rigkit.calibration.board_orientation import turned_views, with_views_turned
from rigkit.calibration.choice import SURELY, Option, choose, described
from rigkit.calibration.evidence import fit_shapes
from rigkit.calibration.fit import Fit, fit_kept, fit_model, heldout_squares, robust_sigma
from rigkit.calibration.linearise import normal_equations
from rigkit.calibration.moved import moved_lens
from rigkit.calibration.observations import Observations
from rigkit.calibration.result import Calibration, Candidate
from rigkit.calibration.shape import SHAPES, often_seen
from rigkit.calibration.uncertainty import FarProjection
from rigkit.calibration.usable import usable_views
from rigkit.calibration.verdicts import judge
from rigkit.cameras.base import Camera
from rigkit.cameras.registry import MODELS, camera_model, check_order
from rigkit.core.arrays import BoolArray
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.findings import Finding, Severity
from rigkit.core.progress import Progress, silent

FOLDS = 5
COMPARABLE = 1.5
"""Corners are outliers only if every model with a scatter within this factor of the best one says so."""
MIN_KEPT_SHARE = 0.5
"""A view in which fewer of the corners agree with the other views is dropped."""
DEGREES_TRIED: dict[str, tuple[int | None, ...]] = {"scaramuzza": (4, 5, 6, 7, 8), "brown": (5,)}
"""Sizes tried of models that come in several, where none is asked for,"""
DEGREES_BEYOND: dict[str, tuple[int, ...]] = {"scaramuzza": (9, 10)}
"""and those tried where the largest of them is the best: precise corners, or lenses of more than 200 degrees."""


def calibrate(
    views: Sequence[BoardView],
    size_px: tuple[int, int],
    *,
    model: str = "scaramuzza",
    degree: int | None = None,
    board: str = "auto",
    folds: int = FOLDS,
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
    folds : of the cross-validation over images; 0 for none: choices then rest on BIC, and halves are not compared.
    progress : told of the models tried.

    Raises
    ------
    InputError
        No view, corners outside the image, unknown model or board shape, a number of folds without a meaning.
    DegenerateError
        The views do not determine the camera.
    """
    wanted = _wanted(model, degree, board, folds)
    used, dropped = usable_views(views, size_px)
    observations = Observations.from_views(used)
    rivals = len({camera for _, camera, _ in wanted}) > 1
    how = _How(size_px, degree, board, folds, rivals, progress)
    options, failed = _fit_all(observations, size_px, wanted, progress)
    tried, name = _lens(observations, options, how)
    found = _solved(observations, *_only(options, wanted, name), failed, how)
    if len(tried) > 1 and found.chosen.fit.state.shape.kind != "flat":
        # Boards that are not flat bend the lenses to themselves: as they were found, another one may be the better.
        on_boards, other = _lens_on_boards(found, tried, how)
        if other != name:
            again = _solved(observations, *_only(options, wanted, other), failed, how)
            if choose(again.observations, [found.chosen, again.chosen], SURELY) is again.chosen:
                found, tried, name = again, on_boards, other
    others = _others(observations, tried, name)
    clusters = clusters_of(found.observations)
    result = assemble(
        found.observations,
        found.chosen.fit,
        found.chosen.heldout_px,
        (*dropped, *found.reasons),
        (*others, *found.candidates),
        clusters,
    )
    in_force = [name for name, value in (("model", model), ("board_shape", board)) if value == "auto"]
    moved = moved_lens(found.observations, found.chosen.fit) if folds else ()
    also = [*moved, *_at_the_end(found.beyond, result, in_force)]
    far = _determined(result, found.observations, found.chosen.fit)
    return replace(result, verdicts=judge(result, also, far=far, clusters=clusters, in_force=in_force))


Wanted = list[tuple[str, type[Camera], int | None]]
"""Name, camera model and size of what is to be fitted."""


@dataclass(frozen=True, eq=False, slots=True)
class _How:
    """What `calibrate` was asked for, but the model; `rivals`: several models are."""

    size_px: tuple[int, int]
    degree: int | None
    board: str
    folds: int
    rivals: bool
    progress: Progress


@dataclass(frozen=True, eq=False, slots=True)
class _Solved:
    """What one camera model came to: the observations used, why views were left out, the size and board shape chosen,
    what was tried, and which larger sizes were."""

    observations: Observations
    reasons: tuple[tuple[str, str], ...]
    chosen: Option
    candidates: list[Candidate]
    beyond: Wanted


def _only(options: list[Option], wanted: Wanted, model: str) -> tuple[list[Option], Wanted]:
    """Return the options and what was wanted of one camera model."""
    own = [option for option in options if option.fit.state.camera.model == model]
    return own, [w for w in wanted if w[1].model == model]


def _solved(
    observations: Observations, options: list[Option], wanted: Wanted, failed: list[Candidate], how: _How
) -> _Solved:
    """Return what one camera model comes to; what else was tried changes nothing."""
    size_px, board, folds, progress = how.size_px, how.board, how.folds, how.progress
    keep, reasons = _agreeing(observations, options)
    if reasons:
        observations = observations.subset(np.flatnonzero(keep))
        options, failed = _fit_all(observations, size_px, wanted, progress)
    observations = _reweighted(observations, options)
    options = _compared(observations, options, folds, progress)
    chosen = choose(observations, options, SURELY)
    beyond = [] if how.degree is not None else _beyond(chosen)
    if beyond:
        options, unfit = _fit_all(observations, size_px, beyond, progress, options)
        options = _compared(observations, options, folds, progress)
        chosen, failed = choose(observations, options, SURELY), [*failed, *unfit]
    candidates = [*described(options, chosen, rivals=how.rivals), *failed]
    if board != "flat" and often_seen(observations).any():
        observations, chosen, fits = _fit_shapes(observations, chosen, board)
        shapes, spared = _shapes(observations, fits, board, folds, progress)
        shapes = [*([chosen] if board == "auto" else []), *shapes]
        chosen = choose(observations, shapes)
        candidates += [*(c for c in described(shapes, chosen) if "board" in c.name), *spared]
    return _Solved(observations, reasons, chosen, candidates, beyond)


def _determined(result: Calibration, observations: Observations, fit: Fit) -> FarProjection:
    """Return how sure the result is far away; raises DegenerateError where the views do not determine the camera."""
    points, _ = fit.state.points_in_cam(observations)
    far = FarProjection.of(result, points[fit.kept])
    require_determined(result, far.at_corners_px)
    return far


def _wanted(model: str, degree: int | None, board: str, folds: int) -> list[tuple[str, type[Camera], int | None]]:
    """Return name, camera model and size of what is to be fitted. Raises InputError for options without a meaning."""
    if board not in (*SHAPES, "auto"):
        raise InputError(f"board shape '{board}' is unknown; known: auto, {', '.join(SHAPES)}")
    if folds < 0 or folds == 1:
        raise InputError(f"cross-validation in {folds} folds: give 2 or more, or 0 for none")
    if degree is not None:
        check_order(model, degree)
    names = list(MODELS) if model == "auto" else [model]
    out: list[tuple[str, type[Camera], int | None]] = []
    for name in names:
        cls = camera_model(name)
        orders = (degree,) if degree is not None else DEGREES_TRIED.get(name, (None,))
        out += [(name if order is None else f"{name} {order}", cls, order) for order in orders]
    return out


def _beyond(chosen: Option) -> list[tuple[str, type[Camera], int | None]]:
    """Return the larger sizes to try of the model chosen, if it is of the largest size tried so far."""
    camera = chosen.fit.state.camera
    tried, more = DEGREES_TRIED.get(camera.model, (None,)), DEGREES_BEYOND.get(camera.model, ())
    if chosen.name != f"{camera.model} {tried[-1]}":
        return []
    return [(f"{camera.model} {order}", type(camera), order) for order in more]


def _at_the_end(
    beyond: Sequence[tuple[str, type[Camera], int | None]], result: Calibration, in_force: Sequence[str]
) -> list[Finding]:
    """Say that the lens may ask for more than the model has, where the largest size of all is the best."""
    if not beyond or "model" in in_force or not any(c.name == beyond[-1][0] and c.chosen for c in result.candidates):
        return []
    return [
        Finding(
            severity=Severity.LOOK,
            message=f"{beyond[-1][0]} is the largest there is of its kind, and the best: the lens may ask for more, "
            "most towards its rim",
            remedy='try model = "auto"',
        )
    ]


def _fit_all(
    observations: Observations,
    size_px: tuple[int, int],
    wanted: Sequence[tuple[str, type[Camera], int | None]],
    progress: Progress,
    known: Sequence[Option] = (),
) -> tuple[list[Option], list[Candidate]]:
    """Return the options `known` and those `wanted`, fitted, and which could not be; raises where there is none."""
    options = list(known)
    failed: list[Candidate] = []
    error: Exception | None = None
    for i, (name, cls, order) in enumerate(wanted):
        progress("models", i, len(wanted))
        try:
            fit = fit_model(observations, size_px, cls, order)
            if not identifiable(fit):
                raise not_identifiable(name)
            options.append(Option(name, fit))
        except (DegenerateError, InputError) as caught:
            error = caught
            failed.append(Candidate(name, 0, float("nan"), None, False, str(caught)))
    progress("models", len(wanted), len(wanted))
    if not options:
        assert error is not None
        raise error
    return options, failed


def _lens(observations: Observations, options: list[Option], how: _How) -> tuple[list[Option], str]:
    """Return the options as they were compared on the same corners, and the camera model that shows the views best."""
    models = {option.fit.state.camera.model for option in options}
    if len(models) == 1:
        return [], models.pop()
    keep, _ = _agreeing(observations, options)
    seen = observations.subset(np.flatnonzero(keep))
    same = options if keep.all() else [replace(o, fit=_of_views(seen, o.fit, keep)) for o in options]
    seen = _reweighted(seen, same)
    tried = _compared(seen, same, how.folds, how.progress)
    return tried, choose(seen, tried, SURELY).fit.state.camera.model


def _lens_on_boards(found: _Solved, tried: list[Option], how: _How) -> tuple[list[Option], str]:
    """Return the lenses tried, fitted to boards with their corners as they were found and warps that are free again,
    and the camera model that then shows the views best."""
    observations, kept = found.observations, found.chosen.fit.kept
    state = found.chosen.fit.state.with_corners_held()
    options = []
    for model in dict.fromkeys(option.fit.state.camera.model for option in tried):
        # A model's size is told by flat boards well enough.
        best = choose(observations, [o for o in tried if o.fit.state.camera.model == model], SURELY)
        start = replace(state, camera=best.fit.state.camera)
        # The scatter that priors are weighed by is known after the first round.
        fit = fit_kept(observations, fit_kept(observations, start, kept).state, kept)
        options.append(replace(best, name=f"{best.name}, boards as found", fit=fit, heldout=None))
    # What does not even show the images that it was fitted to as well as another one predicts them is no better.
    options.sort(key=lambda o: o.fit.rms_px)
    compared: list[Option] = []
    for option in options:
        if all(option.fit.rms_px <= (o.heldout_px or np.inf) for o in compared):
            compared.append(replace(option, heldout=heldout_squares(observations, option.fit, how.folds)))
    return compared, choose(observations, compared, SURELY).fit.state.camera.model


def _others(observations: Observations, tried: list[Option], model: str) -> list[Candidate]:
    """Return the lenses tried but those of the `model` chosen, against the best of those."""
    own = [option for option in tried if option.fit.state.camera.model == model]
    if not own:
        return []
    against = choose(observations, own, SURELY)
    return described([*(o for o in tried if o not in own), against], against)[:-1]


def _of_views(observations: Observations, fit: Fit, keep: BoolArray) -> Fit:
    """Return the fit of the views to keep (V,), `observations`, from that of all of them."""
    chosen = np.flatnonzero(keep)
    return fit_kept(observations, fit.state.subset(chosen), fit.kept[chosen], settle=True)


def _agreeing(observations: Observations, options: list[Option]) -> tuple[BoolArray, tuple[tuple[str, str], ...]]:
    """Return which views to keep, and the reason for each that goes, judged by the model with the least scatter."""
    best = _best(observations, options)
    kept = best.fit.kept.sum(axis=1)
    total = observations.present.sum(axis=1)
    keep = kept >= np.maximum(MIN_KEPT_SHARE * total, 4)
    reasons = tuple(
        (view.image, f"only {k} of {n} corners of board '{view.board.board_id}' agree with the other views; retake it")
        for view, k, n, ok in zip(observations.views, kept, total, keep, strict=True)
        if not ok
    )
    if not keep.any():
        raise DegenerateError("calibration: no view agrees with the others; check the board's size and the images")
    return keep, reasons


def _best(observations: Observations, options: list[Option]) -> Option:
    """Return the option with the least scatter."""
    if len(options) == 1:
        return options[0]
    return min(options, key=lambda o: robust_sigma(o.fit, observations))


def _reweighted(observations: Observations, options: list[Option]) -> Observations:
    """Return the observations with weights that count the error which the best model leaves to all corners alike."""
    if float(np.ptp(observations.sigma_px[observations.present])) == 0.0:
        return observations
    best = _best(observations, options)
    squared = (best.fit.residuals.px**2).sum(axis=-1)
    return observations.with_common_error(squared, best.fit.kept)


def _compared(observations: Observations, options: list[Option], folds: int, progress: Progress) -> list[Option]:
    """Return the options refitted to the same corners, with their held-out errors, where they are not yet."""
    sigma = [robust_sigma(o.fit, observations) for o in options] if len(options) > 1 else [0.0]
    near = [o.fit.kept for o, s in zip(options, sigma, strict=True) if s <= COMPARABLE * min(sigma)]
    kept = np.any(near, axis=0)
    out = []
    unequal = float(np.ptp(observations.weight[observations.present])) > 0.0
    for i, option in enumerate(options):
        progress("cross-validation", i, len(options))
        if option.heldout is not None and (option.fit.kept == kept).all():
            out.append(option)
            continue
        same = (option.fit.kept == kept).all() and not unequal
        fit = option.fit if same else fit_kept(observations, option.fit.state, kept)
        out.append(replace(option, fit=fit, heldout=heldout_squares(observations, fit, folds)))
    progress("cross-validation", len(options), len(options))
    return out


def _fit_shapes(observations: Observations, flat: Option, board: str) -> tuple[Observations, Option, dict[str, Fit]]:
    """Return the shapes fitted, and views and flat boards with every board that looks the same turned numbered from the
    same end, where the shapes tell."""
    fits = fit_shapes(observations, flat.fit, board)
    for quarter_turns in (1, 2):
        *_, richest = fits.values()
        views = turned_views(observations, richest, quarter_turns)
        if views.any():
            observations, state = with_views_turned(observations, flat.fit.state, views, quarter_turns)
            data = normal_equations(observations, state, flat.fit.weight(observations))
            flat = replace(flat, fit=replace(flat.fit, state=state, data=data))
            fits = fit_shapes(observations, flat.fit, board)
    return observations, flat, fits


def _shapes(
    observations: Observations, fits: dict[str, Fit], board: str, folds: int, progress: Progress
) -> tuple[list[Option], list[Candidate]]:
    """Return the shapes in the running, and what was not tried."""
    options = [Option(f"board {kind}", fit) for kind, fit in fits.items()]
    spared = []
    if board == "auto" and "released" not in fits:
        reason = "not tried: corners stray from the warp by no more than chance"
        spared.append(Candidate("board released", 0, float("nan"), None, False, reason))
    return _compared(observations, options, folds, progress), spared
