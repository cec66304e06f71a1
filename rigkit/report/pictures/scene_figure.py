"""Picture of a scene without boards: inlier correspondences and their normals."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.affine.correspondences import Correspondences
from rigkit.reconstruction.scene import SceneReconstruction
from rigkit.report.pictures.figures import as_png, pair_axes

POINTS_PER_INCH = 72.0
DENSE_SIDE = 4.0
"""Side of the square on the page for each correspondence, in typographic points, below which the drawing is dense."""


def normals_png(
    scene: SceneReconstruction, found: Correspondences, image1: NDArray[Any], image2: NDArray[Any]
) -> bytes:
    """Draw the points over both images, coloured by their normals; outliers are grey.

    Red, green and blue are the components of the normal to the right, upwards and towards camera 1. Few points are
    drawn as ringed dots, dense clouds as adjacent squares.
    """
    figure, axes = pair_axes(image1, image2)
    on_page = POINTS_PER_INCH * figure.get_figwidth() * axes[0].get_position().width / image1.shape[1]
    area = float(np.prod(np.ptp(found.pixels1, axis=0))) / max(1, len(found))
    side = on_page * np.sqrt(area)
    dense = side < DENSE_SIDE
    colours = np.clip(0.5 + 0.5 * scene.reconstruction.cloud.normals * [1.0, -1.0, -1.0], 0.0, 1.0)
    for axis, pixels in zip(axes, (found.pixels1, found.pixels2), strict=True):
        out = pixels[~scene.inliers]
        at = pixels[scene.kept]
        if dense:
            axis.scatter(*out.T, s=side**2 / 4.0, marker="s", color="0.6", linewidths=0.0)
            axis.scatter(*at.T, s=side**2, marker="s", c=colours, linewidths=0.0)
        else:
            axis.scatter(*out.T, s=14, marker="x", color="0.6", linewidths=0.8)
            axis.scatter(*at.T, s=26, c=colours, edgecolors="white", linewidths=0.5)
    agree = f"{int(scene.inliers.sum())} of {len(found)} correspondences agree"
    axes[0].set_title(f"{scene.reconstruction.pair_id}: {agree}", fontsize=9)
    axes[1].set_title("colour: normal (red right, green up, blue towards camera 1)", fontsize=9)
    return as_png(figure)
