"""Rigs in other tools' formats: which files one becomes, and what is lost."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.colmap_cameras import write_colmap_cameras
from rigkit.interop.colmap_model import quaternion_wxyz
from rigkit.interop.exchange import MM_PER_M
from rigkit.interop.kalibr import write_kalibr
from rigkit.interop.mrcal import write_cameramodel
from rigkit.interop.opencv_stereo import opencv_stereo
from rigkit.interop.ros import write_camera_info

Rig = Mapping[str, tuple[Camera, Rigid3]]
"""Camera and cam_from_rig (mm) by name."""
Outlines = Mapping[str, Pixels]
"""Of what cameras saw, by name: see `best_accepted`."""


@dataclass(frozen=True, eq=False, slots=True)
class ForeignRig:
    """A rig in another program's format.

    Attributes
    ----------
    files : content by camera; "" stands for all of them in one file.
    max_error_px : largest error of a camera's projection against the one given.
    notes : in words, what a user of the files should know.
    """

    files: Mapping[str, str]
    max_error_px: float
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RigFormat:
    """How a format is written, whether it has a file a camera, and whether it has two cameras only."""

    write: Callable[[Rig, Outlines], ForeignRig]
    per_camera: bool = False
    stereo_only: bool = False

    def keys(self, names: Sequence[str]) -> list[str]:
        """Return the keys that `ForeignRig.files` will have for cameras of these names."""
        return list(names) if self.per_camera else [""]


def write_rig(rig: Rig, kind: str, outlines: Outlines | None = None) -> ForeignRig:
    """Return the rig in the format `kind`, one of RIG_FORMATS; `outlines` of what each camera saw, where it is known.

    Raises InputError for another format, a rig of other than two cameras where the format has stereo pairs only, and
    lenses that no model of the format follows.
    """
    if kind not in RIG_FORMATS:
        raise InputError(f"'{kind}' has no rigs; known are {', '.join(RIG_FORMATS)}; or export the cameras one by one")
    return RIG_FORMATS[kind].write(rig, outlines or {})


def _kalibr(rig: Rig, outlines: Outlines) -> ForeignRig:
    cameras, poses = zip(*rig.values(), strict=True)
    chain = write_kalibr(cameras, poses, [outlines.get(name) for name in rig])
    notes = [
        f"cam{k} is '{name}'" + (f"; {one.note}" if one.note else "")
        for k, (name, one) in enumerate(zip(rig, chain.cameras, strict=True))
    ]
    return ForeignRig({"": chain.text}, max(one.max_error_px for one in chain.cameras), tuple(notes))


def _mrcal(rig: Rig, outlines: Outlines) -> ForeignRig:
    written = {
        name: write_cameramodel(camera, pose, outline=outlines.get(name)) for name, (camera, pose) in rig.items()
    }
    notes = tuple(f"'{name}': {one.note}" for name, one in written.items() if one.note)
    return ForeignRig(
        {name: one.text for name, one in written.items()}, max(one.max_error_px for one in written.values()), notes
    )


def _opencv(rig: Rig, outlines: Outlines) -> ForeignRig:
    (one, (camera1, pose1)), (two, (camera2, pose2)) = _two(rig, "OpenCV")
    stereo = opencv_stereo(camera1, camera2, pose2 @ pose1.inverse(), (outlines.get(one), outlines.get(two)))
    notes = [f"1 is '{one}', 2 is '{two}'; lengths in mm"]
    notes += [f"'{name}': {c.note}" for name, c in zip(rig, stereo.cameras, strict=True) if c.note]
    return ForeignRig({"": stereo.text}, max(c.max_error_px for c in stereo.cameras), tuple(notes))


def _ros(rig: Rig, outlines: Outlines) -> ForeignRig:
    (one, (camera1, pose1)), (two, (camera2, pose2)) = _two(rig, "ROS")
    stereo = opencv_stereo(camera1, camera2, pose2 @ pose1.inverse(), (outlines.get(one), outlines.get(two)))
    P2 = stereo.P2.copy()
    P2[:, 3] /= MM_PER_M
    views = {one: (stereo.R1, stereo.P1), two: (stereo.R2, P2)}
    files = {
        name: write_camera_info(c.camera, re.sub(r"\W", "_", name, flags=re.ASCII), rectification=views[name]).text
        for name, c in zip(rig, stereo.cameras, strict=True)
    }
    notes = [f"left is '{one}', right '{two}'; rectified by OpenCV, lengths in metres"]
    notes += [f"'{name}': {c.note}" for name, c in zip(rig, stereo.cameras, strict=True) if c.note]
    return ForeignRig(files, max(c.max_error_px for c in stereo.cameras), tuple(notes))


def _colmap(rig: Rig, outlines: Outlines) -> ForeignRig:
    """Return COLMAP's rig_config.json; the first camera is the rig's reference, images lie in a folder a camera."""
    ids = {name: k for k, name in enumerate(rig, start=1)}
    seen = {ids[name]: outline for name, outline in outlines.items() if name in ids}
    _, written = write_colmap_cameras({ids[name]: camera for name, (camera, _) in rig.items()}, seen)
    reference = next(iter(rig.values()))[1]
    cameras: list[dict[str, object]] = []
    for (name, (_, pose)), line in zip(rig.items(), written.values(), strict=True):
        _, model, _, _, *values = line.text.split()
        entry: dict[str, object] = {"image_prefix": f"{name}/"}
        if cameras:
            from_reference = pose @ reference.inverse()
            entry["cam_from_rig_rotation"] = quaternion_wxyz(from_reference.rotation).tolist()
            entry["cam_from_rig_translation"] = from_reference.translation_mm.tolist()
        else:
            entry["ref_sensor"] = True
        cameras.append({**entry, "camera_model_name": model, "camera_params": [float(value) for value in values]})
    notes = ["rig_config.json of COLMAP; one folder of images a camera, lengths in mm"]
    notes += [f"'{name}': {line.note}" for name, line in zip(rig, written.values(), strict=True) if line.note]
    text = json.dumps([{"cameras": cameras}], indent=1, allow_nan=False) + "\n"
    return ForeignRig({"": text}, max(line.max_error_px for line in written.values()), tuple(notes))


def _two(rig: Rig, format_name: str) -> tuple[tuple[str, tuple[Camera, Rigid3]], tuple[str, tuple[Camera, Rigid3]]]:
    if len(rig) != 2:
        raise InputError(f"{format_name} has files of stereo pairs, this rig has {len(rig)} cameras; name two of them")
    one, two = rig.items()
    return one, two


RIG_FORMATS = {
    "kalibr": RigFormat(_kalibr),
    "opencv": RigFormat(_opencv, stereo_only=True),
    "ros": RigFormat(_ros, per_camera=True, stereo_only=True),
    "mrcal": RigFormat(_mrcal, per_camera=True),
    "colmap": RigFormat(_colmap),
}
"""By name; adding one is a function and a line."""
