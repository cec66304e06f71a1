"""Good pictures of one board from several sides, with its corners, poses of a robot and sessions, for `fuzz.py`: what
is damaged there is used by a whole calibration, not only read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fuzzing.scenes import H21, PLACES
from rigkit.affine.correspondences import Correspondences
from rigkit.cameras.registry import camera_model
from rigkit.core.detections import BoardDetection
from rigkit.io.boards.board_file import load_board
from rigkit.io.calibrations.calibration_file import save_camera
from rigkit.io.corners.corner_cache import CornerCache, FoundCorners
from rigkit.io.corners.corners_file import corners_text
from rigkit.io.corners.correspondences import correspondences_text

SIZE_PX = (160, 120)
FIRST_PX, STEP_PX = (37.5, 29.5), 18.0
"""Of the good picture from straight ahead: its corner (0, 0), and how far apart corners are."""
SQUARE_MM, COLUMNS, ROWS = 30.0, 5, 4
DISTANCE_MM = 260.0
K = np.array([[150.0, 0.0, 79.5], [0.0, 150.0, 59.5], [0.0, 0.0, 1.0]])
TILTS_DEG = ((0, 0, 0), (25, 0, 5), (-25, 10, -5), (5, 30, 10), (-10, -30, 0), (20, 20, 20))

SESSION = """schema = "rigkit.session/1"
images = "{images}"
board = "floor.toml"
model = "pinhole"
"""


def write_views(folder: Path) -> None:
    """Write them into the folder of the other good files."""
    flat = np.asarray(cv2.imread(str(folder / "image.png"), cv2.IMREAD_GRAYSCALE))
    mm_from_px = np.array([[1.0, 0.0, -FIRST_PX[0]], [0.0, 1.0, -FIRST_PX[1]], [0.0, 0.0, STEP_PX / SQUARE_MM]])
    grid = np.array([(c, r) for r in range(ROWS) for c in range(COLUMNS)])
    (folder / "views").mkdir()
    found: dict[str, list[BoardDetection]] = {}
    rows = ["image,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg"]
    for number, angles in enumerate(TILTS_DEG, 1):
        rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        place = np.array([0.0, 0.0, DISTANCE_MM]) - rotation @ (60.0, 45.0, 0.0)
        H = K @ np.column_stack([rotation[:, :2], place])
        name = f"v{number}.png"
        picture = cv2.warpPerspective(flat, H @ mm_from_px, SIZE_PX, borderValue=220)
        cv2.imwrite(str(folder / "views" / name), picture)
        ends = np.column_stack([SQUARE_MM * grid, np.ones(len(grid))]) @ H.T
        pixels = ends[:, :2] / ends[:, 2:] + np.random.default_rng(number).normal(0.0, 0.02, (len(grid), 2))
        found[f"views/{name}"] = [BoardDetection("floor", COLUMNS, ROWS, grid, pixels, np.full(len(grid), 0.05))]
        # The hand holds the camera, without an offset, and the board lies at the base.
        turned = Rotation.from_matrix(rotation.T).as_rotvec(degrees=True)
        rows.append(",".join([name, *(f"{value:.6f}" for value in (*(-rotation.T @ place), *turned))]))
    (folder / "views.csv").write_text(corners_text(found))
    matched = Correspondences(PLACES, PLACES @ H21[:2, :2].T + H21[:2, 2], np.tile(H21[:2, :2], (len(PLACES), 1, 1)))
    (folder / "matched.csv").write_text(correspondences_text(matched))
    assert matched.A21 is not None
    np.savez(folder / "matched.npz", pixels1=matched.pixels1, pixels2=matched.pixels2, A21=matched.A21)
    (folder / "hand.csv").write_text("\n".join(rows) + "\n")
    kept = CornerCache(folder / "kept.json", [load_board(folder / "floor.toml")])
    for name, boards in found.items():
        kept.put(Path(name).name, "0" * 64, FoundCorners(SIZE_PX, tuple(boards)))
    kept.save()
    (folder / "views.toml").write_text(SESSION.format(images="views/*.png"))
    save_camera(folder / "pinhole.json", camera_model("pinhole")(SIZE_PX, K[[0, 1, 0, 1], [0, 1, 2, 2]]))
    (folder / "gone.toml").write_text(SESSION.format(images="gone/*.png"))
