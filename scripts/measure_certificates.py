"""Do certificates hold? Rigs and cameras calibrated from noisy corners, and what they then measure.

Each trial is a pair of cameras on one mount (or one camera), calibrated from a few images of a board with noisy corners
as a user's would be, certified, and used: lengths, depths, planes and angles at places all over the image, of known
size, from corners with new noise. Of the errors 95 % should lie within the certificate's 95 % bounds.

    python scripts/measure_certificates.py [--trials 100] [--frames 12] [--lens brown | kannala_brandt]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers.measuring import read_off

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.displaced import uncertain_camera
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.geometry.triangulation import triangulate_rays
from rigkit.synthetic.placing import place_board
from rigkit.validation.certificate.certify import certify
from rigkit.validation.certificate.contracts import Instrument, Quantity, Task, instrument_of_rig
from rigkit.validation.certificate.propagation import measured_points

SIZE_PX = (1280, 960)
BOARD = Board("board", 9, 6, 40.0, 40.0)
NOISE_PX = 0.1
MOUNT = Rigid3(exp_so3(np.array([0.02, -0.15, 0.01])), [-250.0, 4.0, 20.0])
LENSES = {
    "brown": Brown(SIZE_PX, np.array([1000.0, 1002.0, 645.0, 474.0, -0.2, 0.06, 3e-4, -2e-4, 0.0])),
    "kannala_brandt": KannalaBrandt(SIZE_PX, np.array([520.0, 521.0, 645.0, 474.0, -0.02, 0.004, 0.0, 0.0])),
}
TASKS = {
    Quantity.LENGTH: Task(quantity=Quantity.LENGTH, size_mm=150.0, distance_mm=1500.0),
    Quantity.DEPTH: Task(quantity=Quantity.DEPTH, size_mm=150.0, distance_mm=1500.0),
    Quantity.PLANE: Task(quantity=Quantity.PLANE, size_mm=150.0, distance_mm=1500.0),
    Quantity.ANGLE: Task(quantity=Quantity.ANGLE, size_mm=150.0, distance_mm=1500.0),
}
ALONE = Task(quantity=Quantity.LENGTH, size_mm=150.0, distance_mm=1500.0, distance_sigma_mm=0.2)
CELLS = (9, 7)
PLACED_TRIES = 5000


def seen_by(camera: Camera, pose: Rigid3, frame: str, rng: np.random.Generator) -> BoardView | None:
    """Return the noisy view of a board at cam_from_board, None where not all of it is seen."""
    pixels, valid = camera.project(pose.apply(BOARD.points()))
    noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
    if not (valid.all() and camera.on_image(noisy).all()):
        return None
    return BoardView(frame, BOARD, BOARD.grid(), noisy, np.full(len(noisy), NOISE_PX))


def frames_of(
    cameras: Sequence[Camera], poses: Sequence[Rigid3], count: int, rng: np.random.Generator
) -> list[list[BoardView]]:
    """Return what each camera sees of `count` placings of the board that all of them see whole."""
    out: list[list[BoardView]] = [[] for _ in cameras]
    width, height = SIZE_PX
    for _ in range(PLACED_TRIES):
        spot = np.array([rng.uniform(0.1, 0.9) * width, rng.uniform(0.1, 0.9) * height])
        placed = place_board(BOARD, cameras[0], spot, rng.uniform(0.04, 0.09) * height, 45.0, rng)
        if placed is None:
            continue
        name = f"{len(out[0]):03d}.png"
        both = [seen_by(c, p @ placed.world_from_board, name, rng) for c, p in zip(cameras, poses, strict=True)]
        if all(view is not None for view in both):
            for own, view in zip(out, both, strict=True):
                own += [view] if view is not None else []
        if len(out[0]) == count:
            return out
    raise DegenerateError("certificates: no board was placed where all cameras see it")


def lengths_off(quantity: Quantity, points: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the errors (N, ways) of what points (N, K, 3) measure, by the definition of the quantity."""
    return np.abs(read_off(quantity, points) - read_off(quantity, exact))


def rig_trial(lens: Camera, frames: int, rng: np.random.Generator) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (quantity, share of errors within the bound for each way to hold the thing) of a rig."""
    poses = (Rigid3.identity(), MOUNT)
    views = dict(zip(("left", "right"), frames_of((lens, lens), poses, frames, rng), strict=True))
    sizes = dict.fromkeys(views, SIZE_PX)
    named = {name: [(view.image, view) for view in own] for name, own in views.items()}
    rig = calibrate_rig(named, sizes, model=lens.model, degree=5 if lens.model == "brown" else None, folds=0)
    names = ("left", "right")
    lenses, covariance = rig.with_departures()
    found = instrument_of_rig(
        names,
        lenses,
        [c.cam_from_rig for c in rig.cameras],
        covariance,
        names,
        sigma_px=rig.sigma_px,
        scale_sigma=rig.scale_sigma,
        freedom=rig.freedom,
    )
    for quantity, task in TASKS.items():
        certificate = certify(found, task, cells=CELLS)
        use = certificate.in_view & ~certificate.coarse
        rays, _ = lens.unproject(certificate.pixels[use])
        exact, _ = measured_points(rays, task, True)
        seen = [lens.project(pose.apply(exact)) for pose in poses]
        noisy = [pixels + rng.normal(0.0, NOISE_PX, pixels.shape) for pixels, _ in seen]
        sights = [c.unproject(q)[0] for c, q in zip(found.cameras, noisy, strict=True)]
        slopes = [c.ray_jacobian(q) for c, q in zip(found.cameras, noisy, strict=True)]
        pose = found.cam_from_rig[1] @ found.cam_from_rig[0].inverse()
        points, valid = triangulate_rays(sights[0], sights[1], pose, jacobians1=slopes[0], jacobians2=slopes[1])
        good = (valid & seen[0][1] & seen[1][1]).all(axis=-1)
        off = lengths_off(quantity, points[good], exact[good])
        yield str(quantity), (off <= certificate.bound[use][good][:, None]).mean(axis=0)


def alone_trial(lens: Camera, frames: int, rng: np.random.Generator) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the same of one camera that measures a length at a known distance."""
    (views,) = frames_of((lens,), (Rigid3.identity(),), frames, rng)
    found = calibrate(
        views, SIZE_PX, model=lens.model, degree=5 if lens.model == "brown" else None, folds=0, board="flat"
    )
    uncertain = uncertain_camera(found)
    known = Instrument(
        names=("camera",),
        cameras=(uncertain.camera,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=uncertain.covariance,
        sigma_px=found.sigma_px,
        freedom=found.freedom,
    )
    certificate = certify(known, ALONE, cells=CELLS)
    use = certificate.in_view & ~certificate.coarse
    rays, _ = lens.unproject(certificate.pixels[use])
    exact, _ = measured_points(rays, ALONE, False)
    pixels, seen = lens.project(exact)
    sights, valid = found.camera.unproject(pixels + rng.normal(0.0, NOISE_PX, pixels.shape))
    cosine = np.sum(sights[:, 0::2] * sights[:, 1::2], axis=-1)
    distance = ALONE.distance_mm + ALONE.distance_sigma_mm * rng.normal()
    off = np.abs(2.0 * distance * np.tan(0.5 * np.arccos(cosine)) - ALONE.size_mm)
    good = (seen & valid).all(axis=-1)
    yield "length, one camera", (off[good] <= certificate.bound[use][good][:, None]).mean(axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--lens", choices=tuple(LENSES), action="append")
    args = parser.parse_args()
    print("| lens | quantity | trials | errors within the 95 % bound |\n|:--|:--|--:|--:|")
    for name in args.lens or LENSES:
        shares: dict[str, list[np.ndarray]] = {}
        for trial in range(args.trials):
            rng = np.random.default_rng([trial, len(name)])
            for run in (rig_trial, alone_trial):
                for quantity, share in run(LENSES[name], args.frames, rng):
                    shares.setdefault(quantity, []).append(share)
        for quantity, found in shares.items():
            print(f"| {name} | {quantity} | {len(found)} | {100 * np.mean(found, axis=0).min():.1f} % |", flush=True)


if __name__ == "__main__":
    main()
