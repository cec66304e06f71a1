"""Two folders of pictures, taken together, to a rig, rectified pairs, and the distance of the lenses.

python examples/stereo.py LEFT RIGHT 9x6x30
"""

# %% What there is: a folder a camera, pictures of one moment with one name or number, and the board in them.
import sys
from pathlib import Path

import numpy as np

import rigkit

left, right, board = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
out = left.parent

# %% Each camera alone first, then all lenses and mounts together.
done = rigkit.calibrate_folders(
    [left, right],
    rigkit.FolderOptions(boards=(board,), model="brown"),
    rigkit.CalibrateOptions(output=out / "rig.json", report=out / "rig.html", exports=("opencv",), force=True),
    progress=rigkit.notebook_progress(),
)
rig = done.rig
rig  # noqa: B018 - a notebook shows it with a picture
print(rig)

# %% Where the right lens is, and how sure that is.
first, second = (camera.name for camera in rig.cameras)
distance_mm, sigma_mm = rig.baseline_mm(first, second)
print(f"{distance_mm:.2f} ± {sigma_mm:.2f} mm apart")
right_from_left = rig.cam2_from_cam1(first, second)
print(right_from_left.translation_mm)

# %% Pairs whose rows correspond, cut to what both see, with Q for depth.
pair = rigkit.rectify_stereo_images(
    (left, right),
    out / "rig.json",
    rigkit.RectifyOptions(output=out / "rectified", maps=out / "maps.npz", crop=True, force=True),
)
maps = np.load(out / "maps.npz")
print(len(pair.images), "images;", "Q =", maps["Q"].tolist())
