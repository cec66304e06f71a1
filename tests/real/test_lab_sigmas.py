"""Reported sigmas on lab-a's own scenes: true geometry through the calibrated cameras, 200 sets of noisy corners."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.data import REPOSITORY, shared_data

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.truth import MeasuredAngle, MeasuredLength, PairTruth
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.manifests.manifest import load_dataset
from rigkit.validation.checks import validate
from rigkit.workflows.reconstruction.datasets import load_cameras
from rigkit.workflows.reconstruction.pairs import BoardsOfPair, reconstruct_with

SIGMA_PX = 0.03
DRAWS_A_PAIR = 25
WITHIN_ONE, WITHIN_TWO = (0.63, 0.73), (0.92, 0.98)
"""68.3 and 95.4 % for a Gaussian; 200 sets are good to about 3 and 1.5 %."""
EXACT = 1e-9
UNSEEN = np.zeros((0, 0), dtype=np.uint8)
"""The image behind made corners: none."""
WALLS = (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))


def lattice_of(board: Board, corners_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The exact corners of a board that the file rounds to a micrometre, and their right-handed grid."""
    columns = board.columns
    x = corners_mm[columns - 1] - corners_mm[0]
    y = corners_mm[-columns] - corners_mm[0]
    x = x / np.linalg.norm(x) * board.square_x_mm
    y = y - x * (y @ x) / (x @ x)
    y = y / np.linalg.norm(y) * board.square_y_mm
    grid = board.grid()
    points = corners_mm[0] + grid[:, :1] * x + grid[:, 1:] * y
    if np.cross(x, y) @ corners_mm[0] < 0.0:
        grid = np.stack([columns - 1 - grid[:, 0], grid[:, 1]], axis=-1)
    order = np.lexsort((grid[:, 0], grid[:, 1]))
    return points[order], grid[order]


def seen(
    board: Board, points: np.ndarray, grid: np.ndarray, camera: Camera, rng: np.random.Generator
) -> BoardDetection:
    pixels, valid = camera.project(points)
    assert valid.all()
    noisy = pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)
    return BoardDetection(board.board_id, *board.size, grid, noisy, np.full(len(grid), SIGMA_PX))


@pytest.mark.real
@pytest.mark.slow
def test_measured_quantities_fall_within_the_predicted_sigmas(rng: np.random.Generator) -> None:
    folder: Path = shared_data("lab-a")
    dataset = load_dataset(REPOSITORY / "datasets" / "lab-a")
    cameras = load_cameras(dataset).known
    angles, baselines = [], []
    for pair in dataset.pairs:
        truth = json.loads((folder / "captures" / pair.pair_id / "truth.json").read_text())
        camera, pose = cameras[pair.camera1.camera_id].camera, Rigid3.from_matrix(truth["cam2_from_cam1"])
        boards = [(b, *lattice_of(b, np.array(truth["view1"][b.board_id]["cam_xyz_mm"]))) for b in pair.boards]
        known = PairTruth(
            MeasuredLength(truth["baseline_mm"], EXACT, "made"),
            tuple(MeasuredAngle(a, b, 90.0, EXACT, "made") for a, b in WALLS),
        )
        for _ in range(DRAWS_A_PAIR):
            found1 = tuple(seen(b, p, g, camera, rng) for b, p, g in boards)
            found2 = tuple(seen(b, pose.apply(p), g, camera, rng) for b, p, g in boards)
            matched = BoardsOfPair(pair, (camera, camera), (found1, found2), (UNSEEN, UNSEEN)).matched("raw")
            report = validate(reconstruct_with(matched, pair, "3SDIR"), known)
            angles += [check.k for check in report.checks if check.kind == "angle"]
            baselines.append(report.check("baseline").k)
    assert len(baselines) == DRAWS_A_PAIR * len(dataset.pairs)
    for name, k in (("angles", np.array(angles)), ("baselines", np.array(baselines))):
        assert WITHIN_ONE[0] <= np.mean(k < 1.0) <= WITHIN_ONE[1], (name, np.mean(k < 1.0))
        assert WITHIN_TWO[0] <= np.mean(k < 2.0) <= WITHIN_TWO[1], (name, np.mean(k < 2.0))
