"""Outlier targets of a rig: the cost of sharing a pose, its significance, and separating such views.

The limits were set on SIMULATED rigs of 2 and 3 cameras and 3 to 25 frames: 3000 clean ones with 0.05 to 0.5 px of
noise, and 2200 with boards bumpy by 0.15 mm that count as flat. There the cost of sharing reaches 2.0 times sigma by
noise and 3.5 times by bumps, the distance before the joint solve 7.8 times the typical one. If a board was moved by
1 mm between two exposures, at 0.2 px of noise, sharing costs 4 to 8 times sigma with ten frames; moved by 10 mm its
distance is more than 22 times the typical one.

A view alone follows the departures of its lens from its model with the pose of its board, each in its own way. So views
that share a pose may disagree as if the images of a frame were not taken at one moment. But a few numbers of each lens,
the same in all images, explain that (`cost_with_departures`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.certainty.departures import LARGEST_PX
from rigkit.calibration.certainty.displaced import with_amounts
from rigkit.calibration.rig.solving.solver import solve_rig
from rigkit.calibration.rig.solving.state import Key, RigObservations, RigState
from rigkit.calibration.rig.views.observations import FrameObservations
from rigkit.calibration.solving.solver import Solution
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import far_camera, with_pupil_of
from rigkit.core.arrays import FloatArray
from rigkit.core.printing import digits
from rigkit.kernels.departures import DISPLACEMENTS, POSE

MAX_DISTANCE_RATIO = 12.0
"""Distance over the typical distance, before the joint solve, from which a board has moved: its pose in one image may
be wrong by some pixels in the other. Smaller movements are left to the joint solve, which is more accurate."""
DISAGREES = 3.5
"""Cost of sharing, after the joint solve, over sigma (or the typical cost, with errors of lens or board model), from
which it is not chance. Sharing a pose removes six parameters for every view but one, and costs sigma each on
average."""
MIN_PX = 0.02
"""Smallest standard deviation of a corner: without noise residuals are rounding."""
FEW_TARGETS = 12
"""With no more targets than this an outlier may be masked: it shifts the mounts, and all look bad."""


def shared_keys(seen: Sequence[FrameObservations]) -> dict[Key, int]:
    """Return the targets whose pose several views share, and the number of views."""
    count = Counter(entry.key for own in seen for entry in own.values())
    return {key: n for key, n in count.items() if n > 1}


def cost_of_sharing(
    observations: RigObservations, solution: Solution[RigState], seen: Sequence[FrameObservations]
) -> dict[Key, float]:
    """Return for every shared target the increase of the cost by sharing one pose, px^2 for each of the six parameters
    that every view but one gives up. Residuals of a view that is bad by itself do not count."""
    alone = np.zeros(len(observations.keys))
    for c, own in enumerate(seen):
        weight, frame, camera = observations.weights[c], observations.frame[c], observations.cameras[c]
        squared = np.zeros(weight.shape)
        squared[camera.present] = np.concatenate([e.squared_px for e in own.values()])
        np.add.at(alone, frame, (weight**2 * squared).sum(axis=1))
    return excess_cost(observations, solution.normal.costs, alone)


def excess_cost(observations: RigObservations, shared: FloatArray, alone: FloatArray) -> dict[Key, float]:
    """Return `cost_of_sharing` from the costs (F,) of all poses, `shared` and for each view `alone`."""
    views = np.bincount(np.concatenate(observations.frame), minlength=len(shared))
    excess = np.maximum(shared - alone, 0.0) / np.maximum(6.0 * (views - 1.0), 1.0)
    return {key: float(e) for key, e, n in zip(observations.keys, excess, views, strict=True) if n > 1}


def typical_distance_px(observations: RigObservations, cost: Mapping[Key, float]) -> float:
    """Return the median distance, rms over corners, between views that share a pose, px, from the cost of sharing."""
    poses = len(observations.keys)
    corners, views = np.zeros(poses), np.zeros(poses)
    for weight, frame in zip(observations.weights, observations.frame, strict=True):
        np.add.at(corners, frame, (weight > 0.0).sum(axis=1))
        np.add.at(views, frame, 1.0)
    squared = [
        cost[key] * 6.0 * (n - 1.0) / count
        for key, n, count in zip(observations.keys, views, corners, strict=True)
        if key in cost and count
    ]
    return float(np.sqrt(np.median(squared))) if squared else 0.0


def typical_cost(cost: Mapping[Key, float], sigma_px: float, *, mean: bool = False) -> float:
    """Return the typical cost, px^2: the lower median, so that of two targets the worse one is the outlier; with `mean`
    the mean."""
    ordered = sorted(cost.values()) or [0.0]
    typical = float(np.mean(ordered)) if mean else ordered[(len(ordered) - 1) // 2]
    return max(typical, max(sigma_px, MIN_PX) ** 2)


def outlier_targets(cost: Mapping[Key, float], typical: float) -> list[Key]:
    """Return the targets whose cost is not chance, of several only the worst, which may affect the others."""
    worst = max(cost.values(), default=0.0)
    return [key for key in sorted(cost) if cost[key] > max(DISAGREES**2 * typical, 0.25 * worst)]


def outlier_may_be_hidden(cost: Mapping[Key, float], sigma_px: float) -> bool:
    """Return whether one of few targets may be an outlier although none stands out."""
    worst = max(cost.values(), default=0.0)
    return 2 < len(cost) <= FEW_TARGETS and worst > DISAGREES**2 * max(sigma_px, MIN_PX) ** 2


def separate_distant_views(
    seen: Sequence[FrameObservations], off_px: Mapping[Key, float]
) -> list[tuple[str, str, str]]:
    """Separate the views of targets with a large distance `off_px`; return (frame, target, reason) of each."""
    shared = shared_keys(seen)
    typical = max(float(np.median([off_px[key] for key in shared])) if shared else 0.0, MIN_PX)
    worst = max((off_px[key] for key in shared), default=0.0)
    out = []
    for key in sorted(shared):
        if off_px[key] > max(MAX_DISTANCE_RATIO * typical, 0.5 * worst):
            words = f"by {digits(off_px[key])} px, {off_px[key] / typical:.0f} times the median"
            out.append((*key, reason_left_out(seen, key, words)))
            separate_views(seen, key)
    return out


def reason_left_out(seen: Sequence[FrameObservations], key: Key, how: str) -> str:
    """Return words for why a target is left out."""
    cameras = [k for k, own in enumerate(seen) if any(e.key == key for e in own.values())]
    if len(cameras) > 1:
        return (
            f"the cameras disagree on its pose ({how}); board or rig moved between the exposures, or the images are "
            "not simultaneous"
        )
    return f"its boards disagree on its pose ({how}); one of them was moved relative to the others"


def separate_views(seen: Sequence[FrameObservations], key: Key) -> None:
    """Give every view of the target a separate pose: they still constrain their camera's intrinsics."""
    for k, own in enumerate(seen):
        for place, entry in own.items():
            if entry.key == key:
                own[place] = entry.alone(k)


def cost_with_departures(
    observations: RigObservations, solution: Solution[RigState], sigma_px: float
) -> dict[Key, float] | None:
    """Return `cost_of_sharing` where lenses may depart from their models, with poses shared and without: the amounts of
    all displacements are solved for as well, a priori with a standard deviation of LARGEST_PX. Boards keep their shape.

    None where it would say nothing: there are as many amounts as constraints from shared poses, or lags of cameras,
    which explain disagreement as well.
    """
    state = solution.state
    layout, views = state.layout(observations), sum(len(frame) for frame in observations.frame)
    places = sum(run is not None for run in (*layout.mounts, *layout.boards))
    constraints = POSE * (views - len(observations.keys) - places)
    if state.exposures is not None or constraints <= DISPLACEMENTS * len(state.cameras):
        return None
    cameras, priors = zip(*(_departing(camera, sigma_px) for camera in state.cameras), strict=True)
    held = replace(observations, shape=observations.shape.held(state.unknowns), held=priors)
    state = replace(state, cameras=cameras, unknowns=np.zeros(0))
    shared = solve_rig(held, state, sigma_px).normal.costs
    alone = np.zeros(len(shared))
    for c, frame in enumerate(observations.frame):
        np.add.at(alone, frame, solve_rig(*_separate(held, state, c), sigma_px).normal.costs)
    return excess_cost(observations, shared, alone)


def _departing(camera: Camera, sigma_px: float) -> tuple[Camera, tuple[FloatArray, FloatArray]]:
    """Return a camera with the amounts of its departures, and the prior mean and information of its parameters."""
    lens = with_amounts(far_camera(camera), np.eye(DISPLACEMENTS))
    moving = with_pupil_of(lens, camera)
    information = np.zeros(moving.parameters.size)
    information[lens.parameters.size - DISPLACEMENTS : lens.parameters.size] = (sigma_px / LARGEST_PX) ** 2
    return moving, (moving.parameters, np.diag(information))


def _separate(observations: RigObservations, state: RigState, c: int) -> tuple[RigObservations, RigState]:
    """Return the observations and the state of camera `c` alone, every view with a pose of its own."""
    alone, count = state.of_camera(c, observations), len(observations.frame[c])
    own = replace(
        observations,
        cameras=observations.cameras[c : c + 1],
        weights=observations.weights[c : c + 1],
        frame=(np.arange(count),),
        keys=tuple((str(k), "") for k in range(count)),
        places=(False,) * len(observations.places),
        held=observations.held[c : c + 1],
    )
    return own, RigState(
        cameras=state.cameras[c : c + 1],
        mount_rotation=np.eye(3)[None],
        mount_mm=np.zeros((1, 3)),
        frame_rotation=alone.rotation,
        frame_mm=alone.translation_mm,
        board_rotation=state.board_rotation,
        board_mm=state.board_mm,
        unknowns=state.unknowns,
    )
