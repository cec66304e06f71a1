"""Test certificates: measure with SIMULATED rigs and cameras that were calibrated from noisy corners.

Each trial is a rig of two cameras (or one camera), calibrated from a few images of a board with noisy corners, and
certified. Then lengths, depths, planes and angles of known size are measured all over the image from corners with new
noise. 95 % of the errors should be within the certificate's 95 % bounds.

With --departs PX the lenses deviate from every model: random displacements of their images (powers of the radius,
decentring, thin prisms, shear) of PX pixels at the corners; with --half boards are only in the left half of the image.
With --strange the lenses are of six kinds that no model fits, decentred, and the model is "auto" (ten times slower).
With --held the certified rig is a second one: its lenses are held at those of the first, from the same or other images.
Errors are listed separately for places where all cameras had boards. The standard error of a share is computed over
sessions, because errors of one calibration are correlated all over the image.

    python scripts/measure_certificates.py [--trials 100] [--frames 12] [--lens brown | kannala_brandt]
        [--departs 0] [--strange] [--half] [--noise 0.1] [--held same | other]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from certificates.lenses import CURVES, strange_lens

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers.measuring import read_off

from rigkit.calibration.calibrate import FOLDS, calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.displaced import DisplacedCamera
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.known import KnownCameras
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.core.measurement_task import Quantity, Task
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.geometry.triangulation import triangulate_rays
from rigkit.kernels.departures import DISPLACEMENTS
from rigkit.synthetic.scene import place_board
from rigkit.validation.certificate.certify import certify
from rigkit.validation.certificate.propagation import gradients, measured_points, variances
from rigkit.validation.certificate.result import instrument_of
from rigkit.validation.monitoring.evidence import Monitored
from rigkit.validation.monitoring.watch import monitored_camera, monitored_rig

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
HALF = 0.6
"""Of the image's width: boards that stay left of it."""
PLACED_TRIES = 20000
STRANGE, DECENTRED_PX = "strange", 0.3
"""Name of the lenses that no model is, and by how much they are decentred, px at the corners of the image."""


@dataclass(frozen=True, slots=True)
class Session:
    """How a rig is calibrated: the model asked for, how many frames, the corners' noise, which part of the image, from
    the left, has boards, and from which images its mounts are solved for with held lenses, if they are."""

    model: str
    frames: int
    noise_px: float
    reach: float
    held: str | None = None

    @property
    def degree(self) -> int | None:
        return 5 if self.model == "brown" else None

    @property
    def folds(self) -> int:
        return FOLDS if self.model == "auto" else 0


def with_model_inadequacy(lens: Camera, sigma_px: float, rng: np.random.Generator) -> Camera:
    """Return a lens that departs from its model."""
    amounts = np.append(lens.parameters, sigma_px * rng.normal(size=DISPLACEMENTS))
    return DisplacedCamera(SIZE_PX, amounts, lens, np.eye(DISPLACEMENTS))


def seen_by(camera: Camera, pose: Rigid3, frame: str, session: Session, rng: np.random.Generator) -> BoardView | None:
    """Return the noisy view of a board at cam_from_board, None where not all of it is seen in the session's part of the
    image."""
    pixels, valid = camera.project(pose.apply(BOARD.points()))
    noisy = pixels + rng.normal(0.0, session.noise_px, pixels.shape)
    if not (valid.all() and camera.on_image(noisy).all() and (noisy[:, 0] < session.reach * SIZE_PX[0]).all()):
        return None
    return BoardView(frame, BOARD, BOARD.grid(), noisy, np.full(len(noisy), session.noise_px))


def frames_of(
    cameras: Sequence[Camera], poses: Sequence[Rigid3], session: Session, rng: np.random.Generator
) -> list[list[BoardView]]:
    """Return what each camera sees of placings of the board that all of them see whole."""
    out: list[list[BoardView]] = [[] for _ in cameras]
    width, height = SIZE_PX
    for _ in range(PLACED_TRIES):
        spot = np.array([rng.uniform(0.1, 0.9) * width, rng.uniform(0.1, 0.9) * height])
        placed = place_board(BOARD, cameras[0], spot, rng.uniform(0.04, 0.09) * height, 45.0, rng)
        if placed is None:
            continue
        name = f"{len(out[0]):03d}.png"
        placings = [p @ placed.world_from_board for p in poses]
        both = [seen_by(c, p, name, session, rng) for c, p in zip(cameras, placings, strict=True)]
        if all(view is not None for view in both):
            for own, view in zip(out, both, strict=True):
                own += [view] if view is not None else []
        if len(out[0]) == session.frames:
            return out
    raise DegenerateError("certificates: no board was placed where all cameras see it")


def of_worst_way(found: Monitored, task: Task, points: np.ndarray, weights: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return of errors of each way to hold the thing (N, ways) those (N,) of the way that the bound is of: that with
    the largest variance. The one that errs most often, looked for afterwards, would err by chance as well."""
    by_place = gradients(found.cameras, found.cam_from_rig, points, weights)
    variance = sum(variances(found, task, points, by_place).values())
    return np.asarray(np.abs(off)[np.arange(len(off)), np.argmax(variance, axis=1)])


def by_place(within: np.ndarray, covered: np.ndarray, what: str) -> Iterator[tuple[str, float]]:
    """Yield the share of errors within the bound (N,), where boards were and elsewhere."""
    for place, own in (("where boards were", covered), ("elsewhere", ~covered)):
        if own.any():
            yield f"{what}, {place}", float(within[own].mean())


def calibrated(lenses: Sequence[Camera], session: Session, rng: np.random.Generator) -> RigCalibration:
    """Return the calibration of a rig, with held lenses if the session says so."""

    def shown() -> dict[str, list[tuple[str, BoardView]]]:
        views = frames_of(lenses, (Rigid3.identity(), MOUNT), session, rng)
        return {name: [(v.image, v) for v in own] for name, own in zip(("left", "right"), views, strict=True)}

    first, sizes = shown(), dict.fromkeys(("left", "right"), SIZE_PX)
    rig = calibrate_rig(first, sizes, model=session.model, degree=session.degree, folds=session.folds)
    if session.held is None:
        return rig
    known = KnownCameras.of({c.name: (c.camera, None) for c in rig.cameras}, [(rig.mounted, tuple(sizes))])
    return calibrate_rig(shown() if session.held == "other" else first, sizes, known=known, folds=session.folds)


def rig_trial(lenses: Sequence[Camera], session: Session, rng: np.random.Generator) -> Iterator[tuple[str, float]]:
    """Yield (quantity and place, share of errors within the bound) of a rig."""
    poses = (Rigid3.identity(), MOUNT)
    rig = calibrated(lenses, session, rng)
    length, sigma = rig.baseline_mm("left", "right")
    off_mm = length - float(np.linalg.norm(MOUNT.translation_mm))
    yield "baseline, two sigmas", float(abs(off_mm) <= 2.0 * sigma)
    yield "baseline, one sigma", float(abs(off_mm) <= sigma)
    found = instrument_of(monitored_rig(rig.mounted))
    for quantity, task in TASKS.items():
        certificate = certify(found, task, cells=CELLS)
        use = certificate.in_view & ~certificate.coarse
        rays, _ = lenses[0].unproject(certificate.pixels[use])
        exact, weights = measured_points(rays, task, True)
        seen = [lens.project(pose.apply(exact)) for lens, pose in zip(lenses, poses, strict=True)]
        noisy = [pixels + rng.normal(0.0, session.noise_px, pixels.shape) for pixels, _ in seen]
        sights = [c.unproject(q)[0] for c, q in zip(found.cameras, noisy, strict=True)]
        slopes = [c.ray_jacobian(q) for c, q in zip(found.cameras, noisy, strict=True)]
        pose = found.cam_from_rig[1] @ found.cam_from_rig[0].inverse()
        points, valid = triangulate_rays(sights[0], sights[1], pose, jacobians1=slopes[0], jacobians2=slopes[1])
        good = (valid & seen[0][1] & seen[1][1]).all(axis=-1)
        if not good.any():
            continue  # Nothing is certified where the rig says that it is too unsure.
        exact, weights = exact[good], weights[good]
        off = read_off(quantity, points[good]) - read_off(quantity, exact)
        covered = [
            covered_by_boards(c.calibration, pixels[good].mean(axis=1))
            for c, (pixels, _) in zip(rig.cameras, seen, strict=True)
        ]
        within = of_worst_way(found, task, exact, weights, off) <= certificate.bound[use][good]
        yield from by_place(within, np.logical_and.reduce(covered), str(quantity))


def alone_trial(lenses: Sequence[Camera], session: Session, rng: np.random.Generator) -> Iterator[tuple[str, float]]:
    """Yield the same of one camera that measures a length at a known distance."""
    lens = lenses[0]
    (views,) = frames_of((lens,), (Rigid3.identity(),), session, rng)
    found = calibrate(views, SIZE_PX, model=session.model, degree=session.degree, folds=session.folds, board="flat")
    alone = instrument_of(monitored_camera(found, "camera"))
    certificate = certify(alone, ALONE, cells=CELLS)
    use = certificate.in_view & ~certificate.coarse
    rays, _ = lens.unproject(certificate.pixels[use])
    exact, weights = measured_points(rays, ALONE, False)
    pixels, seen = lens.project(exact)
    sights, valid = found.camera.unproject(pixels + rng.normal(0.0, session.noise_px, pixels.shape))
    cosine = np.sum(sights[:, 0::2] * sights[:, 1::2], axis=-1)
    distance = ALONE.distance_mm + ALONE.distance_sigma_mm * rng.normal()
    off = 2.0 * distance * np.tan(0.5 * np.arccos(cosine)) - ALONE.size_mm
    good = (seen & valid).all(axis=-1)
    within = of_worst_way(alone, ALONE, exact[good], weights[good], off[good]) <= certificate.bound[use][good]
    yield from by_place(within, covered_by_boards(found, pixels[good].mean(axis=1)), "length, one camera")


def lenses_of(name: str, trial: int, departs_px: float, rng: np.random.Generator) -> list[Camera]:
    """Return the lenses of a rig's two cameras."""
    if name == STRANGE:
        kind = list(CURVES)[trial % len(CURVES)]
        return [strange_lens(kind, SIZE_PX, DECENTRED_PX, rng) for _ in range(2)]
    return [with_model_inadequacy(LENSES[name], departs_px, rng) if departs_px else LENSES[name] for _ in range(2)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--lens", choices=tuple(LENSES), action="append")
    parser.add_argument("--departs", type=float, default=0.0, help="px at the corners of the image")
    parser.add_argument("--strange", action="store_true", help="lenses that no model is")
    parser.add_argument("--half", action="store_true", help="boards in the left of the image alone")
    parser.add_argument("--noise", type=float, default=NOISE_PX, help="of corners, px")
    parser.add_argument("--held", choices=("same", "other"), help="images before lenses that are held")
    args = parser.parse_args()
    print("| lens | quantity | sessions | errors within the 95 % bound |\n|:--|:--|--:|--:|")
    for name in [STRANGE] if args.strange else args.lens or LENSES:
        model = "auto" if args.strange else LENSES[name].model
        session = Session(model, args.frames, args.noise, HALF if args.half else 1.0, args.held)
        shares: dict[str, list[float]] = {}
        for trial in range(args.trials):
            rng = np.random.default_rng([trial, len(name)])
            lenses = lenses_of(name, trial, args.departs, rng)
            for run in (rig_trial,) if args.held else (rig_trial, alone_trial):
                for quantity, share in run(lenses, session, rng):
                    shares.setdefault(quantity, []).append(share)
        for quantity, found in shares.items():
            own = np.array(found)
            error = own.std() / np.sqrt(len(own))
            print(f"| {name} | {quantity} | {len(own)} | {100 * own.mean():.1f} +- {100 * error:.1f} % |", flush=True)


if __name__ == "__main__":
    main()
