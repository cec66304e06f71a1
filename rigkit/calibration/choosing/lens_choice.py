"""Choice of the camera model, jointly for like cameras of a rig.

Models are compared on the same corners: with flat boards first and, as a board that is not flat biases the lens, again
with the board shapes that were found. Cameras of a rig with the same image size and nearly the same focal length are
taken to be of one make: their held-out errors are combined and all get the same model, unless the images of one
contradict it significantly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from rigkit.calibration.choosing.models_tried import Request, agreeing_views, cross_validated, reweighted
from rigkit.calibration.choosing.one_model import ModelOutcome
from rigkit.calibration.solving.fit import fit_kept, fit_other_lens
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera

SAME_FOCAL = 0.05
"""Relative difference of the focal lengths of lenses of one type: makers do not specify them more accurately."""


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
