"""Test the stated sigmas, including the calibration's uncertainty, on newly RENDERED laboratories.

A laboratory is a random lens, images of a board to calibrate it from, and pairs of views of three perpendicular boards,
one for each pose type. The lens has 55 to 75 or 170 to 190 degrees and a projection that no model has. Images are
processed as a user's: boards are detected, the camera is calibrated, pairs are reconstructed. Then the errors of each
angle, baseline and normal are compared with their sigmas: 68 and 95 % should be within one and two sigmas.

    python scripts/measure_honesty.py [--labs 0:20] [--odd] [--json FILE] [--model MODEL] [--views 14]
    python scripts/measure_honesty.py --sessions 20 [--models | --moving] [--images 3,4,5,7,10,20]

One laboratory takes 20 to 40 s. With --json, laboratories that the file has are not repeated, so it can run in parts;
the table is of all. --sessions N uses SIMULATED corners, without images: N sessions of each kind, from three images on.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from honesty.laboratories import Laboratory
from honesty.moving import moving_sessions
from honesty.sessions import IMAGES, sessions

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.errors import RigkitError
from rigkit.core.posetype import PoseType
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rotation import angle_between
from rigkit.reconstruction.board_planes import BoardPlanes
from rigkit.reconstruction.calibration_shifts import calibration_shifts
from rigkit.reconstruction.coplanar_planes import coplanar_planes
from rigkit.reconstruction.geometry import PairGeometry, pair_geometry
from rigkit.reconstruction.lattice_planes import lattice_planes
from rigkit.reconstruction.pairing import match_pair
from rigkit.reconstruction.reconstruct import reconstruct_from
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.validation.measure import Measured, measure

PLANES = (Board("plane1", 8, 6, 50.0, 50.0), Board("plane2", 7, 6, 50.0, 50.0), Board("plane3", 6, 9, 50.0, 50.0))
FACES = ((0, 1), (0, 2), (1, 2))
TYPES = (PoseType.GENERAL, PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD)
BASELINE_MM = {PoseType.PLANAR: 200.0, PoseType.STANDARD: 250.0, PoseType.FORWARD: 150.0}
LEVEL_DEG = 0.1


def scene_of(camera: Camera, kind: PoseType, rng: np.random.Generator) -> StereoScene:
    baseline = BASELINE_MM.get(kind, 0.0) * rng.uniform(0.8, 1.2)
    return trihedral_pair(
        PLANES,
        camera,
        kind,
        rng,
        baseline_mm=baseline,
        distance=(0.75, 1.2),
        level_sigma_deg=0.0 if kind is PoseType.GENERAL else LEVEL_DEG,
    )


def geometry_seen(scene: StereoScene, camera: Camera, lab: Laboratory, rng: np.random.Generator) -> PairGeometry:
    """Return the geometry of a pair from its images through the calibrated camera."""
    first, second = scene.images(optics=lab.optics, photometry=lab.light(rng), rng=rng)
    found1, found2 = (detect_boards(image, PLANES, camera=camera) for image in (first, second))
    matched = match_pair("made", camera, camera, found1, found2, PLANES)
    level = None if scene.pose_type is PoseType.GENERAL else float(np.radians(LEVEL_DEG))
    return pair_geometry(matched, pose_type=scene.pose_type, level_sigma_rad=level)


def normals_in_sigmas(measured: Measured, truth: np.ndarray) -> Iterator[float]:
    """Yield each plane's normal error across either tangent, in its sigma."""
    for board, true in zip(PLANES, truth, strict=True):
        plane, moved = measured.boards[board.board_id].plane, measured.moved[board.board_id].normal
        tilts = (moved[1:] - moved[0]) @ plane.tangents
        common = tilts.T @ tilts
        yield from (true @ plane.tangents) / np.sqrt(np.diag(plane.scatter[1:, 1:] + common))


def in_sigmas(scene: StereoScene, geometry: PairGeometry, found: Calibration) -> Iterator[tuple[str, float]]:
    """Yield (what, error in stated sigmas) of a pair."""
    reconstruction = reconstruct_from(geometry)
    known = uncertain_camera(found)
    shifts = calibration_shifts(reconstruction, known)
    measured = measure(reconstruction, shifts)
    fitted: dict[str, BoardPlanes] = {
        "coplanar": coplanar_planes(geometry, known, one_camera=True),
        "lattice": lattice_planes(geometry, known, one_camera=True),
    }
    truth = scene.normals_in_cam1()
    for a, b in FACES:
        names = PLANES[a].board_id, PLANES[b].board_id
        value, sigma = measured.angle_deg(*names)
        yield "angles", (value - 90.0) / sigma
        for kind, planes in fitted.items():
            value, sigma = planes.angle_deg(*names)
            yield f"angles, {kind}", (value - 90.0) / sigma
    free = float(np.hypot(reconstruction.baseline_sigma_mm, np.sqrt(shifts.variance(lambda r: r.baseline_mm))))
    yield "baselines", (reconstruction.baseline_mm - scene.baseline_mm) / free
    for kind, planes in fitted.items():
        length, sigma = planes.baseline_mm()
        yield f"baselines, {kind}", (length - scene.baseline_mm) / sigma
    yield from (("normals", k) for k in normals_in_sigmas(measured, truth))
    cloud = reconstruction.cloud
    for n, (board, true) in enumerate(zip(PLANES, truth, strict=True)):
        across = np.linalg.svd(np.outer(true, true))[0][:, 1:]
        for kind, planes in fitted.items():
            covariance = planes.normal_covariance(board.board_id)
            off = planes.normal(board.board_id) @ across
            yield from ((f"normals, {kind}", k) for k in off / np.sqrt(np.diag(across.T @ covariance @ across)))
        own = cloud.board_index == n
        # Stated is the rms angle; of errors alike in both directions 63 and 98 % lie within one and two of it.
        each = angle_between(cloud.normals[own], true) / cloud.normal_sigma_rad[own]
        yield from (("normals of the cloud (rms angle)", k) for k in each.tolist())


def laboratory(seed: int, model: str, views: int, odd: bool) -> list[tuple[str, str, str, float]]:
    """Return (lens, pose type, what, error in sigmas) of everything in one laboratory."""
    rng = np.random.default_rng([20261122, seed])
    lab = Laboratory.odd(rng) if odd else Laboratory.ordinary(seed, views, rng)
    found = calibrate(lab.views(rng), lab.camera.size_px, model=model)
    print(f"laboratory {seed}: {lab.kind}, {lab.camera.size_px}, {lab.optics.field_deg or 0.0:.0f} degrees, "
          f"{len(found.views)} images, {found.camera.model}, {found.boards[0].kind}, freedom {found.freedom:.1f}, "
          f"x{found.overdispersion:.2f}, rms {found.rms_px:.4f} px", flush=True)  # fmt: skip
    out = []
    for pose_type in TYPES:
        try:
            scene = scene_of(lab.camera, pose_type, rng)
            geometry = geometry_seen(scene, found.camera, lab, rng)
            out += [(lab.kind, str(pose_type), *one) for one in in_sigmas(scene, geometry, found)]
        except RigkitError as error:
            print(f"laboratory {seed}, {lab.kind}, {pose_type}: {error}", flush=True)
    return out


def table(rows: list[tuple[str, str, str, float]]) -> str:
    """Return shares within one and two sigmas, of all and by lens and pose type."""
    groups: dict[tuple[str, str], list[float]] = defaultdict(list)
    for lens, pose_type, what, k in rows:
        for group in ("all", lens, pose_type):
            groups[what, group].append(abs(k))
    lines = ["| quantity | of | count | within 1 sigma | within 2 | median / 0.674 |", "|:--|:--|--:|--:|--:|--:|"]
    for (what, group), values in groups.items():
        own = np.array(values)
        cells = [f"{100 * np.mean(own < 1):.0f} %", f"{100 * np.mean(own < 2):.0f} %", f"{np.median(own) / 0.6745:.2f}"]
        lines.append(f"| {what} | {group} | {len(own)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def print_sessions(seeds: int, images: list[int], moving: bool, readout_s: float, models: bool) -> None:
    """Print how many errors of small sessions lie within one and two stated sigmas."""
    print(
        "| images | boards seen | quantity | count | within 1 sigma | within 2 | rms |\n|--:|:--|:--|--:|--:|--:|--:|"
    )
    for count in images:
        found = moving_sessions(count, seeds, readout_s) if moving else sessions(count, seeds, models=models)
        for (what, seen), errors in found.items():
            shares = " | ".join(f"{100 * np.mean(errors < k):.0f} %" for k in (1, 2))
            rms = np.sqrt(np.mean(errors**2))
            print(f"| {count} | {seen} | {what} | {len(errors)} | {shares} | {rms:.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--labs", default="0:20", help="first:beyond the last")
    parser.add_argument("--odd", action="store_true", help="of 320 to 2400 px, 45 to 200 degrees, 6 to 24 images")
    parser.add_argument("--model", default="scaramuzza")
    parser.add_argument("--views", type=int, default=14, help="images of the board that a lens is calibrated from")
    parser.add_argument("--json", type=Path, help="results so far; new laboratories are added")
    parser.add_argument("--sessions", type=int, metavar="SEEDS", help="instead, small simulated sessions")
    parser.add_argument("--moving", action="store_true", help="of boards that move before cameras without a trigger")
    parser.add_argument("--models", action="store_true", help="of one camera, with a lens of every model")
    parser.add_argument("--readout", type=float, default=0.0, help="s; and images that are read row by row")
    parser.add_argument("--images", default=",".join(map(str, IMAGES)), help="of these sessions")
    args = parser.parse_args()
    if args.sessions:
        print_sessions(args.sessions, [int(n) for n in args.images.split(",")], args.moving, args.readout, args.models)
        return
    known = json.loads(args.json.read_text()) if args.json and args.json.is_file() else {}
    for seed in range(*map(int, args.labs.split(":"))):
        if str(seed) in known:
            continue
        try:
            known[str(seed)] = laboratory(seed, args.model, args.views, args.odd)
        except RigkitError as error:
            print(f"laboratory {seed}: {error}", flush=True)
            continue
        if args.json:
            args.json.write_text(json.dumps(known))
    print(table([tuple(row) for rows in known.values() for row in rows]))


if __name__ == "__main__":
    main()
