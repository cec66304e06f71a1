"""Errors of clouds of pairs (points, ranges, normals, meshes, poses), compared with OpenCV's semi-global matching.

REAL scenes with measured depth, or RENDERED rooms with exact depth.

python scripts/bench_clouds.py ../shared/data/scenes            every pair of pairs.json
python scripts/bench_clouds.py ../shared/data/scenes motorcycle --known-pose
python scripts/bench_clouds.py rooms                            of scripts/path_traced_rooms.py
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from rigkit.affine.features import grey_of, match_affine_features
from rigkit.cameras.base import Camera
from rigkit.cameras.registry import camera_model
from rigkit.core.cloud import OrientedCloud
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, log_so3, rotation_angle, unit
from rigkit.interop.open3d import poisson_mesh
from rigkit.io.media.images import read_image
from rigkit.reconstruction.growing.dense import DenseScene, grow_scene
from rigkit.reconstruction.lines_of_sight import with_lines_of_sight
from rigkit.reconstruction.scene import reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose
from rigkit.relative_pose.solvers.pose import translation_basis

AUC_DEG = (1.0, 5.0, 10.0)
NEAR_REL = 0.02
"""Share of the depth that a mesh may be off by."""
PLANE_PX = 7
"""To either side, for normals of disparities: over half as many motorcycle's noise turns them by 0.6 degrees, as much
as rigkit's planes are off (REAL)."""
MAX_UNEVEN_PX = 0.15
"""Where truth is a plane: over so many pixels, to this part of a disparity."""
COMPLETE_PX = (1.0, 2.0, 4.0)
"""Errors of disparities up to which a range counts as given."""
EDGE_REL = 0.03
"""By which the inverse range jumps from pixel to pixel at an edge; twice what it does beside it."""
BESIDE_PX = (0.0, 2.5, 5.0, 10.0, np.inf)
"""From an edge, between which errors are told apart."""
FLYING_SIGMAS = 5.0
"""A point that is off by more, and by NEAR_REL, flies."""


@dataclass(frozen=True, eq=False)
class Case:
    """A pair with its truth; `surface`: range, normals and where these are known, (H, W, ...), of image 1."""

    name: str
    kind: str
    images: tuple[Any, Any]
    cameras: tuple[Camera, Camera]
    pose: Rigid3
    surface: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


def cases(folder: Path, names: list[str]) -> list[Case]:
    out = []
    for entry in json.loads((folder / "pairs.json").read_text()):
        if names and entry["name"] not in names and entry["set"] not in names:
            continue
        images = read_image(folder / entry["image1"]), read_image(folder / entry["image2"])
        first, second = (
            camera_model(model)(tuple(size), np.array(values))
            for model, size, values in (entry["camera1"], entry["camera2"])
        )
        t = entry["baseline"] * unit(np.array(entry["cam2_from_cam1_t_direction"]))
        pose = Rigid3(np.array(entry["cam2_from_cam1_R"]), t)
        case = Case(entry["name"], entry["set"], images, (first, second), pose)
        if "surface" in entry:
            with np.load(folder / entry["surface"]) as stored:
                distance, normals = (stored[name].astype(np.float64) for name in ("range", "normals"))
            case = replace(case, surface=(distance, normals, np.isfinite(distance)))
        elif (folder / "middlebury" / f"{case.name}_disp.npz").exists():
            case = replace(case, surface=disparity_truth(folder, case))
        out.append(case)
    return out


def reconstructed(case: Case, known: bool, pose_type: str | None) -> tuple[DenseScene, float, float]:
    """Return the dense scene, and the processor time of matching and of the rest."""
    start = time.process_time()
    seeds = match_affine_features(*case.images)
    matched = time.process_time()
    pose = KnownPose(case.pose) if known else None
    length = float(np.linalg.norm(case.pose.translation_mm))
    sparse = reconstruct_scene(
        seeds,
        *case.cameras,
        pose_type=pose_type,
        baseline_mm=length,
        known_pose=pose,
        image1=case.images[0],
    )
    dense = grow_scene(sparse, seeds, *case.images, pose_is_known=known)
    return dense, matched - start, time.process_time() - matched


def pose_errors(dense: DenseScene, truth: Rigid3) -> tuple[float, float, float]:
    """Return rotation and direction errors in degrees, and the root of Mahalanobis' distance a degree of freedom."""
    r = dense.scene.reconstruction
    t, true = unit(r.cam2_from_cam1.translation_mm), unit(truth.translation_mm)
    turn = truth.rotation @ r.cam2_from_cam1.rotation.T
    to_five = np.zeros((5, 6))
    to_five[:3, :3], to_five[3:, 3:] = np.eye(3), translation_basis(t) / r.baseline_mm
    off = np.concatenate([log_so3(turn), translation_basis(t) @ (true - t)])
    assert r.pose_covariance is not None
    covariance = to_five @ r.pose_covariance @ to_five.T
    distance = off @ np.linalg.solve(covariance, off) / 5.0 if covariance.any() else np.nan
    degrees = np.degrees([float(rotation_angle(turn)), float(angle_between(t, true))])
    return float(degrees[0]), float(degrees[1]), float(np.sqrt(distance))


def disparity_truth(folder: Path, case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return range, normals and where these are known, (H, W, ...), of a rectified pair with its disparities."""
    with np.load(folder / "middlebury" / f"{case.name}_disp.npz") as stored:
        disparity = stored[stored.files[0]].astype(np.float64)
    f, _, cx1, cy = (float(value) for value in case.cameras[0].parameters[:4])
    shift = case.cameras[1].parameters[2] - cx1
    disparity[~np.isfinite(disparity)] = np.nan
    inverse = (disparity + shift) / (f * np.linalg.norm(case.pose.translation_mm))
    depth, normals, smooth = depth_and_normals(inverse, f, cx1, cy)
    v, u = np.indices(depth.shape)
    return depth * np.sqrt(1.0 + ((u - cx1) / f) ** 2 + ((v - cy) / f) ** 2), normals, smooth


def depth_and_normals(inverse: np.ndarray, f: float, cx: float, cy: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth, normals by differentiating over 2 PLANE_PX + 1 pixels, and where the surface is smooth."""
    side = 2 * PLANE_PX + 1
    line = np.arange(-PLANE_PX, PLANE_PX + 1.0)
    known = np.isfinite(inverse)
    filled = np.where(known, inverse, 0.0)
    by_u = cv2.filter2D(filled, -1, np.outer(np.ones(side), line) / (side * np.sum(line**2)))
    by_v = cv2.filter2D(filled, -1, np.outer(line, np.ones(side)) / (side * np.sum(line**2)))
    variance = cv2.blur(filled**2, (side, side)) - cv2.blur(filled, (side, side)) ** 2
    uneven = np.sqrt(np.maximum(variance - (by_u**2 + by_v**2) * np.mean(line**2), 0.0))
    scale = np.nanmedian(inverse)
    whole = cv2.erode(known.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    u, v = np.meshgrid(np.arange(inverse.shape[1]), np.arange(inverse.shape[0]))
    x, y = (u - cx) / f, (v - cy) / f
    plane = np.stack([f * by_u, f * by_v, filled - by_u * f * x - by_v * f * y], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = 1.0 / inverse
        normals = -plane / np.linalg.norm(plane, axis=-1, keepdims=True)
    # A disparity of the median depth is one part in (scale * f * b) of it; b is in the unit of the depth.
    return depth, normals, whole & (uneven < MAX_UNEVEN_PX / 70.0 * scale)


def against_truth(
    points: np.ndarray, normals: np.ndarray, pixels: np.ndarray, truth: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> str:
    distance, true_normals, smooth = truth
    height, width = distance.shape
    u, v = np.clip(np.rint(pixels).astype(int), 0, [width - 1, height - 1]).T
    good = np.isfinite(distance[v, u]) & np.isfinite(points[:, 2])
    off = np.abs(np.linalg.norm(points, axis=1) / distance[v, u] - 1.0)[good]
    compared = good & smooth[v, u]
    angle = np.degrees(angle_between(normals[compared], true_normals[v, u][compared]))
    return f"{len(points)} points, range {100 * np.median(off):.3f} %, normals {np.median(angle):.2f} deg"


def from_edges(distance: np.ndarray) -> np.ndarray:
    """Return how far (H, W) pixels are from the next edge of depth, px."""
    inverse = 1.0 / distance
    edge = np.zeros(distance.shape, bool)
    for step in (inverse, inverse.T):
        at = edge if step is inverse else edge.T
        change, least = np.abs(np.diff(step, axis=1)), np.minimum(step[:, 1:], step[:, :-1])
        padded = np.pad(change, ((0, 0), (1, 1)), mode="edge")
        # A slope is no edge: its neighbours are as steep.
        jump = (change > EDGE_REL * least) & (np.maximum(padded[:, :-2], padded[:, 2:]) < 0.5 * change)
        at[:, 1:] |= jump
        at[:, :-1] |= jump
    return np.asarray(cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))


def errors_in_sigmas(dense: DenseScene, distance: np.ndarray) -> list[str]:
    """Return what 68 and 95 % of the ranges are off by, in their sigmas, and which share flies: by edges of depth.

    A point within 2.5 px of an edge may be on either surface within a pixel.
    """
    r = dense.scene.reconstruction
    swept = dense.grown.swept.ravel()[dense.nodes]
    size = np.linalg.norm(r.cloud.points_mm, axis=1)
    height, width = distance.shape
    u, v = np.clip(np.rint(r.pixels1).astype(int), 0, [width - 1, height - 1]).T
    away = from_edges(distance)[v, u]
    inverse = 1.0 / distance
    between = map_coordinates(inverse, r.pixels1.T[::-1], order=1, mode="nearest")
    there = np.where((away < BESIDE_PX[1]) | ~np.isfinite(between), inverse[v, u], between)
    off = np.abs(size - 1.0 / there)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            other = inverse[np.clip(v + dv, 0, height - 1), np.clip(u + du, 0, width - 1)]
            off = np.where(away < BESIDE_PX[1], np.fmin(off, np.abs(size - 1.0 / other)), off)
    sigmas = off / r.cloud.sigma_mm
    flies = (sigmas > FLYING_SIGMAS) & (off * there > NEAR_REL)
    lines = []
    for words, which in (("patches", ~swept), ("sweep", swept)):
        reported = []
        for near, far in pairwise(BESIDE_PX):
            k = which & np.isfinite(off) & (away >= near) & (away < far)
            if k.any():
                most = "/".join(f"{q:.1f}" for q in np.quantile(sigmas[k], [0.68, 0.95]))
                reported.append(f"{near:g}-{far:g} px {most} ({100 * flies[k].mean():.1f} % fly)")
        lines.append(f"{words}, 68/95 % within sigmas, from edges: {', '.join(reported)}")
    known = np.isfinite(off)
    one, two = (100 * np.mean(sigmas[known] < most) for most in (1.0, 2.0))
    lines.append(f"{one:.1f} % within one sigma, {two:.1f} % within two")
    lines.append(f"{100 * flies[known].mean():.2f} % off by over {FLYING_SIGMAS:g} sigmas and {100 * NEAR_REL:.0f} %")
    return lines


def mesh_share(cloud: OrientedCloud, camera: Camera, distance: np.ndarray) -> float:
    """Return the share of the true pixels that the Poisson mesh of the cloud is within NEAR_REL of."""
    import open3d

    mesh = poisson_mesh(cloud, depth=9, cut=0.0)
    tensor: Any = open3d.core.Tensor
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(mesh.points.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32)))
    v, u = np.nonzero(np.isfinite(distance))
    rays, _ = camera.unproject(np.stack([u, v], axis=-1).astype(np.float64))
    hit = scene.cast_rays(tensor(np.concatenate([np.zeros_like(rays), rays], axis=1).astype(np.float32)))
    return float(np.mean(np.abs(hit["t_hit"].numpy() / distance[v, u] - 1.0) < NEAR_REL))


def semi_global(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, normals and pixels by OpenCV's StereoSGBM on a rectified pair, normals as those of the truth."""
    grey1, grey2 = (grey_of(image, "image") for image in case.images)
    matcher = cv2.StereoSGBM.create(0, 80, 5, 8 * 25, 32 * 25, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH)
    disparity = matcher.compute(grey1, grey2).astype(np.float64) / 16.0
    f, _, cx1, cy = (float(value) for value in case.cameras[0].parameters[:4])
    shift = case.cameras[1].parameters[2] - cx1
    inverse = np.where(disparity > 0.0, disparity + shift, np.nan) / (f * np.linalg.norm(case.pose.translation_mm))
    depth, normals, _ = depth_and_normals(inverse, f, cx1, cy)
    v, u = np.nonzero(np.isfinite(depth))
    x = np.stack([(u - cx1) / f, (v - cy) / f, np.ones(len(u))], axis=-1)
    return x * depth[v, u][:, None], normals[v, u], np.stack([u, v], axis=-1).astype(np.float64)


def beside_semi_global(case: Case, dense: DenseScene) -> None:
    """Print how StereoSGBM does on a rectified pair, and what shares of the nodes' true ranges both give."""
    assert case.surface is not None
    truth, step = case.surface, dense.grown.step
    start = time.process_time()
    points, normals, pixels = semi_global(case)
    spent = time.process_time() - start
    print(f"  StereoSGBM on the rectified pair: {against_truth(points, normals, pixels, truth)}, {spent:.1f} s")
    theirs = np.full(truth[0].shape, np.nan)
    u, v = pixels.astype(int).T
    theirs[v, u] = np.linalg.norm(points, axis=1)
    f, _, cx, cy = (float(value) for value in case.cameras[0].parameters[:4])
    true = truth[0][::step, ::step]
    v, u = step * np.indices(true.shape)
    known = np.isfinite(true)
    # Of a disparity, by the inverse range.
    px = f * np.linalg.norm(case.pose.translation_mm) * np.sqrt(1.0 + ((u - cx) / f) ** 2 + ((v - cy) / f) ** 2)
    for name, given in (("rigkit", dense.maps()["range"]), ("StereoSGBM", theirs[::step, ::step])):
        off = np.abs(1.0 / given - 1.0 / true)[known] * px[known]
        shares = "/".join(f"{100 * np.mean(off <= most):.0f}" for most in COMPLETE_PX)
        limits = "/".join(f"{most:g}" for most in COMPLETE_PX)
        of_given = off[np.isfinite(off)]
        print(
            f"    {name}: {100 * of_given.size / off.size:.0f} % of true nodes given, {shares} % within {limits} px; "
            f"of those given {100 * np.mean(of_given > 1.0):.1f} % beyond 1 px, median {np.median(of_given):.3f} px"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with pairs.json")
    parser.add_argument("names", nargs="*", help="pairs or sets (default: all)")
    parser.add_argument("--known-pose", action="store_true", help="use the true pose instead of estimating it")
    parser.add_argument("--pose-type", help="as of `rigkit reconstruct` (default: general, or of a rectified pair)")
    args = parser.parse_args()
    errors, distances = [], []
    for case in cases(args.folder, args.names):
        dense, matching, rest = reconstructed(case, args.known_pose, args.pose_type)
        turn, swing, distance = pose_errors(dense, case.pose)
        errors.append(max(turn, swing))
        distances.append(distance)
        cloud = dense.scene.reconstruction.cloud
        print(
            f"{case.kind} {case.name}: {len(cloud)} points, pose {turn:.3f}/{swing:.3f} deg ({distance:.1f} sigma), "
            f"{matching:.1f} + {rest:.1f} s",
            flush=True,
        )
        axis = np.degrees(np.arccos(unit(cloud.points_mm)[:, 2]))
        print(f"  to {axis.max():.0f} deg off axis")
        truth = case.surface
        if truth is not None:
            print(
                f"  rigkit: {against_truth(cloud.points_mm, cloud.normals, dense.scene.reconstruction.pixels1, truth)}"
            )
            for line in errors_in_sigmas(dense, truth[0]):
                print(f"    {line}")
            if case.kind == "middlebury":
                beside_semi_global(case, dense)
            shares = [mesh_share(c, case.cameras[0], truth[0]) for c in (cloud, with_lines_of_sight(cloud))]
            print(
                f"  Poisson within {100 * NEAR_REL:.0f} %: {100 * shares[0]:.1f} % of true pixels, "
                f"{100 * shares[1]:.1f} % with lines of sight, as `rigkit mesh` makes it"
            )
    areas = [f"{100 * np.mean(np.maximum(1.0 - np.array(errors) / limit, 0.0)):.1f}" for limit in AUC_DEG]
    # A pose that is exact has no sigmas.
    squares = np.square([d for d in distances if np.isfinite(d)])
    rms = f", rms sigmas {np.sqrt(squares.mean()):.1f}" if squares.size else ""
    print(f"{len(errors)} pairs: AUC@1/5/10 {'/'.join(areas)}{rms}")


if __name__ == "__main__":
    main()
