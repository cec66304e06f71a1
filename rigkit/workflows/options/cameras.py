"""Options of the workflows on images and cameras.

`rigkit.cli.console.add_options` makes arguments from them at once, so nothing heavy is imported, and annotations are
evaluated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Literal

from rigkit.core.errors import InputError
from rigkit.workflows.options.base import FrameRule, NamesFiles, WrittenFiles


class Cache(StrEnum):
    """What to do with the corner cache beside a session. It saves time and never changes a result."""

    OFF = "off"
    """Neither read nor written."""
    READ = "read"
    """Read where it is valid."""
    UPDATE = "update"
    """Read where it is valid, and written."""


@dataclass(frozen=True, slots=True)
class Known:
    """Files of known cameras.

    Attributes
    ----------
    lenses : keep the intrinsics of these files (one per camera, or one rig); solve for the extrinsics only.
    rig : keep intrinsics and extrinsics of this rig; add the other cameras to it.
    """

    lenses: tuple[Path, ...] = ()
    rig: Path | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """All files."""
        return self.lenses if self.rig is None else (*self.lenses, self.rig)

    def of_cameras(self, names: Sequence[str]) -> dict[str, Path]:
        """Return the lens file of each camera; raises InputError if their number is neither 1 nor that of cameras."""
        if not self.lenses:
            return {}
        if len(self.lenses) not in (1, len(names)):
            raise InputError(
                f"{len(self.lenses)} lenses for {len(names)} cameras ({', '.join(names)}); give one file a camera in "
                "that order, or one rig"
            )
        return dict(zip(names, self.lenses * (len(names) if len(self.lenses) == 1 else 1), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrateOptions(WrittenFiles):
    """Outputs of a calibration, and what is known beforehand.

    Attributes
    ----------
    output : file for the calibration (for a rig: of the rig, with the cameras' files beside it); None: nothing is
        written.
    report : file for the HTML report; None: no report.
    cache : how to use the corner cache beside the session.
    corners : use these corners instead of detecting them: corners.csv, corners.json, .vnl (mrcal).
    known : for a rig: files of known cameras.
    pupil : entrance pupil fixed (a central camera), or moving with the angle of view (default: auto, moving where
        images show it).
    exports : formats of other tools to write as well, beside the output (`rigkit.workflows.inputs.formats`).
    plan : propose the images to take next, as the report does.
    """

    output: Path | None = None
    report: Path | None = None
    cache: Cache = Cache.READ
    corners: Path | None = None
    known: Known = field(default_factory=Known)
    pupil: Literal["auto", "central", "moving"] = "auto"
    exports: tuple[str, ...] = ()
    plan: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderOptions(NamesFiles):
    """Options for folders of images and videos.

    Attributes
    ----------
    boards : 9x6x25 (inner corners, mm a square), circles:10x8x25,diameter_mm=15, or a board file.
    square_mm : instead of --board: side of a square (tag; distance of circles); the images say which board it is.
    model : pinhole, brown, kannala_brandt, scaramuzza, ucm, eucm, double_sphere (default: auto, the lowest held-out
        error).
    cameras : number of cameras whose images the folders hold (default: by the names of images and folders, and by the
        boards in them); 1: all are of one camera.
    timestamps : which frames of the videos were taken together (default: timestamps.csv beside them, if it exists).
    """

    boards: tuple[str, ...] = ()
    square_mm: float | None = None
    model: str | None = None
    cameras: int | None = None
    timestamps: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectOptions(WrittenFiles):
    """The boards that images may show, and where the results go.

    Attributes
    ----------
    boards : board files, or words such as 9x6x25; empty: chessboards of every size are detected.
    camera : the camera of all images: finds corners that were missed on the boards given, and places all more finely.
    min_corners : without --board: fewest corners of a chessboard.
    output : write the corners file.
    overlay : write each image with its corners drawn in into this folder.
    jobs : number of processes (default: one per core, for a hundred images or more; for fewer threads).
    """

    boards: tuple[Path, ...] = ()
    camera: Path | None = None
    min_corners: int = 12
    output: Path | None = None
    overlay: Path | None = None
    jobs: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RectifyOptions(WrittenFiles):
    """The ideal camera, and where to write. For a stereo pair only the projection can be chosen.

    Attributes
    ----------
    output : image (.png, .tif, .jpg) or folder to write. In a folder images keep their names, frames of a video are
        000000.png, 000001.png, ..., and a rig has a folder for each camera.
    projection : projection of the ideal camera.
    hfov_deg : horizontal field of view (default: that of the camera).
    angles_deg : yaw (to the right), pitch (up) and roll (clockwise) of the ideal camera.
    size_px : image size of the result; None: keeps the source's resolution.
    interpolation : spline (default) shifts points by less than 0.001 px; linear is fast.
    crop : crop to the largest rectangle without empty pixels (in both images of a pair).
    maps : also write K, P, Q (mm) and maps for cv2.remap.
    frames : which images of a rig are of one moment (default: by their names; "order": by the sorted lists).
    """

    output: Path
    projection: Literal["perspective", "cylindrical", "equirectangular"] = "perspective"
    hfov_deg: float | None = None
    angles_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    size_px: tuple[int, int] | None = None
    interpolation: Literal["spline", "lanczos", "linear", "nearest"] = "spline"
    crop: bool = False
    maps: Path | None = None
    frames: FrameRule | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class HandEyeOptions(WrittenFiles):
    """Camera, board and conventions of a hand-eye calibration.

    Attributes
    ----------
    camera : the camera's calibration.
    board : the board, such as 9x6x25.
    board_on_hand : the hand carries the board, the camera is fixed; the errors of the robot move what its hand carries.
    inverse : the poses are hand_from_base.
    output : write the result.
    """

    camera: Path
    board: Path
    board_on_hand: bool = False
    inverse: bool = False
    output: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyOptions(WrittenFiles):
    """How to run studies, and where their tables and figures go.

    Attributes
    ----------
    output : folder for tables, figures and the finished chunks of an interrupted run; None: nothing is written.
    trials : number of trials (default: that of the file).
    jobs : number of processes; does not change the results.
    dask : a Dask scheduler to use instead of processes.
    figure : format of the figures.
    """

    output: Path | None = None
    trials: int | None = None
    jobs: int = 1
    dask: str | None = None
    figure: Literal["png", "pdf", "svg"] = "png"


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions(NamesFiles):
    """Options of the demo.

    Attributes
    ----------
    output : new folder for the capture, and for the results its subfolder out.
    seed : seed of the random scene.
    jobs : number of processes (default: one per core).
    """

    output: Path = Path("rigkit-demo")
    seed: int = 1
    jobs: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CertifyOptions(WrittenFiles):
    """The limit to compare with, and the files to write.

    Attributes
    ----------
    limit : largest error allowed, mm (deg for angles).
    sigma_px : standard deviation of the image points to be measured, per coordinate (default: that of the corners).
    cameras : two cameras of the rig (default: the first two).
    report : write an HTML report.
    pdf : write a certificate to sign (A4).
    """

    limit: float | None = None
    sigma_px: float | None = None
    cameras: tuple[str, str] | None = None
    report: Path | None = None
    pdf: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DiffOptions(WrittenFiles):
    """Where to write the map of the difference of two cameras.

    Attributes
    ----------
    output : write a map of the difference over the image.
    report : write an HTML report.
    """

    output: Path | None = None
    report: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportCameraOptions(WrittenFiles):
    """The format of an exported camera, and where to write it.

    Attributes
    ----------
    output : file to write.
    kind : format, one of `CAMERA_FORMATS`; None: by the ending.
    source_kind : format of the source; None: by its content.
    size_px : image size, for files that do not state it (py-OCamCalib).
    """

    output: Path
    kind: str | None = None
    source_kind: str | None = None
    size_px: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintOptions(WrittenFiles):
    """Output of a board to print.

    Attributes
    ----------
    output : write NAME.pdf, NAME.svg and, for a new board, NAME.toml.
    paper : a4 (default), a3, a2, a1, a0, letter or tabloid.
    """

    output: Path
    paper: str = "a4"
