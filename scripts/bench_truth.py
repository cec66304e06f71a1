"""The table of truth: rigkit and its peers on real captures of which somebody measured something.

    python scripts/bench_truth.py [SET ...] [--data DIR] [--work DIR] [--model MODEL] [--json FILE] [--markdown FILE]

Every tool finds its own corners (but where corners are published) and runs with its own defaults: rigkit with one model
for all sets and the board's shape chosen by itself, OpenCV with cv2.findChessboardCornersSB, cv2.calibrateCamera or
cv2.fisheye.calibrate, COLMAP where it has a part in the task. No constant is changed for a set. Sigmas are those that a
tool states; where it states none, the error stands alone.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import combinations
from pathlib import Path
from typing import Any

import bench_truth_peers as peers
import cv2
import numpy as np
from benchmark_calibration_peers import Mrcal

from rigkit.affine.correspondences import Correspondences
from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.base import Camera
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.board_pose import board_poses
from rigkit.io.calibration_file import save_camera
from rigkit.io.correspondences import write_correspondences
from rigkit.io.images import read_image
from rigkit.io.public_set import PublicMeasurement
from rigkit.io.rig_session import RigSession
from rigkit.io.session import Session
from rigkit.workflows.calibrate import CalibrateOptions, SessionCalibration, calibrate_session
from rigkit.workflows.calibrate_rig import RigSessionCalibration, calibrate_rig_session
from rigkit.workflows.corners import Cache
from rigkit.workflows.reconstruct_scene import SceneOptions, reconstruct_views
from rigkit.workflows.truth import FetchedSet, fetch_public_set, public_sets
from rigkit.workflows.truth_marks import fit_similarity, lattice_affinities, mark_lattice
from rigkit.workflows.validate import ValidateOptions, validate_dataset

RIGKIT = "rigkit"
CALIPER_CORNERS = {"a": (0, 0), "b": (15, 0), "c": (0, 9), "d": (15, 9)}
CYLINDER_SEEN = {"201": (1325.0, 455.0), "202": (1000.0, 418.0)}
"""Where the topmost mark of column 7 is."""
CYLINDER_ROWS, CYLINDER_COLUMN, CYLINDER_FOOT_MM = 20, 7, 10.0
TRIHEDRAL_K = {"left": (1649.4, 1654.1, 793.3, 614.4), "right": (1631.7, 1625.7, 789.1, 634.8)}
"""The camera matrices that were published with the pair."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One quantity by one tool; `sigma` is what the tool states, `truth_sigma` what the measurement does."""

    set: str
    quantity: str
    unit: str
    tool: str
    value: float
    truth: float | None = None
    truth_sigma: float | None = None
    sigma: float | None = None
    how: str = ""

    @property
    def error(self) -> float | None:
        return None if self.truth is None else self.value - self.truth

    @property
    def in_sigmas(self) -> float | None:
        """The error in the sigmas stated by tool and measurement together; None where the tool states none."""
        if self.error is None or self.sigma is None:
            return None
        return abs(self.error) / float(np.hypot(self.sigma, self.truth_sigma or 0.0))


def against(row: PublicMeasurement, tool: str, value: float, sigma: float | None, name: str) -> Row:
    return Row(
        set=name, quantity=row.what, unit=row.unit, tool=tool, value=value, truth=row.value, truth_sigma=row.sigma,
        sigma=sigma, how=row.how,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, slots=True)
class Bench:
    """A capture on this machine, where results go, and rigkit's one model."""

    found: FetchedSet
    work: Path
    model: str
    most: int | None = None
    """Most images of boards a camera, spread evenly; None: all."""

    @property
    def name(self) -> str:
        return self.found.described.name

    @property
    def board(self) -> Board:
        return self.found.described.boards[0]

    def images(self, pattern: str) -> tuple[Path, ...]:
        """Return the images of boards, at most as many as asked for."""
        found = self.found.files(pattern)
        if self.most is None or len(found) <= self.most:
            return found
        return tuple(found[k] for k in np.linspace(0, len(found) - 1, self.most).astype(int))

    def session(self, pattern: str, camera: str | None = None) -> Session:
        path = self.work / f"{self.name}.toml"
        boards = self.found.described.boards
        return Session(
            path=path,
            images=self.images(pattern),
            boards=boards,
            model=self.model,
            degree=None,
            board_shape="auto",
            camera=camera,
        )

    def alone(self, pattern: str, camera: str | None = None) -> SessionCalibration:
        output = self.work / f"{self.name}-{camera or 'camera'}.json"
        options = CalibrateOptions(output=output, force=True, cache=Cache.UPDATE)
        return calibrate_session(self.session(pattern, camera), options)

    def rig(self, left: str, right: str) -> RigSessionCalibration:
        sessions = {"left": self.session(left, "left"), "right": self.session(right, "right")}
        rig = RigSession(self.work / f"{self.name}.toml", sessions, "number", ())
        return calibrate_rig_session(rig, CalibrateOptions(cache=Cache.UPDATE))

    def against(self, what: str, tool: str, value: float, sigma: float | None = None) -> Row:
        return against(self.found.described.measurement(what), tool, value, sigma, self.name)

    def row(self, quantity: str, tool: str, value: float, unit: str = "px", how: str = "") -> Row:
        return Row(set=self.name, quantity=quantity, unit=unit, tool=tool, value=value, how=how)


def caliper_rows(bench: Bench, tool: str, points: np.ndarray) -> Iterator[Row]:
    """Yield the six distances after one scale (the side of the squares is nominal), and how many lie within 2 sigmas
    of the calipers alone: none of the tools states how sure a board's released corners are."""
    columns = bench.board.columns
    at = {name: points[row * columns + column] for name, (column, row) in CALIPER_CORNERS.items()}
    pairs = list(combinations(sorted(at), 2))
    names = [a + b for a, b in pairs]
    lengths = np.array([np.linalg.norm(at[a] - at[b]) for a, b in pairs])
    measured = [bench.found.described.measurement(name) for name in names]
    truth = np.array([m.value for m in measured])
    lengths *= (truth @ lengths) / (lengths @ lengths)
    for name, length in zip(names, lengths.tolist(), strict=True):
        yield bench.against(name, tool, length)
    error = lengths - truth
    yield bench.row("six distances, rms error", tool, float(np.sqrt((error**2).mean())), "mm", "after one scale")
    inside = int((np.abs(error) <= 2.0 * np.array([m.sigma for m in measured], dtype=float)).sum())
    yield bench.row("distances within 2 sigmas of the calipers, of 6", tool, float(inside), "", "after one scale")


def caliper_board(bench: Bench) -> Iterator[Row]:
    found = bench.alone("*.png").calibration
    yield from caliper_rows(bench, f"{RIGKIT} ({found.boards[0].kind})", found.boards[0].points_mm)
    yield bench.row("held-out rms", RIGKIT, found.heldout_rms_px or np.nan)
    views, size_px = peers.opencv_views(bench.images("*.png"), bench.board)
    rms, points = peers.opencv_released(views, size_px)
    yield from caliper_rows(bench, "OpenCV (calibrateCameraRO)", points)
    yield bench.row("rms of the fit", "OpenCV (calibrateCameraRO)", rms)


def stereo_rows(bench: Bench, left: str, right: str, lengths: Sequence[str]) -> Iterator[Row]:
    rig = bench.rig(left, right).rig
    length, sigma = rig.baseline_mm("left", "right")
    for what in lengths:
        yield bench.against(what, RIGKIT, length, sigma)
    yield bench.row("held-out rms", RIGKIT, rig.heldout_rms_px or np.nan)
    views1, size_px = peers.opencv_views(bench.images(left), bench.board)
    views2, _ = peers.opencv_views(bench.images(right), bench.board)
    rms, _, pose = peers.opencv_stereo(views1, views2, size_px)
    for what in lengths:
        yield bench.against(what, "OpenCV (stereoCalibrate)", float(np.linalg.norm(pose.translation_mm)))
    yield bench.row("rms of the fit", "OpenCV (stereoCalibrate)", rms)


def bumblebee2(bench: Bench) -> Iterator[Row]:
    yield from stereo_rows(bench, "left*.jpg", "right*.jpg", ("baseline", "published baseline"))


def bouguet_stereo(bench: Bench) -> Iterator[Row]:
    yield from stereo_rows(bench, "left*.jpg", "right*.jpg", ("baseline",))


def simplestereo(bench: Bench) -> Iterator[Row]:
    """Yield the focal length by rigkit's brown model and OpenCV's, which call it the same: both cameras alone."""
    for side in "LR":
        session = bench.session(f"calib/*_{side}.png", side)
        camera = Session(
            path=session.path,
            images=session.images,
            boards=session.boards,
            model="brown",
            degree=None,
            board_shape="auto",
            camera=side,
        )
        found = calibrate_session(camera, CalibrateOptions(cache=Cache.UPDATE)).calibration
        sigma = float(found.parameter_sigmas[0])
        yield bench.against("focal length", f"{RIGKIT} (brown), {side}", float(found.camera.parameters[0]), sigma)
        views, size_px = peers.opencv_views(bench.images(f"calib/*_{side}.png"), bench.board)
        _, other = peers.opencv_camera(views, size_px, False)
        yield bench.against("focal length", f"OpenCV, {side}", float(other.parameters[0]))


def published_corners(path: Path, board: Board) -> BoardView:
    """Return the view of a file of published corners (*.orpc)."""
    lines = path.read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("encoding")) + 1
    table = np.array([[float(x) for x in line.split(",")] for line in lines[start:] if line.strip()])
    row, column = np.divmod(table[:, 1].astype(np.int64), board.columns)
    return BoardView(path.name, board, np.stack([column, row], -1), table[:, 3:5], np.full(len(table), 0.1))


def held_out(camera: Camera, views: Sequence[BoardView]) -> tuple[float, int]:
    """Return the 2-D RMS of views whose poses alone are fitted, flat board as stated, and how many corners count: a
    corner beyond the camera's field of view cannot be judged."""
    squares, count = 0.0, 0
    for view in views:
        rays, valid = camera.unproject(view.pixels)
        bases = np.linalg.pinv(camera.ray_jacobian(view.pixels[valid])).astype(np.float64)
        points = view.points()[valid]
        pose = board_poses(rays[valid], points, bases=bases)[0].cam_from_board
        pixels, seen = camera.project(pose.apply(points))
        squares += float(((pixels - view.pixels[valid])[seen] ** 2).sum())
        count += int(seen.sum())
    return float(np.sqrt(squares / count)), count


def ov_plane(bench: Bench) -> Iterator[Row]:
    """Yield the held-out RMS of the published split and the published corners: all tools get the same corners."""
    train, test = (
        [published_corners(path, bench.board) for path in bench.found.files(f"corners/{part}/*.orpc")]
        for part in ("train", "test")
    )
    height, width = read_image(bench.found.files("corners/test/*.png")[0]).shape[:2]
    total = sum(len(view.grid) for view in test)
    for tool, fitted in (
        (RIGKIT, lambda: calibrate(train, (width, height), model=bench.model, board="flat").camera),
        ("OpenCV (fisheye)", lambda: peers.opencv_camera(train, (width, height), True)[1]),
    ):
        try:
            rms, count = held_out(fitted(), test)
        except (RigkitError, cv2.error) as error:
            print(f"{bench.name}: {tool} fails: {str(error).splitlines()[-1]}")
            continue
        yield bench.row("rms on the published test images", tool, rms, how=f"{count} of {total} corners")


def one_camera(pattern: str, fisheye: bool, whole: str | None) -> Callable[[Bench], Iterator[Row]]:
    def rows(bench: Bench) -> Iterator[Row]:
        """Yield the held-out error of one camera, and the error of its fit beside a published one."""
        found = bench.alone(pattern).calibration
        yield bench.row("held-out rms", RIGKIT, found.heldout_rms_px or np.nan)
        published = None if whole is None else bench.found.described.measurement(whole)
        fits = {RIGKIT: found.rms_px}
        if not bench.board.identified:
            views, size_px = peers.opencv_views(bench.images(pattern), bench.board)
            try:
                fits[f"OpenCV ({len(views)} images)"] = peers.opencv_camera(views, size_px, fisheye)[0]
            except cv2.error as error:
                print(f"{bench.name}: OpenCV fails: {str(error).splitlines()[-1]}")
        for tool, rms in fits.items():
            yield bench.row("rms of the fit", tool, rms)
        if published is not None:
            yield bench.row("rms of the fit", "published", published.value, how=published.how)

    return rows


def cylinder_truth(bench: Bench, keys: Sequence[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Return where the marks at (column, row) were printed, and the normals there: rows count from the top."""
    radius, along, around = (
        bench.found.described.measurement(m).value for m in ("radius", "step along the axis", "step around")
    )
    column, row = np.array(keys).T
    angle = np.deg2rad(around) * (column + CYLINDER_COLUMN - 1)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=-1)
    height = CYLINDER_FOOT_MM + along * (CYLINDER_ROWS - 1 - row)
    return radius * normals + height[:, None] * np.array([0.0, 0.0, 1.0]), normals


def cylinder_rows(bench: Bench, tool: str, points: np.ndarray, truth: np.ndarray) -> Iterator[Row]:
    fitted = fit_similarity(points, truth).apply(points)
    rms = float(np.sqrt(((fitted - truth) ** 2).sum(axis=1).mean()))
    yield bench.row("marks, 3-D rms after a rigid fit and one scale", tool, rms, "mm", f"{len(points)} marks")
    # The axis is the design's: what is left of the radius is the shape of the cylinder.
    radius = bench.found.described.measurement("radius").value
    off = np.linalg.norm(fitted[:, :2], axis=1) - radius
    yield bench.row("marks off the cylinder, rms", tool, float(np.sqrt((off**2).mean())), "mm")


def cylinder(bench: Bench) -> Iterator[Row]:
    """Yield how the marks of the cylinder come out: cameras from their boards alone, the pose of the pair from the
    marks (no board was seen by both cameras at one moment), one scale from the design."""
    marks = []
    cameras = []
    for name, start in CYLINDER_SEEN.items():
        found = bench.alone(f"{name}/*.jpg", name).calibration
        of = f"{len(bench.images(f'{name}/*.jpg'))} of {len(bench.found.files(f'{name}/*.jpg'))} images of boards"
        yield bench.row(f"held-out rms, camera {name}", RIGKIT, found.heldout_rms_px or np.nan, how=of)
        image = read_image(bench.found.files(f"{name}.jpg")[0])
        marks.append(mark_lattice(image, np.array(start), CYLINDER_ROWS))
        views, size_px = peers.opencv_views(bench.images(f"{name}/*.jpg"), bench.board)
        cameras.append(peers.opencv_camera(views, size_px, False)[1])
    keys, pixels1, pixels2, A21 = lattice_affinities(marks[0], marks[1])
    path = bench.work / "cylinder-marks.npz"
    path.unlink(missing_ok=True)
    write_correspondences(path, Correspondences(pixels1, pixels2, A21=A21))
    first, second = (bench.work / f"{bench.name}-{name}.json" for name in CYLINDER_SEEN)
    scene = reconstruct_views(SceneOptions(camera=first, camera2=second, correspondences=path, pictures=False)).scene
    kept = [keys[k] for k in scene.kept]
    truth, normals = cylinder_truth(bench, kept)
    cloud = scene.reconstruction.cloud
    yield from cylinder_rows(bench, f"{RIGKIT} ({len(kept)} of {len(keys)})", cloud.points_mm, truth)
    fit = fit_similarity(cloud.points_mm, truth)
    cosine = np.clip((cloud.normals @ fit.rotation.T * normals).sum(axis=1), -1.0, 1.0)
    angles = np.rad2deg(np.arccos(cosine))
    yield bench.row("normals against the cylinder, mean", RIGKIT, float(angles.mean()), "deg")
    yield bench.row("normals against the cylinder, median", RIGKIT, float(np.median(angles)), "deg")
    stated = float(np.rad2deg(np.sqrt((cloud.normal_sigma_rad**2).mean())))
    yield bench.row("normals, stated rms angle", RIGKIT, stated, "deg", "observed rms " + _number(_rms(angles)))
    truth, _ = cylinder_truth(bench, keys)
    pair = (cameras[0], cameras[1])
    opencv = peers.opencv_pair((pixels1, pixels2), pair)
    yield from cylinder_rows(bench, "OpenCV (findEssentialMat)", opencv, truth)
    if importlib.util.find_spec("pycolmap") is not None:
        colmap = peers.colmap_pair((pixels1, pixels2), pair)
        yield from cylinder_rows(bench, "COLMAP (two views, cameras of OpenCV)", colmap, truth)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def trihedral_manifest(bench: Bench) -> str:
    """Return the manifest of the pair with its published cameras."""
    text = 'schema = "rigkit.dataset/1"\nname = "trihedral-stereo"\n'
    for board in bench.found.described.boards:
        text += f'[[boards]]\nid = "{board.board_id}"\ncolumns = {board.columns}\nrows = {board.rows}\n'
        text += f"square_mm = {board.square_x_mm}\n"
    for name in TRIHEDRAL_K:
        text += f'[[cameras]]\nid = "{name}"\ncalibration = "{name}.json"\n'
    text += '[[pairs]]\nid = "pair"\ncamera1 = "left"\ncamera2 = "right"\npose_type = "general"\n'
    for k, name in enumerate(TRIHEDRAL_K):
        text += f"image{k + 1} = {json.dumps(str(bench.found.files(f'{name}.jpg')[0].resolve()))}\n"
    text += 'boards = ["left", "floor", "right"]\nlayout = { left = "left", floor = "floor", right = "right" }\n'
    known = bench.found.described.measurement("baseline")
    truth = f'baseline = {{ value_mm = {known.value}, sigma_mm = 1.5, how = "{known.how}" }}\n'
    return text + "[pairs.truth]\n" + truth


def trihedral(bench: Bench) -> Iterator[Row]:
    """Yield baseline and angles of the pair through its published cameras, by rigkit's pipeline."""
    folder = bench.work / bench.name
    folder.mkdir(exist_ok=True)
    for name, values in TRIHEDRAL_K.items():
        (folder / f"{name}.json").unlink(missing_ok=True)
        save_camera(folder / f"{name}.json", Pinhole((1600, 1200), np.array(values)))
    (folder / "dataset.toml").write_text(trihedral_manifest(bench))
    done = validate_dataset(folder, ValidateOptions(pictures=False, crosscheck=False))
    report = done.reports[0].to_dict()
    yield bench.against("baseline", RIGKIT, report["baseline_mm"], report.get("baseline_sigma_mm"))
    for angle in report["angles"]:
        what = "angle " + "-".join(sorted((angle["a"], angle["b"]), key=["left", "right", "floor"].index))
        yield bench.against(what, RIGKIT, angle["angle_deg"], angle.get("sigma_deg"))


BENCHES: Mapping[str, Callable[[Bench], Iterator[Row]]] = {
    "caliper-board": caliper_board,
    "cylinder": cylinder,
    "bumblebee2": bumblebee2,
    "bouguet-stereo": bouguet_stereo,
    "trihedral-stereo": trihedral,
    "simplestereo": simplestereo,
    "ov-plane": ov_plane,
    "ocam-fisheye1": one_camera("*.jpg", True, "published rms"),
    "camodocal-fisheye": one_camera("*.png", True, "refitted rms"),
    "charuco-lifecam": one_camera("*.jpg", False, None),
    "charuco-stereo": one_camera("left*.png", False, None),
}


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}" if abs(value) < 10.0 else f"{value:.2f}"


def markdown(rows: Sequence[Row]) -> str:
    """Return the table."""
    head = ["set", "quantity", "unit", "tool", "value", "stated sigma", "measured", "error", "error / sigmas", "how"]
    lines = ["| " + " | ".join(head) + " |", "|" + ":--|" * len(head)]
    for row in rows:
        measured = _number(row.truth) + ("" if row.truth_sigma is None else f" ± {_number(row.truth_sigma)}")
        numbers = [_number(row.value), _number(row.sigma), measured, _number(row.error), _number(row.in_sigmas)]
        lines.append("| " + " | ".join([row.set, row.quantity, row.unit, row.tool, *numbers, row.how]) + " |")
    return "\n".join(lines) + "\n"


def as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    return [asdict(row) | {"error": row.error, "in_sigmas": row.in_sigmas} for row in rows]


def merged(path: Path, rows: Sequence[Row]) -> list[Row]:
    """Return the rows with those that a file has of other sets, in the order of the sets."""
    new = {row.set for row in rows}
    names = [field.name for field in fields(Row)]
    kept = (
        [Row(**{name: one[name] for name in names}) for one in json.loads(path.read_text())] if path.is_file() else []
    )
    return sorted([*rows, *(row for row in kept if row.set not in new)], key=lambda row: list(BENCHES).index(row.set))


def with_table(page: str, table: str) -> str:
    """Return the page with the table in place of the one between its marks."""
    begin, end = "<!-- table: begin -->\n", "<!-- table: end -->"
    return re.sub(re.escape(begin) + ".*?" + re.escape(end), lambda _: begin + table + end, page, flags=re.DOTALL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"of {', '.join(BENCHES)}; default all")
    parser.add_argument("--data", type=Path, default=None, help="folder of captures; default: RIGKIT_DATA or the cache")
    parser.add_argument("--work", type=Path, default=Path("/tmp/rigkit-bench-truth"), help="corners and calibrations")
    parser.add_argument("--model", default="scaramuzza", help="rigkit's, of all sets")
    parser.add_argument("--most", type=int, help="images of boards a camera, spread evenly; default: all")
    parser.add_argument("--json", type=Path, help="put the rows of these sets into this file; it keeps other sets'")
    parser.add_argument("--markdown", type=Path, help="write the table between the marks of this page")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    if not Mrcal.available():
        print("mrcal does not install here: left out")
    known, rows = public_sets(), list[Row]()
    for name in args.sets or BENCHES:
        found = fetch_public_set(known[name], args.data)
        if found.missing:
            print(f"{name}: {len(found.missing)} files are not here, such as '{found.missing[0]}': left out")
            continue
        own = list[Row]()
        try:
            for row in BENCHES[name](Bench(found, args.work, args.model, args.most)):
                own.append(row)
        except RigkitError as error:
            print(f"{name}: {error}")
        print(markdown(own), flush=True)
        rows += own
    if args.json:
        rows = merged(args.json, rows)
        args.json.write_text(json.dumps(as_json(rows), indent=1) + "\n")
    if args.markdown:
        args.markdown.write_text(with_table(args.markdown.read_text(), markdown(rows)))


if __name__ == "__main__":
    main()
