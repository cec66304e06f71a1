"""Cameras with all candidate models fitted, and the choice among these, jointly for like cameras of a rig.

Fitting is the common part of calibrating a camera alone and in its rig. Results are cached, so that a second
calibration of the same images does not repeat them.

Models are compared on the same corners: with flat boards first and, as a board that is not flat biases the lens, again
with the board shapes that were found. Cameras of a rig with the same image size and nearly the same focal length are
taken to be of one make: their held-out errors are combined and all get the same model, unless the images of one
contradict it significantly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from rigkit.calibration.choosing.choice import (
    MIN_SIGMAS,
    FittedModel,
    HeldOut,
    choose,
    converged_ones,
    heldout_squares,
    models_of,
)
from rigkit.calibration.choosing.models_tried import (
    CandidateModel,
    ModelOutcome,
    Request,
    agreeing_views,
    cross_validated,
    fit_all,
    reweighted,
    solved,
    wanted_models,
)
from rigkit.calibration.result import Candidate
from rigkit.calibration.solving.fit import fit_kept, fit_other_lens
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.repeats import cluster_numbers
from rigkit.calibration.views.usable import usable_views
from rigkit.cameras.base import Camera
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError

SAME_FOCAL = 0.05
"""Relative difference of the focal lengths of lenses of one type: makers do not specify them more accurately."""


@contextmanager
def camera_named_in_errors(name: str, views: Sequence[BoardView]) -> Iterator[None]:
    """Add the camera's name to errors, and the cause where all images are near-duplicates."""
    try:
        yield
    except (InputError, DegenerateError) as error:
        words = str(error)
        images = [view.image for view in views]
        if isinstance(error, DegenerateError) and len(set(images)) > 1:
            place = cluster_numbers(images, [v.board.board_id for v in views], [v.pixels for v in views])
            if not place.any():
                words = (
                    f"calibration: all {len(set(images))} images show the board at the same pose and count as "
                    f"one; move it between images ({words})"
                )
        if not name and words == str(error):
            raise
        raise type(error)(f"camera '{name}': {words}" if name else words) from error


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CandidateFits:
    """A camera with all candidate models fitted to its views.

    Attributes
    ----------
    name : name of the camera in messages, "" for a single camera.
    request : options of the calibration.
    views, dropped, observations : all views, (image, reason) of those not usable, and the usable ones as arrays.
    wanted, options, failed : models to fit, those fitted, and those that failed.
    tried : the options compared on flat boards; with a single model the options themselves.
    """

    name: str
    request: Request
    views: Sequence[BoardView]
    dropped: tuple[tuple[str, str], ...]
    observations: Observations
    wanted: list[CandidateModel]
    options: list[FittedModel]
    failed: list[Candidate]
    tried: list[FittedModel]
    _outcomes: dict[str, ModelOutcome] = field(default_factory=dict)
    _on_boards: dict[str, dict[str, FittedModel]] = field(default_factory=dict)

    def outcome_of(self, model: str) -> ModelOutcome:
        """Return the outcome of a camera model."""
        if model not in self._outcomes:
            with camera_named_in_errors(self.name, self.observations.views):
                own = [option for option in self.options if option.model == model]
                wanted = [one for one in self.wanted if one.camera.model == model]
                self._outcomes[model] = solved(self.observations, own, wanted, self.failed, self.request)
        return self._outcomes[model]

    def on_boards_of(self, model: str, names: Sequence[str]) -> list[FittedModel]:
        """Return the options of the given `names`, compared on the board shapes that a camera model found."""
        done = self._on_boards.setdefault(model, {})
        return lenses_on_boards(self.outcome_of(model), self.tried, names, self.request, done)

    def for_request(self, name: str, views: Sequence[BoardView], request: Request) -> Self | None:
        """Return this camera under another name and pupil option, sharing the cached results; None where the views or
        the other options differ."""
        then, now = ((h.size_px, h.model, h.degree, h.board, h.folds) for h in (self.request, request))
        if then != now or len(views) != len(self.views) or not all(map(_same, self.views, views)):
            return None
        return replace(self, name=name, request=request)


def _same(a: BoardView, b: BoardView) -> bool:
    """Return whether two views are equal; they may be copies from another process."""
    arrays = ((a.grid, b.grid), (a.pixels, b.pixels), (a.sigma_px, b.sigma_px), (a.points(), b.points()))
    named = (a.image, a.board.board_id) == (b.image, b.board.board_id)
    return named and all(np.array_equal(x, y) for x, y in arrays)


def fit_candidates(name: str, views: Sequence[BoardView], request: Request) -> CandidateFits:
    """Return a camera with all models of `request` fitted; raises as `calibrate`, with the camera's name."""
    with camera_named_in_errors(name, views):
        wanted = wanted_models(request)
        used, dropped = usable_views(views, request.size_px)
        observations = Observations.from_views(used)
        options, failed = fit_all(observations, request, wanted)
        several = len(models_of(options)) > 1
        tried = lenses_on_flat_boards(observations, options, request) if several else options
    return CandidateFits(
        name=name,
        request=request,
        views=views,
        dropped=dropped,
        observations=observations,
        wanted=wanted,
        options=options,
        failed=failed,
        tried=tried,
    )


@dataclass(frozen=True, eq=False, slots=True)
class ModelChoice:
    """The chosen camera model, and the probability of each option, by name, to be the best one."""

    model: str
    likely: dict[str, float]


def lenses_on_flat_boards(
    observations: Observations, options: list[FittedModel], request: Request
) -> list[FittedModel]:
    """Return the options refitted to the same corners of the views that agree with them, with held-out errors."""
    keep, _ = agreeing_views(observations, options)
    chosen = np.flatnonzero(keep)
    seen = observations.subset(chosen)
    if not keep.all():
        fits = [fit_kept(seen, o.fit.state.subset(chosen), o.fit.kept[chosen], settle=True) for o in options]
        options = [replace(option, fit=fit) for option, fit in zip(options, fits, strict=True)]
    seen = reweighted(seen, options)
    return cross_validated(seen, options, request, "models")


def best_sizes(cameras: Sequence[Sequence[FittedModel]]) -> list[str]:
    """Return the name of the best size of each model, compared with flat boards, for a group of like cameras."""
    sizes = []
    for model in models_of([option for options in cameras for option in options]):
        own = [[option for option in options if option.model == model] for options in cameras]
        evidence = HeldOut.of(own)
        if evidence.names:
            sizes.append(evidence.chosen())
        else:
            sizes += {choose(options, MIN_SIGMAS).name for options in own if options}
    return sizes


def lenses_on_boards(
    found: ModelOutcome,
    tried: Sequence[FittedModel],
    names: Sequence[str],
    request: Request,
    done: dict[str, FittedModel],
) -> list[FittedModel]:
    """Return the options of the given `names`, fitted with the released corners found held and warps free. `done`
    caches the results by name."""
    observations, kept = found.observations, found.chosen.fit.kept
    state = found.chosen.fit.state.with_corners_held()
    for option in tried:
        if option.name in names and option.name not in done:
            start = replace(state, camera=option.fit.state.camera)
            fit = fit_other_lens(observations, start, kept)
            done[option.name] = replace(option, name=f"{option.name}, boards as found", fit=fit, heldout=None)
    # An option with a training error above another's held-out error cannot be the best.
    order = sorted((o.name for o in tried if o.name in names), key=lambda name: done[name].fit.rms_px)
    fitted: list[FittedModel] = []
    for name in order:
        if all(done[name].fit.rms_px <= (o.heldout_px or np.inf) for o in fitted):
            if done[name].heldout is None:
                done[name] = replace(done[name], heldout=heldout_squares(observations, done[name].fit, request.folds))
            fitted.append(done[name])
    return list(converged_ones(fitted))


def choose_lenses(cameras: Sequence[Sequence[FittedModel]]) -> list[ModelChoice]:
    """Return the model of each of a group of like cameras, from their combined held-out errors; a camera that
    contradicts the common model significantly gets its own."""
    own = [choose(options, MIN_SIGMAS) for options in cameras]
    each = [HeldOut.of([options]) for options in cameras]
    out = [ModelChoice(option.model, evidence.likely()) for option, evidence in zip(own, each, strict=True)]
    together = [k for k, evidence in enumerate(each) if evidence.names]
    while len(together) > 1:
        evidence = HeldOut.of([cameras[k] for k in together])
        if not evidence.names:
            break
        name = evidence.chosen()
        agree = [k for k in together if not each[k].contradicts(name, own[k].name)]
        if agree == together:
            model = next(o for o in cameras[together[0]] if o.name == name).model
            for k in together:
                out[k] = ModelChoice(model, evidence.likely())
            break
        together = agree
    return out


def like_cameras(cameras: Sequence[Camera]) -> list[list[int]]:
    """Return groups of like cameras, as lists of their indices: same image size, nearly the same focal length."""
    groups: list[list[int]] = []
    for k, camera in enumerate(cameras):
        for group in groups:
            first = cameras[group[0]]
            if first.size_px == camera.size_px and abs(camera.focal_px / first.focal_px - 1.0) <= SAME_FOCAL:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups
