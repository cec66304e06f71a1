"""Whether correspondences fit a scene, which tells exchanged images of a rig from those of another scene."""

from __future__ import annotations

import numpy as np
from helpers.epipolar_scenes import REGULAR, pair

from rigkit.affine.correspondences import Correspondences
from rigkit.reconstruction.scene import SceneReconstruction, reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose
from rigkit.workflows.reconstruction.reconstruct_scene import _fits


def test_correspondences_fit_the_pose_that_they_are_of_and_no_other(rng: np.random.Generator) -> None:
    matches, pose, _ = pair(rng, 60, noise_px=0.3, sigma_A=0.03)
    found = Correspondences(matches.pixels1, matches.pixels2, matches.A21)

    def scene_of(correspondences: Correspondences) -> SceneReconstruction:
        return reconstruct_scene(correspondences, REGULAR, REGULAR, known_pose=KnownPose(pose))

    assert _fits(scene_of, found)
    assert not _fits(scene_of, found.exchanged())
