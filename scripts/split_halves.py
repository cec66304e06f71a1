"""Test the stated uncertainties of real calibrations: calibrate two halves of one camera's images separately.

The images of every set are split randomly into halves. The difference of two calibrations of the same camera, after the
best rotation and where both had boards, must agree with its prediction: the ratio of observed to predicted difference
is 1 on average over many splits. Splits of few images are strongly correlated, and a difference has few degrees of
freedom, so this ratio scatters. The interval of 95 % of such ratios for true sigmas is printed too (same splits, new
errors of all images). More splits narrow it little; the last line combines all sets. The power of the test is measured
as well: other cameras, and slightly moved lenses, must be found.

    python scripts/split_halves.py [SET ...] [--data DIR] [--splits 6] [--images N] [--cache DIR] [--power]
        [--model MODEL] [--without IMAGE ...] [--twins N] [--small N]

--images N: calibrate N images against all others, for the sigmas of small sessions. --without: leave the named images
out, to see whether a ratio comes from one of them. --twins N: halves of N SIMULATED sessions like the real one, with
equal errors of all images (`honesty.twins`): if these agree with their sigmas and the real one does not, one of its
images has another error. --small N: N random draws of 3, 4, 5, 7 and 10 images against all others (`honesty.small`;
with --twins of SIMULATED sessions), with the sigmas and verdicts of small sessions; --model auto is what a user gets.
"""

from __future__ import annotations

import argparse
import hashlib
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from honesty.small import Drawn, drawn_sessions, print_small, table
from honesty.twins import twin
from truth.cameras import published_corners

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.calibration.compare import CalibrationComparison, CameraVerdict, compare_calibrations
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.clustered import drawn_errors, reduced_by_cluster
from rigkit.calibration.solving.linearise import view_products
from rigkit.calibration.solving.state import State
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.usable import views_of_image
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.cameras.convert import refit_camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.detection.detect import detect_boards
from rigkit.io.boards.board_words import board_in_words
from rigkit.io.media.images import read_image

Views = dict[str, list[BoardView]]
"""What each image shows, by its name."""
Loaded = tuple[Views, tuple[int, int]]
"""What the images of a set show, and their size."""


@dataclass(frozen=True, slots=True)
class Capture:
    """Images of one unchanged camera: where they are, and the board on them."""

    folder: str
    pattern: str
    board: Board
    rendered: bool = False


def identified(words: str) -> Board:
    board = board_in_words(words)
    assert board is not None
    return board


CHARUCO_STEREO = "charuco:30x15x49.33,dictionary=DICT_4X4_250,marker_mm=38.46"
CAPTURES = {
    "bouguet-left": Capture("real/bouguet-stereo", "left*.jpg", Board("b", 9, 6, 30.0, 30.0)),
    "bouguet-right": Capture("real/bouguet-stereo", "right*.jpg", Board("b", 9, 6, 30.0, 30.0)),
    "camodocal": Capture("real/camodocal-fisheye", "*.png", Board("b", 9, 6, 30.0, 30.0)),
    "ocam": Capture("real/ocam-fisheye1", "*.jpg", Board("b", 8, 6, 32.5, 32.5)),
    "ov-plane": Capture("real/ov-plane/corners", "*/*.orpc", Board("ov", 22, 22, 7.5, 7.5)),
    "caliper": Capture("public/caliper-board", "*.png", Board("b", 16, 10, 15.0, 15.0)),
    "fisheye-chess": Capture("public/fisheye-chess", "*.jpg", Board("b", 4, 6, 30.0, 30.0)),
    "cylinder": Capture("public/cylinder/201", "*", Board("b", 19, 14, 10.0, 10.0)),
    "cylinder-202": Capture("public/cylinder/202", "*", Board("b", 19, 14, 10.0, 10.0)),
    "bumblebee-left": Capture("public/bumblebee2", "left*.jpg", Board("b", 4, 6, 30.0, 30.0)),
    "bumblebee-right": Capture("public/bumblebee2", "right*.jpg", Board("b", 4, 6, 30.0, 30.0)),
    "charuco-stereo-left": Capture("public/charuco-stereo", "left*", identified(CHARUCO_STEREO)),
    "charuco-stereo-right": Capture("public/charuco-stereo", "right*", identified(CHARUCO_STEREO)),
    "charuco-lifecam": Capture(
        "public/charuco-lifecam", "*.jpg", identified("charuco:7x7x25.4,dictionary=DICT_4X4_50,marker_mm=19.05")
    ),
    "aprilgrid-mocap": Capture("public/aprilgrid-mocap/cam0/data", "*", identified("aprilgrid:6x6x88,spacing=0.3")),
    "lab-regular": Capture("lab-a/calibration/regular", "*.jpg", Board("b", 9, 6, 30.0, 30.0), True),
    "lab-fisheye": Capture("lab-a/calibration/fisheye", "*.jpg", Board("b", 9, 6, 30.0, 30.0), True),
}


OTHERS = [
    ("bouguet-left", "bouguet-right"),
    ("bumblebee-left", "bumblebee-right"),
    ("charuco-stereo-left", "charuco-stereo-right"),
    ("cylinder", "cylinder-202"),
    ("lab-regular", "lab-fisheye"),
]
"""Different cameras with images of one size."""


WITHIN_95 = 1.96
PUBLISHED_SIZE_PX = (1280, 800)
"""Of the images of published corners."""
DRAWS = 4000
"""Sessions drawn anew, for the scatter of a ratio."""
ASKED_IMAGES, POWER_DRAWS = 20, 20
"""Images a side with which a touched lens is asked to be found, and pairs of such sessions drawn."""


def views_of(path: Path, board: Board, cache: Path) -> tuple[list[BoardView], tuple[int, int]]:
    """Return what an image shows and its size, from the images or from the cache."""
    if path.suffix == ".orpc":
        return [published_corners(path, board)], PUBLISHED_SIZE_PX
    digest = hashlib.sha256(path.read_bytes() + repr(board).encode()).hexdigest()[:20]
    kept = cache / f"{digest}.pickle"
    if not kept.is_file():
        image = read_image(path)
        views, _ = views_of_image(path.name, detect_boards(image, [board]), [board])
        kept.write_bytes(pickle.dumps((views[:1], (image.shape[1], image.shape[0]))))
    views, size = pickle.loads(kept.read_bytes())
    return [replace(view, image=path.name) for view in views], size


def load(name: str, data: Path, cache: Path) -> Loaded:
    """Return what the images of a set show, and their size."""
    capture = CAPTURES[name]
    found: Views = {}
    size = (0, 0)
    for path in sorted((data / capture.folder).glob(capture.pattern)):
        views, size = views_of(path, capture.board, cache)
        if views:
            found[path.name] = views
    return found, size


def halves(views: Views, rng: np.random.Generator, images: int | None = None) -> tuple[Views, Views]:
    """Return the images, split at random: in halves, or so many `images` and all others."""
    names = rng.permutation(sorted(views)).tolist()
    parts = (names[::2], names[1::2]) if images is None else (names[:images], names[images:])
    return tuple({name: views[name] for name in sorted(part)} for part in parts)  # type: ignore[return-value]


def calibrated(views: Views, size_px: tuple[int, int], model: str) -> Calibration:
    return calibrate([view for own in views.values() for view in own], size_px, model=model)


def in_words(what: str, found: CalibrationComparison) -> str:
    return (
        f"{what}: {found.difference.rms_px:.4f} px, expected {found.predicted_px:.4f} px, ratio {found.ratio:.2f}, "
        f"chance {found.chance:.4f}: {found.verdict}"
    )


def own_scatter(views: Views, size_px: tuple[int, int], splits: int, model: str, seed: int) -> np.ndarray:
    """Return the 2.5th, 50th and 97.5th percentile of the geometric mean ratio of these splits where sigmas are true.

    At first order: image i pulls the parameters by a score s_i of variance H_i, its information after its own pose.
    What the calibrations know of their own disagreement scatters, too: with one degree of freedom less than images.
    """
    found = calibrated(views, size_px, model)
    names = sorted({view.image for view in found.views})
    used = [view for name in names for view in views[name]]
    poses = {(view.image, view.board_id): view.cam_from_board for view in found.views}
    used = [view for view in used if (view.image, view.board.board_id) in poses]
    own = [poses[view.image, view.board.board_id] for view in used]
    observations = Observations.from_views(used)
    rotation, shift = np.array([pose.rotation for pose in own]), np.array([pose.translation_mm for pose in own])
    state = State.start(found.camera, rotation, shift, observations)
    cluster = np.array([names.index(view.image) for view in used])
    p = found.camera.parameters.size
    products = view_products(observations, state, observations.weight * observations.present)
    information, _ = reduced_by_cluster(products, p, cluster)
    pixels = grid_pixels(size_px, (20, 15))
    pixels = pixels[covered_by_boards(found, pixels)]
    rays, valid = found.camera.unproject(pixels)
    design = projection_design(found.camera, rays[valid]).transpose(2, 0, 1).reshape(-1, p + 3)
    turn = np.linalg.qr(design[:, p:])[0]
    sigmas = np.maximum(found.parameter_sigmas, np.finfo(float).tiny)
    seen = (design[:, :p] - turn @ (turn.T @ design[:, :p])) * sigmas
    information = information * sigmas[:, None] * sigmas
    rng, drawn = np.random.default_rng(seed), np.random.default_rng(0)
    values, axes = np.linalg.eigh(information)
    roots = axes * np.sqrt(np.maximum(values, 0.0))[:, None]
    scores = np.einsum("nij,njd->nid", roots, drawn.normal(size=(len(names), p, DRAWS)))
    logs = np.zeros(DRAWS)
    for _ in range(splits):
        difference = np.zeros((p, DRAWS))
        of_all = sorted(views)
        order = [of_all[k] for k in rng.permutation(len(of_all))]
        for sign, part in ((1.0, order[::2]), (-1.0, order[1::2])):
            chosen = [names.index(name) for name in part if name in names]
            difference += (
                sign * np.linalg.pinv(information[chosen].sum(axis=0), hermitian=True) @ scores[chosen].sum(axis=0)
            )
        size = np.linalg.norm(seen @ difference, axis=0)
        logs += np.log(size / np.median(size)) / splits
    logs -= 0.5 * np.log(drawn.chisquare(len(names) - 1, DRAWS) / (len(names) - 1))
    return np.exp(np.quantile(logs, [0.025, 0.5, 0.975]))


def split(name: str, loaded: Loaded, splits: int, model: str, images: int | None) -> list[CalibrationComparison]:
    """Print and return the comparisons of random halves of a set, or of so many `images` with all others."""
    rng = np.random.default_rng(len(name))
    found = []
    for k in range(splits):
        try:
            a, b = (calibrated(part, loaded[1], model) for part in halves(loaded[0], rng, images))
            found.append(compare_calibrations(a, b))
        except RigkitError as error:
            print(f"{name} split {k}: {error}", flush=True)
            continue
        about = " ".join(
            f"[{c.camera.model} {c.camera.parameters.size}, {c.boards[0].kind}, x{c.overdispersion:.2f}]"
            for c in (a, b)
        )
        print(in_words(f"{name} split {k} {about}", found[-1]), flush=True)
    return found


def twins(name: str, loaded: Loaded, count: int, model: str) -> None:
    """Print what halves of so many SIMULATED sessions like the real one come to."""
    views, size = loaded
    found, ratios, other = calibrated(views, size, model), [], 0
    for seed in range(count):
        rng = np.random.default_rng([seed, len(name)])
        a, b = (calibrated(part, size, model) for part in halves(twin(found, views, rng), rng))
        compared = compare_calibrations(a, b)
        ratios.append(compared.ratio)
        other += compared.verdict is CameraVerdict.OTHER
    logs = np.log(ratios)
    mean, error = np.exp(logs.mean()), np.exp(logs.std(ddof=1) / np.sqrt(count))
    low, high = np.exp(np.quantile(logs, [0.05, 0.95])).tolist()
    print(
        f"{name}, {count} SIMULATED twins, board {found.boards[0].kind}: geometric mean ratio {mean:.2f} (x or / "
        f"{error:.2f}), of one session 5 and 95 % {low:.2f} and {high:.2f}; another camera in {other}",
        flush=True,
    )


def changed(views: Views, move: Callable[[np.ndarray], np.ndarray], size_px: tuple[int, int]) -> Views:
    """Return the views as another lens shows them: their corners moved."""
    limit = np.array(size_px) - 0.5
    moved = {}
    for name, own in views.items():
        moved[name] = [replace(view, pixels=np.clip(move(view.pixels), -0.5, limit)) for view in own]
    return moved


def shift_px(camera: Camera, pixels: np.ndarray, remaining_px: float) -> np.ndarray:
    """Return by how much the principal point must move for `remaining_px` rms to remain after the best rotation."""
    rays, valid = camera.unproject(pixels)
    along = np.array([1.0, 0.5])
    design = projection_design(camera, rays[valid])[:, -3:].transpose(2, 0, 1).reshape(-1, 3)
    all_moved = np.tile(along, int(valid.sum()))
    left = all_moved - design @ np.linalg.lstsq(design, all_moved, rcond=None)[0]
    return remaining_px / max(float(np.sqrt(2.0 * (left**2).mean())), 1e-9) * along


def power(name: str, loaded: Loaded, model: str) -> None:
    """Print the comparisons of one half with the other half behind a lens that was touched. Print how often it would be
    found with as many images a side as are asked of a user, of this camera and these boards: errors are drawn from what
    all images say that calibrations err by."""
    views, size = loaded
    a_views, b_views = halves(views, np.random.default_rng(0))
    a, whole = calibrated(a_views, size, model), calibrated(views, size, model)
    centre = a.camera.project(np.array([0.0, 0.0, 1.0]))[0]
    pixels = np.concatenate([view.pixels[view.kept] for view in a.views])
    shift = shift_px(a.camera, pixels[:: max(1, len(pixels) // 500)], 0.2)
    for what, move in (
        ("focal length + 0.1 %", lambda p: centre + 1.001 * (p - centre)),
        (f"principal point moved by {np.linalg.norm(shift):.1f} px", lambda p: p + shift),
    ):
        found = compare_calibrations(a, calibrated(changed(b_views, move, size), size, model))
        print(
            f"{in_words(f'{name} ({len(a_views)} images a side), {what}', found)}; with {ASKED_IMAGES} a side, drawn: "
            f"found {drawn_power(whole, move, len(views))} of {POWER_DRAWS} times",
            flush=True,
        )


def drawn_power(whole: Calibration, move: Callable[[np.ndarray], np.ndarray], images: int) -> int:
    """Return how often two calibrations from ASKED_IMAGES images each would be told apart, the second behind a lens
    that was touched: POWER_DRAWS pairs drawn from the covariance of one from so many `images`."""
    pixels = np.concatenate([view.pixels[view.kept] for view in whole.views])
    rays, valid = whole.camera.unproject(pixels)
    cameras = whole.camera, refit_camera(whole.camera, rays[valid], move(pixels[valid]))
    covariance, rng = whole.covariance * images / ASKED_IMAGES, np.random.default_rng(0)
    errors = drawn_errors(covariance, np.inf, rng).T
    found = 0
    for k in range(POWER_DRAWS):
        a, b = (
            replace(
                whole,
                camera=camera.with_parameters(camera.parameters + errors[2 * k + side]),
                covariance=covariance,
                freedom=float(ASKED_IMAGES - 1),
            )
            for side, camera in enumerate(cameras)
        )
        found += compare_calibrations(a, b).verdict is CameraVerdict.OTHER
    return found


def summary(
    name: str, loaded: Loaded, found: list[CalibrationComparison], args: argparse.Namespace
) -> tuple[float, float] | None:
    """Print what the splits of a set come to. Return the logarithm of their mean ratio over what it is by the median
    where sigmas are true, and the standard deviation that it has there; None of rendered images, and of small parts."""
    ratio = float(np.exp(np.mean([np.log(c.ratio) for c in found])))
    other = sum(c.verdict is CameraVerdict.OTHER for c in found)
    views, size = loaded
    likely, off = "", None
    if args.images is None:
        low, typical, high = own_scatter(views, size, len(found), args.model, len(name)).tolist()
        likely = f" (if sigmas are true {typical:.2f}, 95 % from {low:.2f} to {high:.2f})"
        if not CAPTURES[name].rendered:
            off = float(np.log(ratio / typical)), float(np.log(high / low)) / (2.0 * WITHIN_95)
    print(
        f"{name} ({len(views)} images): geometric mean ratio {ratio:.2f}{likely}; another camera in {other} of "
        f"{len(found)}",
        flush=True,
    )
    return off


def small(name: str, loaded: Loaded, args: argparse.Namespace) -> dict[int, list[Drawn | str]]:
    """Print and return what small sessions of a set, or of its twins, come to, by how many images they have."""
    views, size = loaded
    whole = calibrated(views, size, args.model) if args.twins else None
    seed, drawn = sum(map(ord, name)), lambda rng: views if whole is None else twin(whole, views, rng)
    found = drawn_sessions(drawn, args.small, lambda part: calibrated(part, size, args.model), seed)
    print(f"{name} ({len(views)} images)\n{table(found)}", flush=True)
    return found


def print_of_all(off: list[tuple[float, float]]) -> None:
    """Print what all REAL sets together say: one set's ratio scatters from a half to twice by itself."""
    log, sigma = np.array(off).T
    weight = sigma**-2 / (sigma**-2).sum()
    mean, error = float(weight @ log), float((sigma**-2).sum() ** -0.5)
    outside = int((abs(log) > WITHIN_95 * sigma).sum())
    print(
        f"{len(log)} real sets: ratio {np.exp(mean):.2f} of what is usual (x or / {np.exp(error):.2f}); each is "
        f"{np.sqrt(np.mean((log / sigma) ** 2)):.2f} of its own sigmas off (rms), {outside} outside of their 95 %"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"of {', '.join(CAPTURES)}; default all")
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[1] / "../shared/data")
    parser.add_argument("--splits", type=int, default=6)
    parser.add_argument("--cache", type=Path, default=Path("/tmp/split_halves_cache"), help="of corners")
    parser.add_argument("--model", default="scaramuzza")
    parser.add_argument("--images", type=int, help="so many against all others, instead of halves")
    parser.add_argument("--power", action="store_true", help="find other cameras and moved lenses")
    parser.add_argument("--without", nargs="+", default=[], metavar="IMAGE", help="leave these images out")
    parser.add_argument("--twins", type=int, metavar="N", help="halves of so many simulated sessions like the real one")
    parser.add_argument("--small", type=int, metavar="N", help="so many draws of 3 to 10 images against all others")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    everything: dict[str, tuple[Loaded, list[CalibrationComparison]]] = {}
    few: dict[str, dict[int, list[Drawn | str]]] = {}
    for name in args.sets or CAPTURES:
        views, size = load(name, args.data, args.cache)
        if not views:
            print(f"{name}: no images in {args.data / CAPTURES[name].folder}: left out")
            continue
        loaded = {image: own for image, own in views.items() if image not in args.without}, size
        if args.small:
            few[name] = small(name, loaded, args)
        elif args.power:
            power(name, loaded, args.model)
        elif args.twins:
            twins(name, loaded, args.twins, args.model)
        else:
            everything[name] = loaded, split(name, loaded, args.splits, args.model, args.images)
    there = {name for name in args.sets or CAPTURES if (args.data / CAPTURES[name].folder).is_dir()}
    for a, b in [pair for pair in OTHERS if args.power and set(pair) <= there]:
        first, second = (calibrated(*load(name, args.data, args.cache), args.model) for name in (a, b))
        print(in_words(f"{a} against {b}", compare_calibrations(first, second)))
    off = [summary(name, loaded, found, args) for name, (loaded, found) in everything.items() if found]
    print_small(few, {name for name in few if CAPTURES[name].rendered})
    if args.images is None and len(off) > 1:
        print_of_all([one for one in off if one is not None])


if __name__ == "__main__":
    main()
