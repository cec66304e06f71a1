"""Picture of a scene without boards: which correspondences agree, and the normals found there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.reconstruction.scene import SceneReconstruction
from rigkit.report.figures import as_png, pair_axes


def normals_png(
    scene: SceneReconstruction, found: Correspondences, image1: NDArray[Any], image2: NDArray[Any]
) -> bytes:
    """Draw the points over both images, coloured by their normals; grey crosses: correspondences that do not fit.

    Red, green and blue stand for the parts of the normal to the right, upwards and towards camera 1.
    """
    figure, axes = pair_axes(image1, image2)
    colours = np.clip(0.5 + 0.5 * scene.reconstruction.cloud.normals * [1.0, -1.0, -1.0], 0.0, 1.0)
    for axis, pixels in zip(axes, (found.pixels1, found.pixels2), strict=True):
        out = pixels[~scene.inliers]
        axis.scatter(out[:, 0], out[:, 1], s=14, marker="x", color="0.6", linewidths=0.8)
        at = pixels[scene.kept]
        axis.scatter(at[:, 0], at[:, 1], s=26, c=colours, edgecolors="white", linewidths=0.5)
    agree = f"{int(scene.inliers.sum())} of {len(found)} correspondences agree"
    axes[0].set_title(f"{scene.reconstruction.pair_id}: {agree}", fontsize=9)
    axes[1].set_title("colour: normal (red right, green up, blue towards camera 1)", fontsize=9)
    return as_png(figure)
