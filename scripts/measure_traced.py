"""Errors of rigkit on path-traced captures (RENDERED): `python scripts/measure_traced.py traced/*`.

The folders are those of `path_traced.py`. Each is calibrated like `rigkit calibrate images --board board.toml`. The
table has the errors of the corners used (2-D RMS), of the projection at those corners after the best rotation, with the
stated one, of a rig's baseline and rotation, of a board's shape, and the headline of the verdicts. A data set
(dataset.toml) is validated.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from traced.lenses import Lens

from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3
from rigkit.workflows.calibration.calibrate import SessionCalibration
from rigkit.workflows.calibration.calibrate_any import calibrate_sources
from rigkit.workflows.options.cameras import CalibrateOptions, FolderOptions
from rigkit.workflows.options.clouds import ValidateOptions
from rigkit.workflows.validation.validate import validate_dataset

NEAR_PX = 3.0
"""A detected corner this far from the nearest one of the board belongs to something else in the room."""
HEAD = ("set", "what", "found", "error", "stated sigma", "rigkit says")


@dataclass(frozen=True, eq=False, slots=True)
class Truth:
    """truth.json of a capture: lenses and mounts by camera, the board's points, rig_from_board by picture."""

    lenses: dict[str, Lens]
    mounts: dict[str, Rigid3]
    points_mm: FloatArray
    poses: dict[str, Rigid3]

    @classmethod
    def read(cls, path: Path) -> Truth:
        values = json.loads(path.read_text())
        cameras = values["cameras"]
        return cls(
            {name: Lens.from_truth(one["lens"]) for name, one in cameras.items()},
            {name: _motion(one["cam_from_rig"]) for name, one in cameras.items()},
            np.array(values["points_mm"]),
            {view["name"]: _motion(view["rig_from_board"]) for view in values["views"]},
        )


def _motion(values: dict[str, Any]) -> Rigid3:
    return Rigid3(values["rotation"], values["translation_mm"])


def corner_errors(found: Calibration, truth: Truth, camera: str) -> FloatArray:
    """Return used corners minus where they truly are (N, 2), those of the board only."""
    out = []
    for view in found.views:
        cam_from_board = truth.mounts[camera] @ truth.poses[Path(view.image).stem]
        true, _ = truth.lenses[camera].project(cam_from_board.apply(truth.points_mm))
        # A chessboard's corners may be numbered from the other end, or be part of the board only.
        pixels = view.pixels[view.kept]
        nearest = np.linalg.norm(pixels[:, None] - true, axis=-1).argmin(axis=1)
        errors = pixels - true[nearest]
        out.append(errors[np.linalg.norm(errors, axis=1) < NEAR_PX])
    return np.concatenate(out)


def projection_errors(found: Calibration, lens: Lens) -> tuple[FloatArray, FloatArray]:
    """Return how far the calibrated lens projects from the true one (N, 2) along the rays of the corners used, after
    the rotation that fits best, and the 2-D sigmas (N,) that the calibration states there."""
    pixels = np.concatenate([view.pixels[view.kept] for view in found.views])
    rays = lens.unproject(pixels)

    def off(rotation: FloatArray) -> FloatArray:
        there, _ = found.camera.project(rays @ exp_so3(rotation).T)
        return np.asarray(there - pixels)

    best = least_squares(lambda w: np.nan_to_num(off(w)).ravel(), np.zeros(3)).x
    covariance = FarProjection.of(found).covariance(rays @ exp_so3(best).T)
    return off(best), np.sqrt(np.trace(covariance, axis1=1, axis2=2))


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean((values**2).reshape(len(values), -1).sum(axis=1))))


def shape_error_mm(found: Calibration, truth: Truth) -> tuple[str, float]:
    """Return the kind of shape that was chosen, and how far its points lie from the true ones (3-D rms)."""
    shape = max(found.boards, key=lambda board: len(board.points_mm))
    own, true = (points - points.mean(axis=0) for points in (shape.points_mm, truth.points_mm))
    # The board may be numbered from its other end: turned by half about its normal.
    errors = []
    for candidate in (own, own[::-1]):
        u, _, vt = np.linalg.svd(candidate.T @ true)
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        errors.append(rms(candidate @ turn - true))
    return shape.kind, min(errors)


def camera_rows(name: str, found: Calibration, truth: Truth, camera: str) -> Iterator[tuple[str, ...]]:
    """Yield the lines of one camera."""
    message = str(found.verdicts[0]) if found.verdicts else ""
    corners = corner_errors(found, truth, camera)
    off, sigmas = projection_errors(found, truth.lenses[camera])
    worst = float(np.nanmax(np.linalg.norm(off, axis=1)))
    found_words = f"{found.camera.model}, {len({view.image for view in found.views})} of {len(truth.poses)} images"
    yield (
        name,
        f"{camera}: corners",
        str(len(corners)),
        f"{rms(corners):.4f} px",
        f"{1.414 * found.sigma_px:.4f} px",
        "",
    )
    yield (
        name,
        f"{camera}: lens",
        found_words,
        f"{rms(off):.4f} px (worst {worst:.3f})",
        f"{rms(sigmas):.4f} px",
        message,
    )
    kind, shape = shape_error_mm(found, truth)
    yield name, f"{camera}: board", kind, f"{shape:.4f} mm", "", ""


def rig_rows(name: str, rig: RigCalibration, truth: Truth) -> Iterator[tuple[str, ...]]:
    """Yield the lines of a rig's mount: its first two cameras."""
    first, second = (camera.name for camera in rig.cameras[:2])
    length, sigma = rig.baseline_mm(first, second)
    true = truth.mounts[second] @ truth.mounts[first].inverse()
    baseline = float(np.linalg.norm(true.translation_mm))
    yield name, "baseline", f"{length:.4f} mm", f"{length - baseline:+.4f} mm", f"{sigma:.4f} mm", str(rig.verdicts[0])
    between = rig.cam2_from_cam1(first, second).rotation @ true.rotation.T
    degrees = float(np.degrees(np.linalg.norm(log_so3(between))))
    mount = np.degrees(np.sqrt(np.trace(rig.covariance[rig.mount(1), rig.mount(1)][:3, :3])))
    yield name, "rotation", "", f"{degrees:.4f} deg", f"{mount:.4f} deg", ""


def measured(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield the lines of a capture: calibrated as a person would, or as it was."""
    truth = Truth.read(folder / "truth.json")
    cameras = list(truth.lenses)
    places = [folder / (camera if len(cameras) > 1 else "images") for camera in cameras]
    declared = FolderOptions(boards=(str(folder / "board.toml"),))
    done = calibrate_sources(
        places,
        declared,
        CalibrateOptions(output=(folder if len(cameras) > 1 else places[0]) / "calibration.json", force=True),
    )
    if isinstance(done, SessionCalibration):
        yield from camera_rows(folder.name, done.calibration, truth, cameras[0])
        return
    for camera in done.rig.cameras:
        yield from camera_rows(folder.name, camera.calibration, truth, camera.name)
    yield from rig_rows(folder.name, done.rig, truth)


def validated(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield the lines of a laboratory: the baseline, and the angle that is farthest off in its sigmas."""
    options = ValidateOptions(output=folder / "out", force=True, pictures=False, crosscheck=False)
    done = validate_dataset(folder, options)
    for pair in done.pairs:
        report, verdict = pair.best, "pass" if all(r.passed for r in pair.reports) else "FAIL"
        for check in report.checks:
            figures = f"{check.ours:.4f}", f"{check.difference:+.4f}", f"{check.our_sigma:.4f} {check.unit}"
            yield f"{folder.name} {report.pair_id}", check.name, *figures, verdict
    for failure in done.failures:
        yield folder.name, failure.pair_id, "", "", "", str(failure)


def table(rows: Sequence[tuple[str, ...]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in (HEAD, *rows)]
    return "\n".join([lines[0], "|" + " --- |" * len(HEAD), *lines[1:]])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    rows: list[tuple[str, ...]] = []
    for folder in parser.parse_args().folders:
        rows += validated(folder) if (folder / "dataset.toml").is_file() else measured(folder)
    print(table(rows))


if __name__ == "__main__":
    main()
