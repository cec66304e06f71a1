"""The sentinel on real pairs of textured scenes, without boards: see `bench_sentinel.py`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

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
from rigkit.validation.sentinel.epipolar import PairMatches, check_matches, matches_say, scene_matches
from rigkit.validation.sentinel.evidence import FreshView, Watched, evidence_of
from rigkit.validation.sentinel.judge import SentinelCheck
from sentinel.tally import SCENE_TURNED_DEG, tell, turned

BOARD = Board("b", 9, 6, 25.0, 25.0)
BASELINE_MM = 100.0
"""Pairs have no scale of their own."""
BOARD_VIEWS, BOARD_SIGMA_PX = 20, 0.1
"""How sure published cameras and mounts are taken to be: as so many pictures of a board, planned for each camera, with
such corners would make them."""
UNSURE = 100.0
"""So many times less sure is a calibration that its own scenes are to correct first: EuRoC's left lens is off by 1 to
2 px as published, where boards would leave 0.02."""
CORRECTIONS = 4


@dataclass(frozen=True, eq=False, slots=True)
class ScenePair:
    """A real pair: the rig as published, and its matches."""

    name: str
    group: str
    rig: Watched
    matches: PairMatches


def pairs(data: Path, seeds: int) -> None:
    """Real pairs: the pose as published, and as if the mount had turned since. Where there are several pairs of one
    rig, they are also checked against the rig as all others correct it: published calibrations are not exact."""
    found: dict[str, list[SentinelCheck]] = {"nothing": [], "rotation": []}
    corrected: dict[str, list[SentinelCheck]] = {"nothing": [], "rotation": []}
    every = [_pair(entry, data) for entry in json.loads((data / "scenes/pairs.json").read_text())]
    for pair in every:
        _check(pair, pair.rig, seeds, found)
        same = [p.matches for p in every if p.group == pair.group and p is not pair and _same(p.rig, pair.rig)]
        if len(same) > 1:
            _check(pair, _corrected(pair.rig, same), seeds, corrected)
    for title, checks in (("as published", found), ("as the other pairs correct it", corrected)):
        for what, own in checks.items():
            tell(f"pairs, {title}: {what}", own, what)


def _pair(entry: dict[str, object], data: Path) -> ScenePair:
    cameras = tuple(_camera(entry[key]) for key in ("camera1", "camera2"))
    direction = unit(np.array(entry["cam2_from_cam1_t_direction"], dtype=np.float64))
    true = Rigid3(np.array(entry["cam2_from_cam1_R"]), BASELINE_MM * direction)
    images = [read_image(data / "scenes" / str(entry[key])) for key in ("image1", "image2")]
    size = sum(camera.parameters.size for camera in cameras) + 6
    rig = Watched(
        names=("left", "right"),
        cameras=cameras,
        cam_from_rig=(Rigid3.identity(), true),
        covariance=np.eye(size),
        sigma_px=BOARD_SIGMA_PX,
    )
    rig = replace(rig, covariance=_as_boards_tell(rig))
    return ScenePair(str(entry["name"]), str(entry["set"]), rig, scene_matches(rig, (0, 1), *images))


def _camera(told: object) -> Camera:
    assert isinstance(told, list)
    kind, size, numbers = told
    return camera_model(kind)(tuple(size), np.array(numbers))


def _same(a: Watched, b: Watched) -> bool:
    """Say whether two rigs are one: cameras and mounts."""
    return bool(np.allclose(a.cam_from_rig[1].matrix(), b.cam_from_rig[1].matrix()))


def _as_boards_tell(rig: Watched) -> FloatArray:
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


def _corrected(rig: Watched, matches: Sequence[PairMatches]) -> Watched:
    """Return a rig as scenes correct it. They share their errors: together they count as one."""
    before = covariance_of(UNSURE**2 * rig.covariance)
    change, now = np.zeros(rig.layout.count), rig
    for _ in range(CORRECTIONS):
        said = matches_say(now, matches)
        share = len(matches) * said.variance_px2
        covariance = covariance_of(before + said.information.sum(axis=0) / share)
        change = change + covariance @ (said.score.sum(axis=0) / share - before @ change)
        now = replace(rig.changed(change), covariance=covariance)
    return now


def _check(pair: ScenePair, rig: Watched, seeds: int, found: dict[str, list[SentinelCheck]]) -> None:
    check = check_matches(rig, [pair.matches])
    found["nothing"].append(check)
    said = f"{check.rms_px:.3f} px ({check.expected_px:.3f}), chance {check.chance:.2g}, {check.change}"
    print(f"   {pair.group} {pair.name}: {said}", flush=True)
    for seed in range(seeds):
        told = turned(rig.cam_from_rig[1], SCENE_TURNED_DEG, np.random.default_rng([seed, 23]))
        off = replace(rig, cam_from_rig=(rig.cam_from_rig[0], told))
        found["rotation"].append(check_matches(off, [pair.matches]))
