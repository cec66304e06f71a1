"""Uncertainty of the model selection: the difference between models that the images support about as well.

The covariance of the parameters assumes that the chosen model is right. Where others have about the same held-out
error, each of them may be the better one, and the chosen lens is wrong by the difference. With their probabilities w_m

    Cov = Cov_chosen + sum_m w_m d_m d_m^T,

where d_m is the change of the chosen model's unknowns that fits it to model m where the boards were, after the free
rotation of the rays, together with the motions of the boards. Where one model is clearly the best all w_m are zero. A
board shape (flat, warped, released) is a model, too: the shape of a board in few images biases the lens.

Reference: S. T. Buckland, K. P. Burnham, N. H. Augustin, "Model selection: an integral part of inference", Biometrics
53 (1997), eq. 9, about the estimate chosen in place of the average.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.certainty.covariance import motion_of_world
from rigkit.calibration.certainty.uncertainty import step_to_lens
from rigkit.calibration.choosing.choice import FittedModel, HeldOut
from rigkit.calibration.result import Candidate, Rival
from rigkit.calibration.solving.fit import Fit, fit_other_lens
from rigkit.calibration.solving.poses import steps_between
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import far_camera, with_pupil_of
from rigkit.core.arrays import FloatArray, Rays, spread_indices
from rigkit.core.errors import DegenerateError, InputError

MIN_LIKELY = 0.05
"""A less probable model adds almost nothing to the covariance, however different it is."""
RAYS = 400
"""Number of corners at which a lens is fitted to another one."""


@dataclass(frozen=True, eq=False, slots=True)
class RivalFit:
    """A rival and its fit to the views."""

    rival: Rival
    state: State


def rival_fits(
    observations: Observations, chosen: Fit, options: Sequence[FittedModel], likely: Mapping[str, float]
) -> list[RivalFit]:
    """Return the `options` with a probability of at least MIN_LIKELY, fitted to the inliers of the chosen fit with its
    released corners held."""
    own = far_camera(chosen.state.camera)
    cameras = [far_camera(option.fit.state.camera) for option in options]
    alike = [same_model(camera, own) for camera in cameras]
    if not any(alike):
        # The chosen lens is among the options in another size.
        alike = [camera.model == own.model for camera in cameras]
    found = []
    for option, camera, same in zip(options, cameras, alike, strict=True):
        if same or likely.get(option.name, 0.0) < MIN_LIKELY:
            continue
        fit = with_other_lens(observations, chosen, camera)
        if fit is not None:
            found.append(RivalFit(Rival(option.name, far_camera(fit.state.camera), likely[option.name]), fit.state))
    return found


def with_other_lens(observations: Observations, chosen: Fit, camera: Camera) -> Fit | None:
    """Return the fit of another model to the inliers of the chosen fit with its released corners held, starting from a
    `camera` of that model; None where it fails."""
    start = replace(chosen.state.with_corners_held(), camera=with_pupil_of(camera, chosen.state.camera))
    try:
        return fit_other_lens(observations, start, chosen.kept)
    except (InputError, DegenerateError):
        return None


def same_model(one: Camera, other: Camera) -> bool:
    """Return whether two cameras are of one model and size."""
    return one.model == other.model and one.parameters.size == other.parameters.size


def rival_shapes(chosen: FittedModel, shapes: Sequence[FittedModel]) -> list[RivalFit]:
    """Return the fits with the other board `shapes` that have a probability of at least MIN_LIKELY."""
    likely = HeldOut.of([shapes]).likely()
    return [
        RivalFit(
            Rival(f"board {one.fit.state.shape.kind}", far_camera(one.fit.state.camera), likely[one.name]),
            one.fit.state,
        )
        for one in shapes
        if one.name != chosen.name and likely.get(one.name, 0.0) >= MIN_LIKELY
    ]


def with_rivals(candidates: Sequence[Candidate], rivals: Sequence[Rival]) -> tuple[Candidate, ...]:
    """Return the candidates, with the probability added to the reason of those that are rivals."""
    likely = {_lens(rival.name): f"{100.0 * rival.likely:.0f} %" for rival in rivals}
    counted = "of bootstrap samples of the images; its difference is included in all sigmas"
    return tuple(
        one
        if one.chosen or _lens(one.name) not in likely
        else replace(one, reason=f"{one.reason}; the best in {likely[_lens(one.name)]} {counted}")
        for one in candidates
    )


def _lens(name: str) -> str:
    """Return the name of a lens without the boards it was fitted on."""
    return name.partition(",")[0]


def between_models(
    observations: Observations, chosen: Fit, rivals: Sequence[RivalFit], sigmas: FloatArray
) -> FloatArray:
    """Return the rivals' contribution to the covariance (P + 6, P + 6) of the chosen camera's parameters, a moving
    pupil's included, and of the mean motion of the boards; `sigmas` (P,) are the parameters' standard deviations
    without it."""
    p = chosen.state.camera.parameters.size
    out = np.zeros((p + 6, p + 6))
    if not rivals:
        return out
    points, _ = chosen.state.points_in_cam(observations)
    rays = spread_rays(points[chosen.kept])
    here = chosen.state
    for one in rivals:
        step, turn = step_to_lens(here.camera, one.state.camera, rays, sigmas)
        # Poses in the frame of the chosen lens.
        there = (turn.T @ one.state.rotation, one.state.translation_mm @ turn)
        moved = steps_between((here.rotation, here.translation_mm), there)
        motions = motion_of_world(here.translation_mm) @ moved[..., None]
        direction = np.concatenate([step, motions[chosen.kept.any(axis=1), :, 0].mean(axis=0)])
        out += one.rival.likely * np.outer(direction, direction)
    return out


def spread_rays(points_in_cam: FloatArray) -> Rays:
    """Return unit rays (M, 3) to up to 400 of the points (N, 3), spread over their angles with the axis."""
    rays = points_in_cam / np.linalg.norm(points_in_cam, axis=-1, keepdims=True)
    chosen = spread_indices(len(rays), RAYS)
    return np.asarray(rays[np.argsort(rays[:, 2])[chosen]])
