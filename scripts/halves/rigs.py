"""Calibrations from two halves of a rig's frames: do baselines and mounts differ by what their sigmas predict?

Frames are split at random, every second one apart, and in time: neighbouring frames may err alike, which only the last
shows. With the model "auto" boards may have any shape, and each half measures the boards of the other
(`halves.lengths`).
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from halves.comparing import seeds_of
from halves.lengths import Measured, both_see, measured, share
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.compare import compare_mounts
from rigkit.calibration.rig.mounted import MountedCameras
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.core.identifiers import natural_key
from rigkit.io.corners.corner_cache import source_hash
from rigkit.io.manifests.rig_session import RigSession, frames_of_images
from rigkit.io.manifests.session import Session
from rigkit.workflows.fetch import public_sets
from rigkit.workflows.inputs.corners import session_corners, session_views
from rigkit.workflows.inputs.frames import with_frames
from rigkit.workflows.options.cameras import Cache

RigViews = dict[str, list[tuple[str, BoardView]]]
RIGS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "bouguet-rig": ("bouguet-stereo", {"left": "left*.jpg", "right": "right*.jpg"}),
    "bumblebee-rig": ("bumblebee2", {"left": "left*.jpg", "right": "right*.jpg"}),
    "charuco-rig": ("charuco-stereo", {"left": "left*", "right": "right*"}),
    "multicam-02": ("multicam-video", {"cam_0": "cam_0.mp4", "cam_2": "cam_2.mp4"}),
    "multicam-023": ("multicam-video", {f"cam_{k}": f"cam_{k}.mp4" for k in (0, 2, 3)}),
}
"""Of a rig the set of `datasets/public`, and its cameras with their images or video."""


def load_rig(name: str, data: Path, cache: Path) -> tuple[RigViews, dict[str, tuple[int, int]]]:
    """Return what the cameras of a rig show in each frame, and the sizes of their images."""
    kept = cache / f"{name}-{source_hash()[:20]}.pickle"
    if not kept.is_file():
        described, path = public_sets()[RIGS[name][0]], cache / f"{name}.toml"
        cameras = {
            camera: Session(
                path=path,
                images=tuple(sorted((data / described.folder).glob(pattern))),
                boards=described.boards,
                model="auto",
                degree=None,
                board_shape="auto",
                camera=camera,
            )
            for camera, pattern in RIGS[name][1].items()
        }
        rig = with_frames(RigSession(path=path, cameras=cameras, frames="number", baselines=()))
        assert isinstance(rig, RigSession)
        corners = {camera: session_corners(own, cache=Cache.UPDATE) for camera, own in rig.cameras.items()}
        frames = frames_of_images({camera: list(own.found) for camera, own in corners.items()}, rig.frames)
        views, sizes = {}, {}
        for camera, own in rig.cameras.items():
            seen, sizes[camera], _ = session_views(own, corners[camera])
            views[camera] = [(frames[camera][view.image], view) for view in seen]
        kept.write_bytes(pickle.dumps((views, sizes)))
    found: tuple[RigViews, dict[str, tuple[int, int]]] = pickle.loads(kept.read_bytes())
    return found


def split_rig(name: str, data: Path, cache: Path, splits: int, model: str, seed: int) -> None:
    """Print how far apart the baselines and mounts of halves are, and how many of their lengths are within bounds."""
    views, sizes = load_rig(name, data, cache)
    frames = sorted({frame for own in views.values() for frame, _ in own}, key=natural_key)
    half, rng = len(frames) // 2, np.random.default_rng(seeds_of(name, seed))
    parts = {"in time": (frames[:half], frames[half:]), "every second": (frames[::2], frames[1::2])}
    for k in range(splits):
        order = [frames[i] for i in rng.permutation(len(frames))]
        parts[f"random {k}"] = order[::2], order[1::2]
    off: dict[str, list[float]] = {"in time": [], "mixed": []}
    lengths, whole = list[Measured](), _calibrated(views, sizes, set(frames), model) if model == "auto" else None
    for how, halves in parts.items():
        try:
            a, b = (_calibrated(views, sizes, set(own), model) for own in halves)
        except RigkitError as error:
            print(f"{name}, {how}: {error}", flush=True)
            continue
        words = []
        for pair in combinations(views, 2):
            (first, sigma_a), (second, sigma_b) = _own(a, pair), _own(b, pair)
            off["in time" if how == "in time" else "mixed"].append((first - second) / float(np.hypot(sigma_a, sigma_b)))
            words.append(f"{'-'.join(pair)} {first:.2f} ± {sigma_a:.2f} and {second:.2f} ± {sigma_b:.2f} mm")
        chance = compare_mounts(_without_departures(a), _without_departures(b)).chance
        print(f"{name}, {how}: {'; '.join(words)}; chance of such mounts {chance:.4f}", flush=True)
        if whole is not None:
            for rig, others in ((a, halves[1]), (b, halves[0])):
                own = _lengths(rig, whole, views, set(others))
                print(f"{name}, {how}: lengths within bounds: {share(own)}", flush=True)
                lengths += own
    rms = [f"{how} {np.sqrt(np.mean(np.square(own))):.2f} ({len(own)})" for how, own in off.items() if own]
    print(f"{name}: baselines, observed over stated (rms): {', '.join(rms)}", flush=True)
    if lengths:
        print_lengths(name, lengths)


def _lengths(rig: RigCalibration, whole: RigCalibration, views: RigViews, frames: set[str]) -> list[Measured]:
    """Return the lengths of each two cameras in some frames, held against the boards' shapes by the `whole` set."""
    out = list[Measured]()
    for names in combinations(views, 2):
        seen = {frame: pair for frame, pair in both_see(whole, views, names).items() if frame in frames}
        shapes = {shape.board_id: shape for shape in whole.cameras[whole.index(names[0])].calibration.boards}
        out += measured(rig, names, seen, shapes)
    return out


def print_lengths(name: str, lengths: list[Measured]) -> None:
    """Print how many lengths are within their bounds, in all frames and in those that `rigkit check` accepts."""
    print(
        f"{name}: lengths within bounds of 95 %: {share(lengths)}; where check accepts the frame "
        f"{share([own for own in lengths if own.holds])}, else {share([own for own in lengths if not own.holds])}"
    )
    for frame in sorted({own.frame for own in lengths}, key=natural_key):
        of_it = [own for own in lengths if own.frame == frame]
        accepted = sum(own.holds for own in of_it)
        print(f"{name}: frame {frame}: {share(of_it)}, {accepted} accepted", flush=True)


def _calibrated(views: RigViews, sizes: Mapping[str, tuple[int, int]], frames: set[str], model: str) -> RigCalibration:
    part = {camera: [one for one in own if one[0] in frames] for camera, own in views.items()}
    return calibrate_rig(part, sizes, model=model, board="auto" if model == "auto" else "flat", folds=0)


def _own(rig: RigCalibration, pair: tuple[str, str]) -> tuple[float, float]:
    """Return a baseline, and its standard deviation without that of the squares' size, which is the same in halves."""
    length, sigma = rig.baseline_mm(*pair)
    return length, float(np.sqrt(max(sigma**2 - (length * rig.scale_sigma) ** 2, 0.0)))


def _without_departures(rig: RigCalibration) -> MountedCameras:
    return replace(rig.mounted, departures=())
