"""Targets on which views disagree: what sharing a pose costs, which cost is no chance, and taking such views apart.

The limits rest on rigs of 2 and 3 cameras and 3 to 25 frames: 3000 clean ones with 0.05 to 0.5 px of noise, and 2200
of boards bumpy by 0.15 mm that count as flat. There the cost of sharing reaches 2.0 times sigma by noise and 3.5 times
by bumps, the distance before the joint solve 7.8 times the usual. Where a board was moved by 1 mm between two
exposures, at 0.2 px of noise, sharing costs 4 to 8 times sigma among ten frames; moved by 10 mm it stands more than 22
times the usual distance apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rigkit.calibration.rig.solving.state import Key, RigObservations, RigState
from rigkit.calibration.rig.views.observations import FrameObservations
from rigkit.calibration.solving.solver import Solution
from rigkit.core.printing import digits

MAX_DISTANCE_RATIO = 12.0
"""Before the joint solve a board's pose in one image may be off by some pixels in the other: only more than this many
times the usual distance is a board that moved. Less is left to the joint solve, which sees it better."""
DISAGREES = 3.5
"""After it, sharing a pose costs a target six numbers for every view but one: on average sigma each. More than this
many times sigma (or the usual, where lens and board are not quite what the models say) is no chance."""
MIN_PX = 0.02
"""No corner is better than this: without noise the usual residual is rounding, and many times that is rounding too."""
FEW = 12
"""Among so few targets a bad one can hide: it pulls the mounts to itself, and all look bad."""


def shared_keys(seen: Sequence[FrameObservations]) -> dict[Key, int]:
    """Return the targets of which several views share a pose, and how many."""
    count = Counter(entry.key for own in seen for entry in own.values())
    return {key: n for key, n in count.items() if n > 1}


def cost_of_sharing(
    observations: RigObservations, solution: Solution[RigState], seen: Sequence[FrameObservations]
) -> dict[Key, float]:
    """Return what it costs every shared target that its views have one pose, px^2 for each of the six numbers that
    every view but one gives up. A view that is bad in itself is no reason to distrust the moment."""
    poses = len(observations.keys)
    alone, views = np.zeros(poses), np.zeros(poses)
    for c, own in enumerate(seen):
        weight, frame, camera = observations.weights[c], observations.frame[c], observations.cameras[c]
        squared = np.zeros(weight.shape)
        squared[camera.present] = np.concatenate([e.squared_px for e in own.values()])
        np.add.at(alone, frame, (weight**2 * squared).sum(axis=1))
        np.add.at(views, frame, 1.0)
    excess = np.maximum(solution.normal.costs - alone, 0.0) / np.maximum(6.0 * (views - 1.0), 1.0)
    return {key: float(e) for key, e, n in zip(observations.keys, excess, views, strict=True) if n > 1.0}


def typical_distance_px(observations: RigObservations, cost: Mapping[Key, float]) -> float:
    """Return how far apart, rms over corners, views that share a pose usually see them, px, from what sharing costs."""
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
    """Return the usual cost, px^2: the lower of two in the middle, so that of two targets the worse is the bad one; or
    the mean, where all are taken for good."""
    ordered = sorted(cost.values()) or [0.0]
    typical = float(np.mean(ordered)) if mean else ordered[(len(ordered) - 1) // 2]
    return max(typical, max(sigma_px, MIN_PX) ** 2)


def bad_ones(cost: Mapping[Key, float], typical: float) -> list[Key]:
    """Return the targets that cost more than chance; of several the worst: they may be why the others look bad."""
    worst = max(cost.values(), default=0.0)
    return [key for key in sorted(cost) if cost[key] > max(DISAGREES**2 * typical, 0.25 * worst)]


def masked(cost: Mapping[Key, float], sigma_px: float) -> bool:
    """Say whether one of few targets may be bad although none stands out."""
    worst = max(cost.values(), default=0.0)
    return 2 < len(cost) <= FEW and worst > DISAGREES**2 * max(sigma_px, MIN_PX) ** 2


def part_far(seen: Sequence[FrameObservations], off_px: Mapping[Key, float]) -> list[tuple[str, str, str]]:
    """Part the targets whose views put them far apart, by `off_px`; return (frame, target, reason)."""
    shared = shared_keys(seen)
    typical = max(float(np.median([off_px[key] for key in shared])) if shared else 0.0, MIN_PX)
    worst = max((off_px[key] for key in shared), default=0.0)
    out = []
    for key in sorted(shared):
        if off_px[key] > max(MAX_DISTANCE_RATIO * typical, 0.5 * worst):
            words = f"by {digits(off_px[key])} px, {off_px[key] / typical:.0f} times the usual"
            out.append((*key, why(seen, key, words)))
            part(seen, key)
    return out


def why(seen: Sequence[FrameObservations], key: Key, how: str) -> str:
    """Return in words why a target is left out."""
    cameras = [k for k, own in enumerate(seen) if any(e.key == key for e in own.values())]
    if len(cameras) > 1:
        return (
            f"the cameras disagree on where it is ({how}); the board or the rig moved between the exposures, or they "
            "are not of one moment"
        )
    return f"its boards disagree on where it is ({how}); one of them was moved against the others"


def part(seen: Sequence[FrameObservations], key: Key) -> None:
    """Give every view of the target a pose of its own: they still support their camera's intrinsics."""
    for k, own in enumerate(seen):
        for place, entry in own.items():
            if entry.key == key:
                own[place] = replace(entry, key=(f"{entry.frame}, camera {k + 1} alone", entry.board_id))
