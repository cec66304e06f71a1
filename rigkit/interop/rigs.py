"""Writers of rigs in other tools' formats."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.interop.colmap_rig import write_colmap_rig
from rigkit.interop.exchange import MM_PER_M, Written
from rigkit.interop.kalibr import write_kalibr
from rigkit.interop.mrcal import write_cameramodel
from rigkit.interop.opencv import OpenCVStereo, opencv_stereo
from rigkit.interop.ros import write_camera_info

Rig = Mapping[str, tuple[Camera, Rigid3]]
"""Camera and cam_from_rig (mm) by name."""
Outlines = Mapping[str, Pixels]
"""Outlines of the corners by camera: see `best_accepted`."""


@dataclass(frozen=True, eq=False, slots=True)
class ForeignRig:
    """A rig in another program's format.

    Attributes
    ----------
    files : content by camera; "" is the key of one file for all cameras.
    max_error_px : largest difference of a camera's projection from the original.
    notes : notes for users of the files.
    """

    files: Mapping[str, str]
    max_error_px: float
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RigFormat:
    """The writer of a format, whether it has one file for each camera, and whether it needs exactly two cameras."""

    write: Callable[[Rig, Outlines], ForeignRig]
    per_camera: bool = False
    stereo_only: bool = False

    def keys(self, names: Sequence[str]) -> list[str]:
        """Return the keys of `ForeignRig.files` for cameras of these names."""
        return list(names) if self.per_camera else [""]


def write_rig(rig: Rig, kind: str, outlines: Outlines | None = None) -> ForeignRig:
    """Return the rig in the format `kind`, one of RIG_FORMATS.

    Raises InputError for another format, more or fewer than two cameras in a format of stereo pairs, and lenses that no
    model of the format fits.
    """
    if kind not in RIG_FORMATS:
        known = f"known are {', '.join(RIG_FORMATS)}; or export one camera: --names ONE -o ONE.json"
        if kind == "rigkit":
            raise InputError(f"a rig needs no export to rigkit: its file is taken wherever a rig is asked for; {known}")
        raise InputError(f"'{kind}' has no rigs; {known}")
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
    return _foreign(rig, {name: one.text for name, one in written.items()}, written.values())


def _opencv(rig: Rig, outlines: Outlines) -> ForeignRig:
    one, two, stereo = _stereo(rig, outlines, "OpenCV")
    return _foreign(rig, {"": stereo.text}, stereo.cameras, f"1 is '{one}', 2 is '{two}'; lengths in mm")


def _ros(rig: Rig, outlines: Outlines) -> ForeignRig:
    one, two, stereo = _stereo(rig, outlines, "ROS")
    P2 = stereo.P2.copy()
    P2[:, 3] /= MM_PER_M
    views = {one: (stereo.R1, stereo.P1), two: (stereo.R2, P2)}
    files = {
        name: write_camera_info(c.camera, re.sub(r"\W", "_", name, flags=re.ASCII), rectification=views[name]).text
        for name, c in zip(rig, stereo.cameras, strict=True)
    }
    what = f"left is '{one}', right '{two}'; rectified by OpenCV, lengths in metres"
    return _foreign(rig, files, stereo.cameras, what)


def _colmap(rig: Rig, outlines: Outlines) -> ForeignRig:
    text, written = write_colmap_rig(rig, outlines)
    what = "rig_config.json of COLMAP; one folder of images a camera, lengths in mm"
    return _foreign(rig, {"": text}, written, what)


def _stereo(rig: Rig, outlines: Outlines, format_name: str) -> tuple[str, str, OpenCVStereo]:
    """Return the names of the rig's two cameras, and the pair in OpenCV's models."""
    if len(rig) != 2:
        raise InputError(f"{format_name} has files of stereo pairs, this rig has {len(rig)} cameras; name two of them")
    (one, (camera1, pose1)), (two, (camera2, pose2)) = rig.items()
    stereo = opencv_stereo(camera1, camera2, pose2 @ pose1.inverse(), (outlines.get(one), outlines.get(two)))
    return one, two, stereo


def _foreign(rig: Rig, files: Mapping[str, str], cameras: Iterable[Written], *about: str) -> ForeignRig:
    """Return the rig of these files and written cameras; its notes are `about` and those of the cameras."""
    written = list(cameras)
    notes = [f"'{name}': {one.note}" for name, one in zip(rig, written, strict=True) if one.note]
    return ForeignRig(files, max(one.max_error_px for one in written), (*about, *notes))


RIG_FORMATS = {
    "kalibr": RigFormat(_kalibr),
    "opencv": RigFormat(_opencv, stereo_only=True),
    "ros": RigFormat(_ros, per_camera=True, stereo_only=True),
    "mrcal": RigFormat(_mrcal, per_camera=True),
    "colmap": RigFormat(_colmap),
}
"""Formats by name."""
