"""The scene of a calibration's page."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.result import ViewResult
from rigkit.geometry.rigid3 import Rigid3
from rigkit.report.pictures.scene_view import boards_scene


def test_parts_of_a_board_are_drawn_as_that_board() -> None:
    """Each part is a board of its own in its image; with a name each they cover the drawing."""
    corners = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [9.0, 9.0, 0.0], [0.0, 9.0, 0.0]])
    names = ("wall", "wall part of 1.png", "wall part of 2.png", "wall2")
    views = [
        ViewResult(
            image=f"{k}.png",
            board_id=name,
            cam_from_board=Rigid3(np.eye(3), [0.0, 0.0, 100.0]),
            grid=np.array([[0, 0]]),
            pixels=np.zeros((1, 2)),
            residuals_px=np.zeros((1, 2)),
            kept=np.array([True]),
        )
        for k, name in enumerate(names)
    ]
    scene = boards_scene(views, [BoardShape(name, "flat", corners) for name in names])
    assert scene["boards"] == ["wall", "wall2"]
    assert [plane["board"] for plane in scene["planes"]] == [0, 0, 0, 1]
