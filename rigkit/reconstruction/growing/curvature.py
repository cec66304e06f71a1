"""Correct grown pairs for the curvature of the surface in their alignment windows (`affine.curvature`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.affine.curvature import curvature_shift, window_variance
from rigkit.affine.refine_patches import levels_of_larger
from rigkit.cameras.base import Camera
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.growing.grow import HALF_WIDTH, GrownPatches
from rigkit.reconstruction.growing.surface import PairRays


def correct_curvature(grown: GrownPatches, camera1: Camera, camera2: Camera, cam2_from_cam1: Rigid3) -> GrownPatches:
    """Return the pairs, at their nodes or `centred`, with corrected pixels in image 2."""
    planes = PairRays.of(grown, camera1, camera2).planes(cam2_from_cam1)
    at = grown.valid & np.isfinite(planes[..., 0])
    place = grown.pixels1[at]
    rows, columns = np.nonzero(at)
    off = place - grown.step * np.stack([columns, rows], axis=1)
    variance = window_variance(HALF_WIDTH) * 4.0 ** (grown.coarser[at] + levels_of_larger(grown.A21[at]))
    pixels2 = grown.pixels2.copy()
    pixels2[at] -= curvature_shift(place, planes[at], variance, (camera1, camera2), cam2_from_cam1, off)
    return replace(grown, pixels2=pixels2)
