"""Whether correspondences fit a scene, which tells exchanged images of a rig from those of another scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.epipolar_scenes import REGULAR, pair

from rigkit.affine.correspondences import Correspondences
from rigkit.core.errors import DegenerateError
from rigkit.core.progress import silent
from rigkit.reconstruction.scene import SceneReconstruction, reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose
from rigkit.workflows.options.clouds import SceneOptions
from rigkit.workflows.reconstruction.reconstruct_scene import _fits, _sparse


def test_correspondences_fit_the_pose_that_they_are_of_and_no_other(rng: np.random.Generator) -> None:
    matches, pose, _ = pair(rng, 60, noise_px=0.3, sigma_A=0.03)
    found = Correspondences(matches.pixels1, matches.pixels2, matches.A21)

    def scene_of(correspondences: Correspondences) -> SceneReconstruction:
        return reconstruct_scene(correspondences, REGULAR, REGULAR, known_pose=KnownPose(pose))

    assert _fits(scene_of, found)
    assert not _fits(scene_of, found.exchanged())


@pytest.mark.parametrize("exchanged", [True, False])
def test_images_of_a_rig_are_called_exchanged_where_they_fit_it_in_the_opposite_order(
    exchanged: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    matches, pose, _ = pair(rng, 60, noise_px=0.3, sigma_A=0.03)
    found = Correspondences(matches.pixels1, matches.pixels2, matches.A21).exchanged()
    if not exchanged:
        found = Correspondences(found.pixels1, found.pixels2[::-1], found.A21)
    monkeypatch.setattr(
        "rigkit.workflows.reconstruction.reconstruct_scene.match_affine_features", lambda *_, **__: found
    )
    options = SceneOptions(rig=Path("rig.json"), images=(Path("a.png"), Path("b.png")))
    empty = np.zeros(REGULAR.size_px[::-1], dtype=np.uint8)
    with pytest.raises(DegenerateError) as raised:
        _sparse(options, (REGULAR, REGULAR), KnownPose(pose), (empty, empty), silent)
    assert ("images 'a.png' and 'b.png' are exchanged" in str(raised.value)) == exchanged
