"""`rigkit check` on real pairs of textured scenes, without boards: see `bench_check.py`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from checking.tally import SCENE_TURNED_DEG, tell, turned
from rigkit.cameras.base import Camera
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import unit
from rigkit.io.media.images import read_image
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import covariance_of, plan_views
from rigkit.validation.monitoring.baseline import check_since
from rigkit.validation.monitoring.epipolar import PairMatches, check_matches, evidence_of_matches, scene_matches
from rigkit.validation.monitoring.evidence import FreshView, Monitored, evidence_of
from rigkit.validation.monitoring.verdict import CalibrationCheck

BOARD = Board("b", 9, 6, 25.0, 25.0)
BASELINE_MM = 100.0
"""Pairs have no scale of their own."""
BOARD_VIEWS, BOARD_SIGMA_PX = 20, 0.1
"""How sure published cameras and mounts are taken to be: as so many pictures of a board, planned for each camera, with
such corners would make them."""


@dataclass(frozen=True, eq=False, slots=True)
class ScenePair:
    """A real pair: the rig as published, and its matches."""

    name: str
    group: str
    rig: Monitored
    matches: PairMatches


def pairs(data: Path, seeds: int) -> None:
    """Real pairs: the pose as published, and as if the mount had turned since. Where there are several pairs of one
    rig, they are also checked for what moved since all others: published calibrations are not exact."""
    found: dict[str, list[CalibrationCheck]] = {"nothing": [], "rotation": []}
    since: dict[str, list[CalibrationCheck]] = {"nothing": [], "rotation": []}
    every = [_pair(entry, data) for entry in json.loads((data / "scenes/pairs.json").read_text())]
    for pair in every:
        _check(pair, [], seeds, found)
        same = [p.matches for p in every if p.group == pair.group and p is not pair and _same(p.rig, pair.rig)]
        if len(same) > 1:
            _check(pair, same, seeds, since)
    for title, checks in (("as published", found), ("since the other pairs", since)):
        for what, own in checks.items():
            tell(f"pairs, {title}: {what}", own, what)


def _pair(entry: dict[str, object], data: Path) -> ScenePair:
    cameras = tuple(_camera(entry[key]) for key in ("camera1", "camera2"))
    direction = unit(np.array(entry["cam2_from_cam1_t_direction"], dtype=np.float64))
    true = Rigid3(np.array(entry["cam2_from_cam1_R"]), BASELINE_MM * direction)
    images = [read_image(data / "scenes" / str(entry[key])) for key in ("image1", "image2")]
    size = sum(camera.parameters.size for camera in cameras) + 6
    rig = Monitored(
        names=("left", "right"),
        cameras=cameras,
        cam_from_rig=(Rigid3.identity(), true),
        covariance=np.eye(size),
        sigma_px=BOARD_SIGMA_PX,
    )
    rig = replace(rig, covariance=_covariance_from_boards(rig))
    return ScenePair(str(entry["name"]), str(entry["set"]), rig, scene_matches(rig, (0, 1), *images))


def _camera(declared: object) -> Camera:
    assert isinstance(declared, list)
    kind, size, numbers = declared
    return camera_model(kind)(tuple(size), np.array(numbers))


def _same(a: Monitored, b: Monitored) -> bool:
    """Say whether two rigs are one: cameras and mounts."""
    return bool(np.allclose(a.cam_from_rig[1].matrix(), b.cam_from_rig[1].matrix()))


def _covariance_from_boards(rig: Monitored) -> FloatArray:
    """Return the covariance (T, T) of a rig that is calibrated with boards, planned for one camera after the other."""
    views: list[FreshView] = []
    for c, camera in enumerate(rig.cameras):
        known = Knowledge.guessed(camera, CornerError(BOARD_SIGMA_PX))
        plan = plan_views(known, [BOARD], projection_goal(camera), BOARD_VIEWS)
        for k, view in enumerate(plan.views):
            board_in_rig = rig.cam_from_rig[c].inverse() @ view.cam_from_board
            for other, (own, pose) in enumerate(zip(rig.cameras, rig.cam_from_rig, strict=True)):
                pixels, valid = own.project((pose @ board_in_rig).apply(BOARD.points()))
                valid &= own.on_image(pixels)
                if valid.sum() >= BOARD.corner_count // 2:
                    sigma = np.full(int(valid.sum()), BOARD_SIGMA_PX)
                    name = f"{c}-{k}"
                    views.append(
                        FreshView(name, other, BoardView(name, BOARD, BOARD.grid()[valid], pixels[valid], sigma))
                    )
    information = evidence_of(rig, views).information.sum(axis=0)
    return covariance_of(information / BOARD_SIGMA_PX**2)


def _check(
    pair: ScenePair, before: Sequence[PairMatches], seeds: int, found: dict[str, list[CalibrationCheck]]
) -> None:
    check = _judged(pair.rig, before, pair.matches)
    found["nothing"].append(check)
    message = f"{check.rms_px:.3f} px ({check.expected_px:.3f}), chance {check.chance:.2g}, {check.change}"
    print(f"   {pair.group} {pair.name}: {message}", flush=True)
    camera = pair.rig.cameras[1]
    for seed in range(seeds):
        turn = turned(Rigid3.identity(), SCENE_TURNED_DEG, np.random.default_rng([seed, 23])).rotation
        pixels, seen = camera.project(camera.unproject(pair.matches.pixels2)[0] @ turn.T)
        moved = replace(pair.matches, pixels1=pair.matches.pixels1[seen], pixels2=pixels[seen])
        found["rotation"].append(_judged(pair.rig, before, moved))


def _judged(rig: Monitored, before: Sequence[PairMatches], now: PairMatches) -> CalibrationCheck:
    if not before:
        return check_matches(rig, [now])
    return check_since(
        rig, lambda known: evidence_of_matches(known, before), lambda known: evidence_of_matches(known, [now])
    )
