"""Which camera model shows the views of a camera best; twins, cameras that are alike, share one.

Models are compared on the same corners: with flat boards first, and, since boards that are not flat bend the lenses to
themselves, again with boards as they were found. Cameras of one rig with images of one size and (nearly) one focal
length are two pieces of one product: what the images of each say of the models is put together, and all get the same
model, unless the images of one contradict it clearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.choosing.choice import MIN_SIGMAS, FittedModel, HeldOut, choose, models_of, settled
from rigkit.calibration.choosing.heldout import heldout_squares
from rigkit.calibration.choosing.models_tried import Request, agreeing, compared, fit_of_views, reweighted
from rigkit.calibration.choosing.one_model import ModelOutcome
from rigkit.calibration.solving.fit import fit_other_lens
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera

SAME_FOCAL = 0.05
"""Lenses of one kind have focal lengths within this part of each other: makers state no more."""


@dataclass(frozen=True, eq=False, slots=True)
class ModelChoice:
    """The camera model chosen, and how likely each option is the best one, by name."""

    model: str
    likely: dict[str, float]


def lenses_on_flat_boards(
    observations: Observations, options: list[FittedModel], request: Request
) -> list[FittedModel]:
    """Return the options as they compare on the same corners of the views that agree with them."""
    keep, _ = agreeing(observations, options)
    seen = observations.subset(np.flatnonzero(keep))
    same = options if keep.all() else [replace(o, fit=fit_of_views(seen, o.fit, keep)) for o in options]
    seen = reweighted(seen, same)
    return compared(seen, same, request.folds, request.progress)


def best_sizes(cameras: Sequence[Sequence[FittedModel]]) -> list[str]:
    """Return the name of the best size of each model, as flat boards tell well enough, of cameras that are alike."""
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
    done: dict[str, FittedModel] | None = None,
) -> list[FittedModel]:
    """Return the lenses tried, those of the `names`, fitted to boards with their corners as they were found and warps
    that are free again. `done` are those that were fitted before, by name; what is fitted now comes to them."""
    observations, kept = found.observations, found.chosen.fit.kept
    state = found.chosen.fit.state.with_corners_held()
    done = {} if done is None else done
    for option in tried:
        if option.name in names and option.name not in done:
            start = replace(state, camera=option.fit.state.camera)
            fit = fit_other_lens(observations, start, kept)
            done[option.name] = replace(option, name=f"{option.name}, boards as found", fit=fit, heldout=None)
    # What does not even show the images that it was fitted to as well as another one predicts them is no better.
    order = sorted((o.name for o in tried if o.name in names), key=lambda name: done[name].fit.rms_px)
    judged: list[FittedModel] = []
    for name in order:
        if all(done[name].fit.rms_px <= (o.heldout_px or np.inf) for o in judged):
            if done[name].heldout is None:
                done[name] = replace(done[name], heldout=heldout_squares(observations, done[name].fit, request.folds))
            judged.append(done[name])
    return list(settled(judged))


def choose_lenses(cameras: Sequence[Sequence[FittedModel]]) -> list[ModelChoice]:
    """Return the model of each of some cameras that are alike: what their images say is put together, and who clearly
    contradicts the others has a lens of its own."""
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


def twins(cameras: Sequence[Camera]) -> list[list[int]]:
    """Return which cameras are alike, as lists of their numbers: images of one size, nearly one focal length."""
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
