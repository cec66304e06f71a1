"""Accuracy on lab-a (RENDERED) against its exact truth: corners, calibration, pose, baseline, planes and normals.

Prints Markdown tables of errors, and of errors over their sigmas. The truth (truth.json of each capture) is not part of
the repository:

    python scripts/accuracy.py FOLDER     # a folder with captures/<pair>/truth.json and calibration/<lens>/truth.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from rigkit.affine.registry import AFFINE_METHODS
from rigkit.cameras.base import Camera
from rigkit.cli.console import progress_on_stderr
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, nearest_rotation, rotation_angle
from rigkit.io.manifests.manifest import load_dataset
from rigkit.reconstruction.pairing import MatchedPair
from rigkit.reconstruction.reconstruct import reconstruct_from
from rigkit.validation.planes import fit_plane, normal_errors
from rigkit.validation.tables import best_of
from rigkit.workflows.options.clouds import DatasetOptions
from rigkit.workflows.reconstruction.datasets import PairJob, over_pairs
from rigkit.workflows.reconstruction.pairs import geometry_of, match_images
from rigkit.workflows.validation.paper import load_paper_tables

ROOT = Path(__file__).resolve().parents[1]

NEAR_PX = 3.0
"""A corner further than this from every true corner is no corner."""


def nearest_true(pixels: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the nearest true corner and the error vector of each pixel (N, 2)."""
    index = np.linalg.norm(pixels[:, None] - truth[None], axis=2).argmin(axis=1)
    return index, pixels - truth[index]


def corner_figures(matched: MatchedPair, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Corner errors, and whether every corner has the same physical partner and board in both images."""
    names = sorted(truth["view1"])
    true = [np.concatenate([np.array(truth[view][n]["uv_px"]) for n in names]) for view in ("view1", "view2")]
    of_board = np.repeat(np.arange(len(names)), [len(truth["view1"][n]["uv_px"]) for n in names])
    first, error1 = nearest_true(matched.captured.pixels1, true[0])
    second, error2 = nearest_true(matched.captured.pixels2, true[1])
    errors = np.concatenate([error1, error2])
    # One board of ours is one true board.
    boards = {(int(a), int(b)) for a, b in zip(matched.captured.board_index, of_board[first], strict=True)}
    return {
        "corners": len(first),
        "matched": bool((first == second).all() and len(set(first)) == len(first) and len(boards) == len(names)),
        "corner_rms_px": float(np.sqrt((errors**2).sum(axis=1).mean())),
        "corner_max_px": float(np.linalg.norm(errors, axis=1).max()),
        "sigma_ratio": float(
            np.sqrt(
                np.mean(
                    (errors / np.concatenate([matched.captured.sigma1_px, matched.captured.sigma2_px])[:, None]) ** 2
                )
            )
        ),
    }


def measure_pair(captures: Path, job: PairJob[DatasetOptions]) -> dict[str, Any]:
    """All figures of one pair."""
    pair = job.pair
    camera1, camera2 = (loaded.camera for loaded in job.cameras.of(pair))
    truth = json.loads((captures / pair.pair_id / "truth.json").read_text())
    true_pose = Rigid3.from_matrix(truth["cam2_from_cam1"])
    matched, _, _ = match_images(pair, camera1, camera2, job.options.chain)
    out: dict[str, Any] = {"pair": pair.pair_id, **corner_figures(matched, truth), "methods": {}}
    geometry = geometry_of(matched, pair)
    for method in AFFINE_METHODS:
        r = reconstruct_from(geometry, affine_method=method)
        planes = [fit_plane(r.cloud.points_mm[r.cloud.on_board(name)]) for name in r.cloud.board_ids]
        angles = [np.rad2deg(angle_between(a.normal, b.normal)) for a, b in combinations(planes, 2)]
        normals = [
            normal_errors(r.cloud.normals[r.cloud.on_board(n)], p.normal)
            for n, p in zip(r.cloud.board_ids, planes, strict=True)
        ]
        out["methods"][method] = {
            "orthogonality_deg": [float(abs(a - 90.0)) for a in angles],
            "mean_normal_deg": [n.mean_deg for n in normals],
            "baseline_percent": float(100.0 * (r.baseline_mm / truth["baseline_mm"] - 1.0)),
            "rotation_deg": float(np.rad2deg(rotation_angle(r.cam2_from_cam1.rotation @ true_pose.rotation.T))),
            "direction_deg": float(
                np.rad2deg(angle_between(r.cam2_from_cam1.translation_mm, true_pose.translation_mm))
            ),
            "baseline_mm": r.baseline_mm,
            "baseline_sigma_mm": r.baseline_sigma_mm,
            "true_baseline_mm": truth["baseline_mm"],
        }
    return out


def true_rays(lens: Mapping[str, Any], pixels: np.ndarray) -> np.ndarray:
    """Rays of the true lens: theta = k1 r + k2 r^2 + k3 r^3 + k4 r^4 with r in mm on the sensor."""
    offset = (pixels - np.array(lens["centre_px"])) * lens["pixel_mm"]
    r = np.linalg.norm(offset, axis=1)
    theta = sum(k * r ** (i + 1) for i, k in enumerate(lens["k"]))
    ring = offset / np.maximum(r, 1e-12)[:, None]
    return np.concatenate([np.sin(theta)[:, None] * ring, np.cos(theta)[:, None]], axis=1)


def calibration_difference_px(camera: Camera, truth: Mapping[str, Any]) -> tuple[float, float]:
    """RMS and largest difference to the true lens, px, where the boards were, after the best rotation."""
    seen = np.concatenate([np.array(view["uv_px"]) for view in truth["views"]])
    width, height = camera.size_px
    step = 16
    u, v = np.meshgrid(np.arange(step / 2, width, step), np.arange(step / 2, height, step))
    grid = np.stack([u.ravel(), v.ravel()], axis=1)
    near = cKDTree(seen).query(grid)[0] < 2.0 * step
    pixels = grid[near]
    rays = true_rays(truth["lens_truth"], pixels)
    ours, _ = camera.unproject(pixels)
    rotation = nearest_rotation(ours.T @ rays)
    projected, valid = camera.project(rays @ rotation.T)
    difference = np.linalg.norm(projected - pixels, axis=1)[valid]
    return float(np.sqrt(np.mean(difference**2))), float(difference.max())


def measure(folder: Path, *, pairs: Sequence[str] = (), chain: str = "raw", jobs: int | None = None) -> dict[str, Any]:
    """Measure all pairs and both calibrations of datasets/lab-a against the truth under `folder`."""
    progress = progress_on_stderr()
    dataset = load_dataset(ROOT / "datasets" / "lab-a").select(pairs)
    options = DatasetOptions(chain="rectified" if chain == "rectified" else "raw", jobs=jobs)
    work = partial(measure_pair, folder / "captures")
    results, failures, loaded = over_pairs(work, dataset, options, what="pairs against truth", progress=progress)
    if failures:
        raise failures[0].error
    lenses = {}
    for name, camera in loaded.known.items():
        truth = json.loads((folder / "calibration" / name / "truth.json").read_text())
        lenses[name] = calibration_difference_px(camera.camera, truth)
    return {"pairs": results, "calibration_px": lenses}


def best_method(methods: Mapping[str, Mapping[str, Any]]) -> str:
    """The estimator with the smallest mean normal error over the planes."""
    return best_of({m: float(np.mean(found["mean_normal_deg"])) for m, found in methods.items()})


def averages(pairs: Sequence[Mapping[str, Any]]) -> dict[str, tuple[float, float]]:
    """Average errors, ours and the paper's, over the cells of its tables: planes of the best estimator, all baselines.

    Ours are against the exact truth (planes stand at right angles there), the paper's against what it measured.
    """
    paper = load_paper_tables(ROOT / "datasets" / "hajder2021")
    score = {m: np.mean([p["methods"][m]["mean_normal_deg"] for p in pairs]) for m in AFFINE_METHODS}
    best = best_of({m: float(value) for m, value in score.items()})
    rows = {"orthogonality_deg": "orthogonality {}", "mean_normal_deg": "mean normal error {}"}
    labels = {"orthogonality_deg": ("1-2", "1-3", "2-3"), "mean_normal_deg": ("1", "2", "3")}
    out = {}
    for what, row in rows.items():
        ours = [p["methods"][best][what] for p in pairs]
        printed = [[paper.plane(row.format(label), p["pair"]) or "nan" for label in labels[what]] for p in pairs]
        out[what] = (float(np.mean(ours)), float(np.mean(np.array(printed, dtype=float))))
    lengths = []
    for p in pairs:
        measured = paper.baseline(p["pair"], "measured")
        for name, m in p["methods"].items():
            if measured is not None:
                theirs = float(paper.baseline(p["pair"], name) or "nan") - float(measured)
                lengths.append((abs(m["baseline_mm"] - m["true_baseline_mm"]), abs(theirs)))
    if lengths:
        mine, others = np.mean(lengths, axis=0)
        out["baseline_mm"] = (float(mine), float(others))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--chain", choices=("raw", "rectified"), default="raw")
    args = parser.parse_args()
    if not any(args.folder.glob("captures/*/truth.json")):
        parser.error(f"no captures/PAIR/truth.json in '{args.folder}'; give the folder that holds lab-a's truth")
    result = measure(args.folder, chain=args.chain)
    print(
        "| pair | corners | corner rms, px | actual / predicted sigma | orthogonality, deg | normals, deg | baseline |"
    )
    print("| :-- | --: | --: | --: | :-- | :-- | --: |")
    for pair in result["pairs"]:
        method = best_method(pair["methods"])
        m = pair["methods"][method]
        orthogonality = " / ".join(f"{v:.3f}" for v in m["orthogonality_deg"])
        normals = " / ".join(f"{v:.3f}" for v in m["mean_normal_deg"])
        print(
            f"| {pair['pair']} | {pair['corners']}{'' if pair['matched'] else ' WRONG'} | {pair['corner_rms_px']:.4f} "
            f"| {pair['sigma_ratio']:.2f} | {orthogonality} | {normals} ({method}) | {m['baseline_percent']:+.3f} % |"
        )
    print("\n| pair | rotation error, deg | direction error, deg | baseline, mm | true, mm |")
    print("| :-- | --: | --: | --: | --: |")
    for pair in result["pairs"]:
        m = pair["methods"][best_method(pair["methods"])]
        print(
            f"| {pair['pair']} | {m['rotation_deg']:.4f} | {m['direction_deg']:.4f} | {m['baseline_mm']:.3f} ± "
            f"{m['baseline_sigma_mm']:.3f} | {m['true_baseline_mm']:.3f} |"
        )
    print("\n| average over the cells of the paper's tables | ours | paper | paper / ours |\n| :-- | --: | --: | --: |")
    for what, (ours, paper) in averages(result["pairs"]).items():
        quantity, _, unit = what.rpartition("_")
        print(f"| {quantity.replace('_', ' ')}, {unit} | {ours:.4f} | {paper:.4f} | {paper / ours:.1f} |")
    print()
    for lens, (rms, largest) in result["calibration_px"].items():
        print(f"calibration of {lens}: {rms:.4f} px rms, {largest:.4f} px at most, from the true lens")


if __name__ == "__main__":
    main()
