"""A pair and its cloud as COLMAP's text model: COLMAP itself projects every point onto its corner."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.depth_edge import cloud_of

from rigkit.cameras.brown import Brown
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.interop.colmap_model import colmap_model

LEFT = Brown((640, 480), np.array([534.0, 538.2, 341.7, 238.9, -0.28, 0.1, 0.001, 0.0002]))
RIGHT = Brown((640, 480), np.array([537.0, 536.8, 326.5, 250.1, -0.29, 0.11, -0.0005, 0.0001]))
POSE = Rigid3(exp_so3(np.array([0.1, 0.05, -0.18])), [-95.0, 4.0, 9.0])
SAME_PX = 1e-5
"""Corners are written with nine digits."""


@pytest.mark.parametrize("count", [1, 2])
def test_colmap_projects_the_points_onto_the_corners(count: int, tmp_path: Path, rng: np.random.Generator) -> None:
    import pycolmap

    cameras = (LEFT, LEFT if count == 1 else RIGHT)
    points = rng.uniform([-200, -150, 900], [250, 150, 1500], (20, 3))
    seen = tuple(camera.project(p)[0] for camera, p in zip(cameras, (points, POSE.apply(points)), strict=True))
    cloud = cloud_of(points, np.broadcast_to([0.0, 0.0, -1.0], points.shape))
    images = (tmp_path / "a.png", tmp_path / "b.png")
    files, notes = colmap_model((cameras[0], cameras[1]), POSE, (seen[0], seen[1]), cloud, images, error_px=0.1)
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert not notes and model.num_cameras() == count and model.num_points3D() == len(points)
    for number, pixels in enumerate(seen, start=1):
        image = model.images[number]
        for point, pixel in zip(image.points2D, pixels, strict=True):
            # The centre of COLMAP's first pixel is (0.5, 0.5).
            np.testing.assert_allclose(point.xy - 0.5, pixel, atol=SAME_PX)
            theirs = model.points3D[point.point3D_id].xyz
            projected = image.project_point(theirs)
            assert projected is not None and np.abs(projected - point.xy).max() < SAME_PX
