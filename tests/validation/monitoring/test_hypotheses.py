"""Directions of hypotheses against the motions and image changes that they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.monitoring_scenes import known_rig

from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.validation.monitoring.evidence import Monitored
from rigkit.validation.monitoring.hypotheses import hypotheses_of

POSES = (
    Rigid3.identity(),
    Rigid3(exp_so3(np.array([0.1, -0.4, 0.2])), [-300.0, 40.0, 60.0]),
    Rigid3(exp_so3(np.array([-0.3, 0.2, 0.7])), [150.0, -90.0, 500.0]),
)
STEP = 1e-5
"""Of a degree, a millimetre or a per cent: what is left is of second order."""


def rig_of_three() -> Monitored:
    two = known_rig(POSES[1], [1.0] * 8, 1e-3, 100.0)
    count = 3 * two.cameras[0].parameters.size + 2 * 6
    cameras, names = (*two.cameras, two.cameras[0]), ("left", "right", "third")
    return replace(two, names=names, cameras=cameras, cam_from_rig=POSES, covariance=np.eye(count))


def moved_by(rig: Monitored, kind: str, camera: str | None, amounts: np.ndarray) -> tuple[Monitored, Monitored]:
    (hypothesis,) = (h for h in hypotheses_of(rig) if (h.kind, h.camera) == (kind, camera))
    change = hypothesis.directions @ amounts
    return rig.changed(STEP * change), rig.changed(-STEP * change)


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_moved_camera_changes_its_pose_to_every_other(moved: int, rng: np.random.Generator) -> None:
    rig, amounts = rig_of_three(), rng.normal(size=6)
    for kind, part in (("rotation", [1] * 3 + [0] * 3), ("shift", [0] * 3 + [1] * 3), ("moved", [1] * 6)):
        own = amounts * part
        asked = own if kind == "moved" else own[np.array(part) > 0]
        there, back = moved_by(rig, kind, rig.names[moved], asked)
        # A point x in the camera becomes exp(w) x + v.
        motions = [Rigid3(exp_so3(s * np.radians(own[:3])), s * own[3:]) for s in (STEP, -STEP)]
        for k in range(3):
            found, wanted = [], []
            for rig_now, motion in zip((there, back), motions, strict=True):
                found.append((rig_now.cam_from_rig[moved] @ rig_now.cam_from_rig[k].inverse()).matrix())
                pose = POSES[moved] @ POSES[k].inverse()
                wanted.append((pose if k == moved else motion @ pose).matrix())
            slopes = [(a[0] - a[1]) / (2.0 * STEP) for a in (found, wanted)]
            np.testing.assert_allclose(slopes[0], slopes[1], atol=1e-6)


def test_the_scale_lengthens_all_baselines_and_lenses_change_their_images() -> None:
    rig = rig_of_three()
    there, back = moved_by(rig, "scale", None, np.ones(1))
    for pose, more, less in zip(POSES, there.cam_from_rig, back.cam_from_rig, strict=True):
        slope = (more.translation_mm - less.translation_mm) / (2.0 * STEP)
        np.testing.assert_allclose(slope, 0.01 * pose.translation_mm, atol=1e-6)
    camera = rig.cameras[1]
    rays, valid = camera.unproject(np.array([[300.0, 200.0], [900.0, 700.0], [1200.0, 400.0]]))
    assert valid.all()
    before, axis = camera.project(rays)[0], camera.project(np.array([0.0, 0.0, 1.0]))[0]
    for kind, amounts, wanted in (
        ("focus", [1.0], 0.01 * (before - axis)),
        ("principal point", [0.0, 1.0], np.broadcast_to([0.0, 1.0], before.shape)),
    ):
        there, back = moved_by(rig, kind, "right", np.array(amounts))
        slope = (there.cameras[1].project(rays)[0] - back.cameras[1].project(rays)[0]) / (2.0 * STEP)
        np.testing.assert_allclose(slope, wanted, atol=1e-3)
