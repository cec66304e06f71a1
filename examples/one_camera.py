"""Pictures of a board to a calibration: how sure it is and where, another tool's file, a straightened image.

python examples/one_camera.py FOLDER 9x6x30
"""

# %% What there is: a folder of pictures, and the board in them (inner corners, mm a square).
import sys
from pathlib import Path

import numpy as np

import rigkit

folder, board = Path(sys.argv[1]), sys.argv[2]

# %% Calibrate. No initial guess, any lens: the model that predicts best is chosen, unless one is named.
done = rigkit.calibrate_folders(
    [folder],
    rigkit.FolderOptions(boards=(board,), model="brown"),
    rigkit.CalibrateOptions(output=folder / "calibration.json", report=folder / "calibration.html", force=True),
    progress=rigkit.notebook_progress(),
)
calibration = done.calibration
calibration  # noqa: B018 - a notebook shows it with a picture
print(calibration)

# %% What is good, and what is not.
for finding in calibration.verdicts:
    print(finding)

# %% Points to pixels and back, with what the lens is sure of.
pixels, seen = calibration.camera.project(np.array([[100.0, -50.0, 800.0], [0.0, 0.0, 500.0]]))
rays, valid = calibration.camera.unproject(pixels)
print(pixels[seen], rays[valid])

# %% For another tool, and an image without distortion.
rigkit.export_camera(
    folder / "calibration.json", rigkit.ExportCameraOptions(output=folder / "camera.yaml", kind="opencv", force=True)
)
image = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".png"))[0]
straight = rigkit.rectify_image(
    image,
    folder / "calibration.json",
    rigkit.RectifyOptions(output=folder / "straight" / "first.png", crop=True, force=True),
)
print(straight.images[0].path, f"{straight.images[0].covered:.0%} of it seen")
