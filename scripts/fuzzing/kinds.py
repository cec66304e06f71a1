"""The classes of input that `fuzz.py` damages, and their readers."""

from __future__ import annotations

from dataclasses import dataclass

from fuzzing.commands import COMMANDS


@dataclass(frozen=True)
class Kind:
    """A class of input: the file that is changed, and what reads it ("{case}", "{out}"); "module:function" is called.

    Without a file the words of the command, or the arguments of a call, are changed.
    """

    file: str | None
    readers: tuple[tuple[str, ...], ...]
    names_file: bool = True
    judged: bool = False
    """What is read is also judged: a sound case may end with any documented code."""


def _camera_file(name: str, *more: tuple[str, ...]) -> Kind:
    return Kind(name, (("export", "{case}", "--to", "rigkit", "-o", "{out}/new.json"), *more))


def _board_file(name: str) -> Kind:
    return Kind(name, (("rigkit.io.boards.board_file:load_board", "{case}"), ("board", "{case}", "-o", "{out}/b")))


def _video(name: str) -> Kind:
    read = ("detect", "-j", "1", "--board", "floor.toml", "{case}")
    return Kind(name, (("fuzzing.readers:read_frames", "{case}"), ("fuzzing.readers:coach_video", "{case}"), read))


def _found_board(name: str, picture: str) -> Kind:
    return Kind(name, (("detect", "-j", "1", "--board", "{case}", picture, "-o", "{out}/new.csv"),))


MATCHES = (
    ("rigkit.io.corners.correspondences:read_correspondences", "{case}"),
    ("reconstruct", "--correspondences", "{case}", "--rig", "rig.json", "--images", "scene1.png", "scene2.png", "-o",
     "{out}/new", "--sparse", "--no-pictures"),
)  # fmt: skip

VIEWS = ("--no-cache", "-o", "{out}/new.json")
RECONSTRUCT = ("-o", "{out}/new", "--no-pictures")

AT_WORK: dict[str, Kind] = {
    "corners-at-work": Kind("views.csv", (("calibrate", "views.toml", "--corners", "{case}", *VIEWS),), judged=True),
    "corners-kept": Kind("kept.json", (("fuzzing.readers:calibrate_kept", "{case}"),), names_file=False),
    "session-at-work": Kind("views.toml", (("calibrate", "{case}", *VIEWS),), judged=True),
    "board-at-work": Kind(
        "floor.toml",
        (
            ("detect", "-j", "1", "--board", "{case}", "image.png"),
            ("calibrate", "views", "--board", "{case}", "--model", "pinhole", *VIEWS),
            ("plan", "--lens", "60", "--size", "320x240", "--board", "{case}", "--views", "4"),
            ("pose", "image.png", "--camera", "calibration.json", "--board", "{case}"),
        ),
        names_file=False,
        judged=True,
    ),
    "study-at-work": Kind(
        "study.toml", (("simulate", "{case}", "--trials", "1", "-o", "{out}/new", "-j", "1"),), judged=True
    ),
    "pairs-at-work": Kind(
        "matched.csv", (("reconstruct", "--correspondences", "{case}", "--rig", "rig.json", *RECONSTRUCT),), judged=True
    ),
    "pairs-npz-at-work": Kind(
        "matched.npz", (("reconstruct", "--correspondences", "{case}", "--rig", "rig.json", *RECONSTRUCT),), judged=True
    ),
    "hand": Kind(
        "hand.csv", (("handeye", "{case}", "views", "--camera", "pinhole.json", "--board", "floor.toml"),), judged=True
    ),
    "pose-at-work": Kind(
        "pose.txt",
        (
            ("reconstruct", "--images", "scene1.png", "scene2.png", "--camera", "calibration.json", "--pose", "{case}",
             *RECONSTRUCT),
        ),
        judged=True,
    ),
    "register": Kind(
        "history.jsonl",
        (("check", "calibration.json", "image.png", "--board", "floor.toml", "--register", "{case}"),),
        judged=True,
    ),
    "catalogue": Kind("public.toml", (("fuzzing.readers:fetch_listed", "{case}"),), names_file=False),
}  # fmt: skip
"""Files that a whole piece of work uses, not only a reader."""

KINDS: dict[str, Kind] = {
    **AT_WORK,
    "png": Kind(
        "image.png",
        (
            ("rigkit.io.media.images:read_image", "{case}"),
            ("detect", "-j", "1", "{case}"),
            ("board", "identify", "{case}"),
            ("pose", "{case}", "--camera", "calibration.json", "--board", "floor.toml"),
            ("rectify", "{case}", "--camera", "calibration.json", "-o", "{out}/new.png"),
        ),
    ),
    "png16": Kind("deep.png", (("rigkit.io.media.images:read_image", "{case}"),)),
    "jpg": Kind("image.jpg", (("rigkit.io.media.images:read_image", "{case}"), ("detect", "-j", "1", "{case}"))),
    "tif": Kind("image.tif", (("rigkit.io.media.images:read_image", "{case}"),)),
    "bmp": Kind("image.bmp", (("rigkit.io.media.images:read_image", "{case}"),)),
    "pgm": Kind("image.pgm", (("rigkit.io.media.images:read_image", "{case}"),)),
    "webp": Kind("image.webp", (("rigkit.io.media.images:read_image", "{case}"),)),
    "board": _board_file("board.toml"),
    "aprilgrid": _board_file("aprilgrid.toml"),
    "circles": _board_file("circles.toml"),
    "session": Kind("session.toml", (("rigkit.io.manifests.session:load_session", "{case}"),)),
    "rig-session": Kind("rig-session.toml", (("rigkit.io.manifests.rig_session:load_rig_session", "{case}"),)),
    "dataset": Kind("dataset.toml", (("rigkit.io.manifests.manifest:load_dataset", "{case}"),)),
    "study": Kind("study.toml", (("rigkit.io.manifests.study_file:load_study", "{case}"),)),
    "calibration": Kind(
        "calibration.json",
        (
            ("rigkit.io.calibrations.calibration_file:load_calibration", "{case}"),
            ("diff", "{case}", "calibration.json"),
            ("plan", "{case}", "-n", "1"),
            ("certify", "{case}", "--length", "200", "--distance", "900"),
            ("export", "{case}", "--to", "opencv", "-o", "{out}/new.yaml"),
            ("rectify", "image.png", "--camera", "{case}", "-o", "{out}/new.png"),
            ("rectify", "image.png", "--camera", "{case}", "-o", "{out}/cut.png", "--crop", "--hfov-deg", "60"),
            ("export", "{case}", "--to", "mrcal", "-o", "{out}/new.cameramodel"),
            ("certify", "{case}", "--length", "200", "--distance", "900", "-r", "{out}/new.html"),
            ("diff", "calibration.json", "{case}", "-r", "{out}/diff.html"),
            ("history", "history.jsonl", "--add", "{case}", "--to", "{case}"),
        ),
    ),
    "lens-at-work": Kind(
        "calibration.json",
        (
            ("pose", "image.png", "--camera", "{case}", "--board", "floor.toml", "--json"),
            ("detect", "-j", "1", "--camera", "{case}", "--board", "floor.toml", "image.png"),
            (
                "reconstruct",
                "--correspondences",
                "pairs.csv",
                "--camera",
                "{case}",
                "-o",
                "{out}/new",
                "--pose-type",
                "planar",
                "--no-pictures",
            ),
        ),
        judged=True,
    ),
    "rig": Kind(
        "rig.json",
        (
            ("rigkit.io.calibrations.rig_file:load_saved_rig", "{case}"),
            ("diff", "{case}", "rig.json"),
            ("certify", "{case}", "--depth", "200", "--distance", "900"),
            ("export", "{case}", "--to", "kalibr", "-o", "{out}/new.yaml"),
            ("export", "{case}", "--to", "opencv", "-o", "{out}/new.yaml"),
            ("rectify", "image.png", "image.jpg", "--rig", "{case}", "-o", "{out}/new.png"),
            ("rectify", "image.png", "image.jpg", "--rig", "{case}", "-o", "{out}/cut.png", "--crop", "--json"),
        ),
    ),
    "board-rigs": Kind(
        "board-rigs.json",
        (
            ("rigkit.io.calibrations.rig_file:load_board_rigs", "{case}"),
            ("diff", "{case}", "board-rigs.json"),
            ("diff", "{case}", "{case}", "-r", "{out}/new.html"),
        ),
    ),
    "corners-json": Kind(
        "corners.json",
        (("rigkit.io.corners.corners_file:read_corners", "{case}"), ("fuzzing.readers:read_cache", "{case}")),
    ),
    "corners-csv": Kind("corners.csv", (("rigkit.io.corners.corners_file:read_corners", "{case}"),)),
    "corners-vnl": Kind("corners.vnl", (("fuzzing.readers:read_vnl", "{case}"),)),
    "truth-csv": Kind("truth.csv", (("fuzzing.readers:read_truth", "{case}"),)),
    "pairs-csv": Kind("pairs.csv", (("rigkit.io.corners.correspondences:read_correspondences", "{case}"),)),
    "pairs-npz": Kind("pairs.npz", (("rigkit.io.corners.correspondences:read_correspondences", "{case}"),)),
    "ply": Kind(
        "cloud.ply",
        (("rigkit.io.ply:read_ply", "{case}"), ("mesh", "{case}", "-o", "{out}/new.ply", "--depth", "3")),
    ),
    "history": Kind(
        "history.jsonl",
        (
            ("history", "{case}", "--json"),
            ("history", "{case}", "-r", "{out}/new.html"),
            ("history", "{case}", "--add", "calibration.json", "--to", "calibration.json"),
        ),
    ),
    "check": Kind(
        "calibration.json", (("check", "{case}", "image.png", "--board", "floor.toml", "--json"),), judged=True
    ),
    "check-rig": Kind(
        "rig.json", (("check", "{case}", "image.png", "image.jpg", "--board", "floor.toml"),), judged=True
    ),
    "check-image": Kind(
        "image.png",
        (("check", "calibration.json", "{case}", "--board", "floor.toml", "--fix", "{out}/new.json"),),
        judged=True,
    ),
    "tags-alone": _found_board("alone.toml", "tags.png"),
    "circles-found": _found_board("hexagonal.toml", "dots.png"),
    "boofcv-hexagonal": _board_file("hexagonal.yaml"),
    "known-session": Kind(
        "known.toml",
        (
            ("rigkit.io.manifests.rig_session:load_rig_session", "{case}"),
            ("calibrate", "{case}", "--no-cache", "-o", "{out}/new.json"),
        ),
        judged=True,
    ),
    "added-session": Kind("added.toml", (("calibrate", "{case}", "--no-cache", "-o", "{out}/new.json"),), judged=True),
    "known-lens": Kind(
        "calibration.json",
        (("calibrate", "known.toml", "--no-cache", "--only-extrinsics", "{case}", "-o", "{out}/new.json", "--force"),),
        names_file=False,
        judged=True,
    ),
    "known-rig": Kind(
        "rig.json",
        (
            ("calibrate", "added.toml", "--no-cache", "--add-camera", "{case}", "-o", "{out}/new.json"),
            ("calibrate", "known.toml", "--no-cache", "--only-extrinsics", "{case}", "-o", "{out}/new.json"),
        ),
        names_file=False,
        judged=True,
    ),
    "scene-rig": Kind(
        "rig.json",
        (
            (
                "reconstruct",
                "--images",
                "scene1.png",
                "scene2.png",
                "--rig",
                "{case}",
                "-o",
                "{out}/new",
                "--no-pictures",
            ),
        ),
        judged=True,
    ),
    "scene-image": Kind(
        "scene2.png",
        (("reconstruct", "--images", "scene1.png", "{case}", "--rig", "rig.json", "-o", "{out}/new", "--no-pictures"),),
        judged=True,
    ),
    "matches-npz": Kind("lightglue.npz", MATCHES),
    "frames-npz": Kind("lafs.npz", MATCHES),
    "colmap-database": Kind("matches.db", (("fuzzing.readers:read_database", "{case}"), *MATCHES[1:])),
    "poses": Kind("poses.csv", (("rigkit.io.manifests.robot_poses:read_robot_poses", "{case}"),)),
    "poses-turned": Kind("turns.csv", (("rigkit.io.manifests.robot_poses:read_robot_poses", "{case}"),)),
    "pose": Kind("pose.txt", (("rigkit.workflows.reconstruction.reconstruct_scene:_read_pose", "{case}"),)),
    "avi": _video("film.avi"),
    "mp4": _video("film.mp4"),
    "mkv": _video("film.mkv"),
    "timestamps": Kind("times.csv", (("fuzzing.readers:read_times", "{case}"),)),
    "frames-record": Kind("frames.json", (("fuzzing.readers:read_record", "{case}"),)),
    "coach-watch": Kind(
        "image.png", (("fuzzing.readers:coach_folder", "{case}"), ("fuzzing.readers:coach_again", "{case}"))
    ),
    "many": Kind(
        "dataset.toml",
        (("validate", "{case}", "other/dataset.toml", "-o", "{out}/v", "-j", "1", "--no-pictures"),),
        judged=True,
    ),
    "kalibr-target": _board_file("target.yaml"),
    "kalibr-checkerboard": _board_file("checkerboard.yaml"),
    "boofcv-target": _board_file("boofcv.yaml"),
    "opencv-target": _board_file("settings.xml"),
    "caliscope-target": _board_file("charuco.toml"),
    "public-set": Kind("public.toml", (("rigkit.io.manifests.public_set:load_public_set", "{case}"),)),
    "opencv": _camera_file("opencv.yaml", ("export", "{case}", "--from", "opencv", "-o", "{out}/new.json")),
    "kalibr": _camera_file("kalibr.yaml", ("rigkit.workflows.inputs.camera_files:import_camera", "{case}")),
    "chain": Kind("chain.yaml", (("export", "{case}", "--to", "mrcal", "-o", "{out}/new.cameramodel"),)),
    "opencv-stereo": Kind("stereo.yaml", (("export", "{case}", "--to", "kalibr", "-o", "{out}/new.yaml"),)),
    "ros": _camera_file("ros.yaml", ("export", "{case}", "--from", "ros", "-o", "{out}/new.json")),
    "colmap": _camera_file("cameras.txt"),
    "colmap-rig": Kind("rig_config.json", (("export", "{case}", "--to", "kalibr", "-o", "{out}/new.yaml"),)),
    "mrcal": _camera_file("lens.cameramodel"),
    "mrcal-spline": _camera_file("spline.cameramodel"),
    "ocamcalib": _camera_file("calib_results.txt"),
    "py-ocamcalib": Kind("ocam.json", (("fuzzing.readers:read_py_ocam", "{case}"),)),
    "commands": Kind(None, COMMANDS, names_file=False, judged=True),
    "api": Kind(None, (), names_file=False),
    "requests": Kind(None, (), names_file=False),
}
"""Every class of input."""
