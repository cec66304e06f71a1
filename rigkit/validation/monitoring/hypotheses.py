"""Hypotheses on what happened to a camera or a rig, each as directions of change in the parameters theta."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.displaced import lens_of
from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.cameras.base import Camera, image_center
from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.moving_pupil import far_camera
from rigkit.core.arrays import FloatArray
from rigkit.geometry.rotation import skew
from rigkit.planning.goal import GOAL_GRID, Goal, projection_goal
from rigkit.validation.monitoring.evidence import Monitored

FIELD_GRID = (24, 18)
FIT_RANK = 1e-9


@dataclass(frozen=True, eq=False, slots=True)
class Hypothesis:
    """A possible change of a camera or a rig.

    Attributes
    ----------
    kind : "focus", "principal point", "distortion", "rotation", "shift", "moved" (both), "lens" or "scale".
    camera : name of the changed camera; None for the whole rig.
    directions : (T, m) of theta.
    units : of the m amounts.
    """

    kind: str
    camera: str | None
    directions: FloatArray
    units: tuple[str, ...]

    @property
    def words(self) -> str:
        """The change as a clause."""
        texts = {
            "focus": "the focus of {} changed",
            "principal point": "the principal point of {} moved",
            "distortion": "the distortion of {} changed",
            "lens": "several parameters of the lens of {} changed",
            "rotation": "{} was rotated on its mount",
            "shift": "{} was shifted",
            "moved": "{} was moved (shifted and rotated)",
            "scale": "the scale changed: all baselines alike, or the board has squares of another size",
        }
        return texts[self.kind].format("the camera" if self.camera is None else f"camera '{self.camera}'")


def hypotheses_of(monitored: Monitored) -> list[Hypothesis]:
    """Return all hypotheses, those with the fewest amounts first."""
    layout, lenses, mounts = monitored.layout, [], []
    for c, (name, camera) in enumerate(zip(monitored.names, monitored.cameras, strict=True)):
        own = name if monitored.is_rig else None
        whole = np.zeros((layout.count, 6))
        whole[layout.cameras[c]] = _lens_directions(camera)
        units: tuple[str, ...] = ("%", *("px",) * 5)
        for kind, part in (
            ("focus", slice(0, 1)),
            ("principal point", slice(1, 3)),
            ("distortion", slice(3, 6)),
            ("lens", slice(0, 6)),
        ):
            lenses.append(Hypothesis(kind, own, whole[:, part], units[part]))
        if monitored.is_rig and (c > 0 or len(monitored.cameras) > 2):
            turn = _mount_directions(monitored, c)
            mounts.append(Hypothesis("rotation", own, turn[:, :3], ("deg",) * 3))
            mounts.append(Hypothesis("shift", own, turn[:, 3:], ("mm",) * 3))
            mounts.append(Hypothesis("moved", own, turn, ("deg",) * 3 + ("mm",) * 3))
    if monitored.is_rig:
        scale = np.zeros((layout.count, 1))
        for c, pose in enumerate(monitored.cam_from_rig[1:], start=1):
            scale[layout.mount(c)][3:, 0] = 0.01 * pose.translation_mm
        mounts.append(Hypothesis("scale", None, scale, ("%",)))
    return sorted([*lenses, *mounts], key=lambda hypothesis: hypothesis.directions.shape[1])


def lens_goals(monitored: Monitored) -> list[Goal]:
    """Return for each camera the rms change of its projection of distant points over its image, after the best
    rotation."""
    out, layout = [], monitored.layout
    for camera, run in zip(monitored.cameras, layout.cameras, strict=True):
        far = far_camera(camera)
        goal, own = projection_goal(far), slice(run.start, run.start + far.parameters.size)
        weight = np.zeros((layout.count, layout.count))
        weight[own, own] = goal.weight
        out.append(Goal(weight, goal.unit, goal.what))
    return out


def turn_weight(camera: Camera) -> FloatArray:
    """Return W (3, 3) such that w^T W w is the mean square displacement over the image, px^2, of distant points by a
    rotation w (rad) of the camera."""
    camera = far_camera(camera)
    rays, valid = camera.unproject(grid_pixels(camera.size_px, GOAL_GRID).reshape(-1, 2))
    by_turn = projection_design(camera, rays[valid])[:, camera.parameters.size :]
    return np.asarray(np.einsum("ikm,ilm->kl", by_turn, by_turn) / by_turn.shape[2])


def _lens_directions(camera: Camera) -> FloatArray:
    """Return the changes of the parameters (P, 6) that best approximate: scaling the image by 1 %, moving it by a
    pixel right and down, and distorting it by a pixel at its rim with the third, fifth and seventh power of the radius.
    Parameters of the model's inadequacy are not used."""
    out = np.zeros((camera.parameters.size, 6))
    camera = lens_of(far_camera(camera))
    pixels = grid_pixels(camera.size_px, FIELD_GRID).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    axis, seen = camera.project(np.array([0.0, 0.0, 1.0]))
    offset = pixels[valid] - (axis if seen else image_center(camera.size_px))
    rim = float(np.linalg.norm(offset, axis=1).max())
    part = offset / rim
    squared = (part**2).sum(axis=1, keepdims=True)
    one = np.ones(len(offset))
    fields = [
        0.01 * offset,
        np.stack([one, 0.0 * one], axis=-1),
        np.stack([0.0 * one, one], axis=-1),
        part * squared,
        part * squared**2,
        part * squared**3,
    ]
    wanted = np.stack([f.reshape(-1) for f in fields], axis=-1)
    p = camera.parameters.size
    design = projection_design(camera, rays[valid])[:, :p].transpose(2, 0, 1).reshape(-1, p)
    scale = np.linalg.norm(design, axis=0)
    safe = np.where(scale > 0.0, scale, 1.0)
    out[:p] = np.linalg.lstsq(design / safe, wanted, rcond=FIT_RANK)[0] / safe[:, None]
    return out


def _mount_directions(monitored: Monitored, c: int) -> FloatArray:
    """Return the change of theta (T, 6) when camera `c` turns by a degree about its own axes or shifts by a millimetre
    along them: a point x in it becomes exp(w) x + v."""
    layout, degree = monitored.layout, np.radians(1.0)
    out = np.zeros((layout.count, 6))
    if c > 0:
        # exp(w) (R x + t) + v: the rotation affects t, too.
        pose = monitored.cam_from_rig[c]
        run = layout.mount(c)
        out[run.start : run.start + 3, :3] = degree * np.eye(3)
        out[run.start + 3 : run.stop, :3] = -degree * skew(pose.translation_mm)
        out[run.start + 3 : run.stop, 3:] = np.eye(3)
        return out
    # The first camera is the frame: its motion moves all others inversely.
    for k, pose in enumerate(monitored.cam_from_rig[1:], start=1):
        run = layout.mount(k)
        out[run.start : run.start + 3, :3] = -degree * pose.rotation
        out[run.start + 3 : run.stop, 3:] = -pose.rotation
    return out
