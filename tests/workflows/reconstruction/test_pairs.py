"""Boards of a data set's pairs are detected with the calibrated cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
from helpers.reconstructions import make_reconstruction

from rigkit.calibration.board_shape import BoardShape
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.core.truth import MeasuredAngle, PairTruth
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.manifests.manifest import CameraEntry, Pair
from rigkit.synthetic.pairs import trihedral_pair
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import Panel
from rigkit.validation.checks import validate
from rigkit.workflows.reconstruction.datasets import LoadedCamera
from rigkit.workflows.reconstruction.pairs import find_boards, measured_shapes
from rigkit.workflows.validation.validation_files import PairValidation

CAMERA = KannalaBrandt((800, 600), np.array([400.0, 400.0, 405.0, 295.0, -0.02, 0.002, 0.0, 0.0]))
BOARDS = tuple(Board(name, 11, 8, 30.0, 30.0) for name in ("plane1", "plane2", "plane3"))


def pair_of(image: Path, boards: tuple[Board, ...]) -> Pair:
    entry = CameraEntry("camera", image.parent / "calibration.json", None)
    return Pair(
        pair_id="pair",
        camera1=entry,
        camera2=entry,
        image1=image,
        image2=image,
        pose_type=PoseType.GENERAL,
        level_sigma_deg=None,
        boards=boards,
        truth=PairTruth(),
        layout={},
    )


def test_boards_behind_a_pole_are_found_with_the_camera(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    scene = trihedral_pair(BOARDS, CAMERA, PoseType.GENERAL, rng, distance=(0.8, 1.1))
    cam = scene.cam1_from_world
    world = cam.inverse()
    middle = cam.apply(np.concatenate([b.points() for b in scene.boards])).mean(axis=0)
    pole = Panel(world @ Rigid3(exp_so3(np.array([0.0, 0.0, 0.25])), 0.75 * middle), 40.0, 4000.0, 0.2)
    image = render(
        scene.boards,
        CAMERA,
        cam,
        panels=scene.panels,
        occluders=[pole],
        optics=Optics(0.8, supersample=2),
        photometry=Photometry(noise_levels=3.0),
        rng=rng,
    )
    path = tmp_path / "view.png"
    cv2.imwrite(str(path), image)
    pair = pair_of(path, BOARDS)
    truth = np.concatenate([b.see(CAMERA, cam)[0] for b in scene.boards])
    found, again = find_boards(pair, CAMERA, CAMERA).boards
    assert [len(d.grid) for d in found] == [len(d.grid) for d in again]
    # Without the camera one board comes in two parts, and corners half under the pole's edge are up to 0.8 px off.
    assert [(d.columns, d.rows) for d in found] == [(11, 8)] * 3
    assert sum(len(d.grid) for d in found) > 200
    for detection in found:
        off = np.linalg.norm(detection.pixels[:, None] - truth, axis=2).min(axis=1)
        assert off.max() < 6.0 * detection.sigma_px[off.argmax()]
        assert off.max() < 0.1


def test_a_validated_pair_has_the_name_of_its_best_report() -> None:
    angle = MeasuredAngle("plane1", "plane2", 90.0, 0.3, "set square")
    best = validate(replace(make_reconstruction(), pair_id="left-right"), PairTruth(None, (angle,)))
    done = PairValidation(reports=(best,), best=best, crosscheck=None, causes=(), files={}, section=None)
    assert done.pair_id == "left-right"


def test_the_board_that_a_calibration_measured_is_known_unless_several_are_declared_alike(tmp_path: Path) -> None:
    shape = BoardShape.of(Board("as-calibrated", 11, 8, 30.0, 30.0), "released", BOARDS[0].points() * [1.004, 1.0, 1.0])
    fit = Mock(boards=(shape, BoardShape.of(BOARDS[1], "flat", BOARDS[1].points())))
    plain, measured = LoadedCamera(CAMERA, None), LoadedCamera(CAMERA, fit)
    other = Board("other", 9, 6, 30.0, 30.0)
    pair = pair_of(tmp_path / "view.png", (BOARDS[0], other))
    assert measured_shapes(pair, plain, measured) == {"plane1": shape} == measured_shapes(pair, measured, plain)
    assert measured_shapes(pair, plain, plain) == {}
    assert measured_shapes(pair_of(tmp_path / "view.png", (*BOARDS[:2], other)), measured, measured) == {}
