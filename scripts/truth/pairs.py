"""Stereo pairs and rigs of the table of truth: baselines, angles, a printed cylinder."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from rigkit.affine.correspondences import Correspondences
from rigkit.calibration.rig.result import RigCalibration
from rigkit.cameras.brown import Brown
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.calibrations.calibration_file import save_camera
from rigkit.io.corners.correspondences import correspondences_text
from rigkit.io.media.images import read_image
from rigkit.workflows.options.clouds import SceneOptions, ValidateOptions
from rigkit.workflows.reconstruction.reconstruct_scene import reconstruct_views
from rigkit.workflows.validation.validate import validate_dataset
from truth import peers
from truth.cameras import PEER_FAILURES, kept_views
from truth.colmap import colmap_pair, colmap_rig
from truth.marks import fit_similarity, lattice_affinities, mark_lattice
from truth.table import COLMAP, MRCAL, OPENCV, RIGKIT, Bench, Row

CYLINDER_SEEN = {"201": (1325.0, 455.0), "202": (1000.0, 418.0)}
"""Where the topmost mark of column 7 is."""
CYLINDER_ROWS, CYLINDER_COLUMN, CYLINDER_FOOT_MM = 20, 7, 10.0
TRIHEDRAL_K = {"left": (1649.4, 1654.1, 793.3, 614.4), "right": (1631.7, 1625.7, 789.1, 634.8)}
"""The camera matrices that were published with the pair."""
SAME_SQUARES = "published"
"""Measurements called so came from the same images with the same squares: the board's scale is common to both."""


def frames_of(bench: Bench, rig: RigCalibration) -> list[dict[int, BoardView]]:
    """Return what each moment shows, {camera: corners that rigkit kept in the rig}, matched by the images' numbers."""
    frames: dict[str, dict[int, BoardView]] = {}
    for k, camera in enumerate(rig.cameras):
        for view in kept_views(camera.calibration, bench.found.described.boards):
            frames.setdefault(_number(view.image), {})[k] = view
    return [frames[name] for name in sorted(frames) if len(frames[name]) > 1]


def _number(name: str) -> str:
    return "".join(c for c in name.rsplit(".", 1)[0].rsplit("_", 1)[-1] if c.isdigit())


def stereo(left: str, right: str, lengths: Sequence[str]) -> Callable[[Bench], Iterator[Row]]:
    def rows(bench: Bench) -> Iterator[Row]:
        rig = bench.rig({"left": left, "right": right}).rig
        yield from rig_rows(bench, rig, dict.fromkeys(lengths, ("left", "right")))
        # Those who published a fit took the board to be flat and as stated.
        flat = bench.rig({"left": left, "right": right}, "flat").rig
        for what in lengths:
            length, sigma = flat.baseline_mm("left", "right")
            if SAME_SQUARES in what:
                sigma = own_sigma(flat, length, sigma)
            yield bench.against(what, RIGKIT, length, sigma, variant="board flat")
        if bench.board.identified:
            return
        size_px = rig.cameras[0].camera.size_px
        views = [peers.opencv_views(bench.images(pattern), bench.board) for pattern in (left, right)]
        own = {_number(view.image): view for view in views[1]}
        pairs = [(view, own[_number(view.image)]) for view in views[0] if _number(view.image) in own]
        length = float(np.linalg.norm(peers.opencv_stereo(pairs, size_px)[1].translation_mm))
        for what in lengths:
            yield bench.against(what, OPENCV, length, variant="its own corners")

    return rows


def rig_rows(bench: Bench, rig: RigCalibration, lengths: Mapping[str, tuple[str, str]]) -> Iterator[Row]:
    """Yield distances between cameras by each tool, from the corners that rigkit kept. A length is held against another
    one of the same squares with no part of the board's scale in its sigma."""
    for what, names in lengths.items():
        length, sigma = rig.baseline_mm(*names)
        alone = own_sigma(rig, length, sigma)
        same = SAME_SQUARES in what or rig.scale_sigma == 0.0
        how = bench.measured(what).how
        if not same:
            how += f"; ± {alone:.3f} without the scale of the board, whose squares are nominal"
        yield bench.against(what, RIGKIT, length, alone if same else sigma, how=how)
    yield bench.row("held-out rms", RIGKIT, rig.heldout_rms_px, how=_models(rig))
    frames, size_px = frames_of(bench, rig), rig.cameras[0].camera.size_px
    index = {camera.name: k for k, camera in enumerate(rig.cameras)}
    for tool, mounts in peer_mounts(bench, frames, size_px, len(index)):
        for what, names in lengths.items():
            first, second = (mounts[index[name]] for name in names)
            length = float(np.linalg.norm((second @ first.inverse()).translation_mm))
            yield bench.against(what, tool, length)


def own_sigma(rig: RigCalibration, length: float, sigma: float) -> float:
    """Return the sigma of a length without the board's scale."""
    return float(np.sqrt(max(sigma**2 - (length * rig.scale_sigma) ** 2, 0.0)))


def _models(rig: RigCalibration) -> str:
    return ", ".join(f"{c.name}: {c.camera.model}, board {c.calibration.boards[0].kind}" for c in rig.cameras)


def peer_mounts(
    bench: Bench, frames: Sequence[Mapping[int, BoardView]], size_px: tuple[int, int], cameras: int
) -> Iterator[tuple[str, dict[int, Rigid3]]]:
    """Yield (tool, {camera: cam_from_first}) of the peers."""

    def opencv() -> dict[int, Rigid3]:
        out = {0: Rigid3.identity()}
        for k in range(1, cameras):
            both = [(frame[0], frame[k]) for frame in frames if 0 in frame and k in frame]
            out[k] = peers.opencv_stereo(both, size_px)[1]
        return out

    def mrcal() -> dict[int, Rigid3]:
        return dict(enumerate([Rigid3.identity(), *peers.mrcal_rig(frames, size_px)[1]]))

    def colmap() -> dict[int, Rigid3]:
        return dict(enumerate([Rigid3.identity(), *colmap_rig(frames, size_px)]))

    tools = {OPENCV: opencv, COLMAP: colmap} | ({MRCAL: mrcal} if peers.mrcal_there() else {})
    for tool, mounts in tools.items():
        try:
            yield tool, mounts()
        except PEER_FAILURES as error:
            print(f"{bench.name}: {tool}: {str(error).splitlines()[-1]}")


def cylinder_truth(bench: Bench, keys: Sequence[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Return where the marks at (column, row) were printed, and the normals there: rows count from the top."""
    radius, along, around = (bench.measured(m).value for m in ("radius", "step along the axis", "step around"))
    column, row = np.array(keys).T
    angle = np.deg2rad(around) * (column + CYLINDER_COLUMN - 1)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=-1)
    height = CYLINDER_FOOT_MM + along * (CYLINDER_ROWS - 1 - row)
    return radius * normals + height[:, None] * np.array([0.0, 0.0, 1.0]), normals


def cylinder_rows(bench: Bench, tool: str, points: np.ndarray, truth: np.ndarray) -> Iterator[Row]:
    fitted = fit_similarity(points, truth).apply(points)
    rms = float(np.sqrt(((fitted - truth) ** 2).sum(axis=1).mean()))
    how = f"{len(points)} marks"
    yield bench.row("marks, 3-D rms after a rigid fit and one scale", tool, rms, "mm", how=how)
    # The axis is the design's: what is left of the radius is the shape of the cylinder.
    off = np.linalg.norm(fitted[:, :2], axis=1) - bench.measured("radius").value
    yield bench.row("marks off the cylinder, rms", tool, float(np.sqrt((off**2).mean())), "mm")


def cylinder(bench: Bench) -> Iterator[Row]:
    """Yield how the marks of the cylinder come out: cameras from their boards alone, the pose of the pair from the
    marks (no board was seen by both cameras at one moment), one scale from the design."""
    marks, cameras = [], []
    for name, start in CYLINDER_SEEN.items():
        found = bench.alone(f"{name}/*.jpg", name).calibration
        of = f"{len(bench.images(f'{name}/*.jpg'))} of {len(bench.found.files(f'{name}/*.jpg'))} images of boards"
        yield bench.row(f"held-out rms, camera {name}", RIGKIT, found.heldout_rms_px, how=f"{found.camera.model}; {of}")
        image = read_image(bench.found.files(f"{name}.jpg")[0])
        marks.append(mark_lattice(image, np.array(start), CYLINDER_ROWS))
        views = kept_views(found, bench.found.described.boards)
        cameras.append(peers.opencv_fit(views, found.camera.size_px, False).camera)
    keys, pixels1, pixels2, A21 = lattice_affinities(marks[0], marks[1])
    path = bench.work / "cylinder-marks.npz"
    path.write_text(correspondences_text(Correspondences(pixels1, pixels2, A21=A21)))
    first, second = (bench.work / f"{bench.name}-{name}.json" for name in CYLINDER_SEEN)
    scene = reconstruct_views(SceneOptions(camera=first, camera2=second, correspondences=path, pictures=False)).scene
    kept = [keys[k] for k in scene.kept]
    truth, normals = cylinder_truth(bench, kept)
    cloud = scene.reconstruction.cloud
    yield from cylinder_rows(bench, RIGKIT, cloud.points_mm, truth)
    fit = fit_similarity(cloud.points_mm, truth)
    cosine = np.clip((cloud.normals @ fit.rotation.T * normals).sum(axis=1), -1.0, 1.0)
    angles = np.rad2deg(np.arccos(cosine))
    stated = float(np.rad2deg(np.sqrt((cloud.normal_sigma_rad**2).mean())))
    rms = float(np.sqrt((angles**2).mean()))
    yield bench.row("normals against the cylinder, mean", RIGKIT, float(angles.mean()), "deg")
    yield bench.row("normals, rms; ± as stated", RIGKIT, rms, "deg", how=f"largest {angles.max():.2f}", sigma=stated)
    truth, _ = cylinder_truth(bench, keys)
    pair = (cameras[0], cameras[1])
    yield from cylinder_rows(bench, OPENCV, peers.opencv_pair((pixels1, pixels2), pair), truth)
    flat = [peers.flattened(p, camera) for p, camera in zip((pixels1, pixels2), pair, strict=True)]
    yield from cylinder_rows(bench, COLMAP, peers.triangulated(flat, colmap_pair((pixels1, pixels2), pair)), truth)


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
    known = bench.measured("baseline")
    truth = f'baseline = {{ value_mm = {known.value}, sigma_mm = 1.5, how = "{known.how}" }}\n'
    return text + "[pairs.truth]\n" + truth


def trihedral(bench: Bench) -> Iterator[Row]:
    """Yield baseline and angles of the pair through its published cameras; peers get rigkit's matched corners."""
    folder = bench.work / bench.name
    folder.mkdir(exist_ok=True)
    for name, values in TRIHEDRAL_K.items():
        (folder / f"{name}.json").unlink(missing_ok=True)
        save_camera(folder / f"{name}.json", Pinhole((1600, 1200), np.array(values)))
    (folder / "dataset.toml").write_text(trihedral_manifest(bench))
    done = validate_dataset(
        folder, ValidateOptions(pictures=False, crosscheck=False, output=folder / "out", force=True)
    )
    report = done.reports[0].to_dict()
    yield bench.against("baseline", RIGKIT, report["baseline_mm"], report.get("baseline_sigma_mm"))
    for angle in report["angles"]:
        yield bench.against(_faces(angle["a"], angle["b"]), RIGKIT, angle["angle_deg"], angle.get("sigma_deg"))
    yield from trihedral_peers(bench, folder)


def _faces(a: str, b: str) -> str:
    return "angle " + "-".join(sorted((a, b), key=["left", "right", "floor"].index))


def trihedral_peers(bench: Bench, folder: object) -> Iterator[Row]:
    from rigkit.io.manifests.manifest import load_dataset
    from rigkit.workflows.reconstruction.datasets import load_cameras
    from rigkit.workflows.reconstruction.pairs import match_images

    dataset = load_dataset(f"{folder}/dataset.toml")
    pair, known = dataset.pairs[0], load_cameras(dataset).known
    matched, _, _ = match_images(pair, known["left"].camera, known["right"].camera, "raw")
    seen = matched.captured
    cameras = tuple(Brown((1600, 1200), np.array([*k, 0.0, 0.0, 0.0, 0.0, 0.0])) for k in TRIHEDRAL_K.values())
    pixels = (np.array(seen.pixels1), np.array(seen.pixels2))
    flat = [peers.flattened(p, camera) for p, camera in zip(pixels, cameras, strict=True)]
    clouds = {
        OPENCV: peers.opencv_pair(pixels, (cameras[0], cameras[1])),
        COLMAP: peers.triangulated(flat, colmap_pair(pixels, (cameras[0], cameras[1]))),
    }
    for tool, points in clouds.items():
        sizes, normals = [], {}
        for k, board in enumerate(matched.boards):
            own, grid = points[seen.board_index == k], seen.grid[seen.board_index == k]
            offsets = own - own.mean(axis=0)
            normal = np.linalg.svd(offsets)[2][2]
            normals[board.board_id] = normal * np.sign(normal @ own.mean(axis=0))
            for i, j in combinations(range(len(own)), 2):
                if np.abs(grid[i] - grid[j]).sum() == 1:
                    sizes.append(np.linalg.norm(own[i] - own[j]))
        yield bench.against("baseline", tool, float(bench.board.square_x_mm / np.median(sizes)))
        for a, b in combinations(normals, 2):
            cosine = float(np.clip(normals[a] @ normals[b], -1.0, 1.0))
            yield bench.against(_faces(a, b), tool, 180.0 - float(np.degrees(np.arccos(cosine))))


def multicam(bench: Bench) -> Iterator[Row]:
    """Yield the distances between four webcams, whose frames are up to 25 ms apart while the board moves."""
    names = [f"cam_{k}" for k in range(4)]
    rig = bench.rig({name: f"{name}.mp4" for name in names}).rig
    lengths = {f"published baseline {a}-{b}": (names[a], names[b]) for a, b in combinations(range(4), 2)}
    yield from rig_rows(bench, rig, lengths)
