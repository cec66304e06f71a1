"""Test the stated uncertainties outside of the part of the image that boards covered.

Cameras are calibrated from random images, with only the corners in an ellipse around the middle. After the best
rotation where boards were, the projection is compared with the truth (lab-a, RENDERED), or with the calibration from
all corners of all other images of the same camera (REAL; its uncertainty is included). Bands are by the distance to the
covered part, over half the image's diagonal.

    python scripts/measure_beyond_boards.py [SET ...] [--data DIR] [--sessions 20] [--middle .45 .75] [--model MODEL]
        [--cache DIR]

SETs are those of `split_halves.py`. Prints for each set and band: RMS error over the stated one, both in px, and the
number of sessions whose RMS error in the band is more than twice the stated one.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from halves.captures import CAPTURES, Loaded, Views, load
from halves.comparing import calibrated
from scipy.ndimage import distance_transform_edt

from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.core.errors import RigkitError

GRID = (40, 30)
BANDS = ((0.0, 0.0), (0.0, 0.06), (0.06, 0.14), (0.14, 0.25), (0.25, 0.4))
"""Distances to the cover, in parts of half the diagonal; the first is the cover itself."""
IMAGES = 8, 14
"""So many of a set are taken for a session."""
MIN_CORNERS, MIN_VIEWS, MIN_PIXELS = 12, 4, 5
DEFAULT = ["lab-regular", "lab-fisheye", "bouguet-left", "bouguet-right", "caliper", "camodocal", "ocam", "ov-plane"]
DEFAULT += ["charuco-stereo-left", "charuco-stereo-right", "charuco-lifecam", "aprilgrid-mocap", "cylinder"]


@dataclass(frozen=True, slots=True)
class Band:
    """Of one session: mean squared error over what is stated, and both as mean squares, px^2."""

    relative: float
    error: float
    stated: float


@dataclass(frozen=True, eq=False, slots=True)
class TrueLens:
    """A lens of lab-a: theta = sum k_i r^i, r in mm on the sensor."""

    k: np.ndarray
    pixel_mm: float
    centre_px: np.ndarray

    @classmethod
    def read(cls, path: Path) -> TrueLens:
        lens = json.loads(path.read_text())["lens_truth"]
        return cls(np.array(lens["k"]), lens["pixel_mm"], np.array(lens["centre_px"]))

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return unit rays (..., 3), and where there is one: everywhere."""
        off = (pixels - self.centre_px) * self.pixel_mm
        r = np.linalg.norm(off, axis=-1)
        theta = sum(k * r ** (i + 1) for i, k in enumerate(self.k))
        along = off / np.maximum(r, 1e-12)[..., None]
        rays = np.concatenate([np.sin(theta)[..., None] * along, np.cos(theta)[..., None]], axis=-1)
        return rays, np.ones(rays.shape[:-1], bool)


def middle_of(views: Views, size_px: tuple[int, int], middle: tuple[float, float], rng: np.random.Generator) -> Views:
    """Return some of the images, with the corners that lie in an ellipse about the middle: its half
    axes are drawn between these parts of the image's half width and height."""
    names = rng.permutation(sorted(views))[: rng.integers(IMAGES[0], min(IMAGES[1], len(views)) + 1)]
    half = 0.5 * np.array(size_px)
    axes, centre = rng.uniform(*middle) * half, half - 0.5 + rng.normal(0.0, 0.05, 2) * half
    out = {}
    for name in sorted(names):
        own = []
        for view in views[name]:
            inside = (((view.pixels - centre) / axes) ** 2).sum(axis=1) <= 1.0
            if inside.sum() >= MIN_CORNERS:
                grid, pixels, sigma_px = view.grid[inside], view.pixels[inside], view.sigma_px[inside]
                own.append(replace(view, grid=grid, pixels=pixels, sigma_px=sigma_px))
        if own:
            out[name] = own
    return out


def bands_of(
    small: Calibration, other: Camera | TrueLens, usable: np.ndarray, stated_by: Calibration | None
) -> dict[int, Band]:
    """Return the bands of a session held against another camera where that is `usable` (rows, columns), after the best
    rotation where the session had boards; what `stated_by` says is stated, too."""
    pixels = grid_pixels(small.camera.size_px, GRID)
    covered = covered_by_boards(small, pixels)
    there, seen = other.unproject(pixels)
    both = covered & usable & seen
    turn = best_rotation(there[both], pixels[both], np.ones(int(both.sum())), small.camera)
    shown, valid = small.camera.project(np.where(seen[..., None], there, [0.0, 0.0, 1.0]) @ turn.T)
    rays, own = small.camera.unproject(pixels)
    known = valid & seen & usable & own
    stated = np.full(known.shape, np.nan)
    stated[known] = np.trace(FarProjection.of(small).covariance(rays[known]), axis1=1, axis2=2)
    if stated_by is not None:
        stated[known] += np.trace(FarProjection.of(stated_by).covariance(there[known]), axis1=1, axis2=2)
    error = ((shown - pixels) ** 2).sum(axis=-1)
    step = pixels[1, 1] - pixels[0, 0]
    away = distance_transform_edt(~covered, sampling=step[::-1]) / (0.5 * np.hypot(*small.camera.size_px))
    out = {}
    for k, (low, high) in enumerate(BANDS):
        inside = known & np.isfinite(stated) & (covered if high == 0.0 else ~covered & (away > low) & (away <= high))
        if inside.sum() >= MIN_PIXELS:
            e, s = error[inside], stated[inside]
            out[k] = Band(float((e / s).mean()), float(e.mean()), float(s.mean()))
    return out


def against_truth(small: Calibration, truth: TrueLens) -> dict[int, Band]:
    """Hold a session against the exact lens."""
    return bands_of(small, truth, np.ones(grid_pixels(small.camera.size_px, GRID).shape[:2], bool), None)


def against_others(small: Calibration, others: Calibration) -> dict[int, Band]:
    """Hold a session against the calibration from the other images, where those had boards."""
    usable = covered_by_boards(others, grid_pixels(small.camera.size_px, GRID))
    return bands_of(small, others.camera, usable, others)


def sessions(name: str, loaded: Loaded, args: argparse.Namespace) -> list[dict[int, Band]]:
    """Return the bands of so many random sessions of a set."""
    views, size = loaded
    capture, found = CAPTURES[name], []
    truth = TrueLens.read(args.data / capture.folder / "truth.json") if capture.rendered else None
    for seed in range(args.first, args.first + args.sessions):
        rng = np.random.default_rng([seed, sum(map(ord, name))])
        part = middle_of(views, size, tuple(args.middle), rng)
        if len(part) < MIN_VIEWS:
            continue
        try:
            small = calibrated(part, size, args.model)
            if truth is not None:
                found.append(against_truth(small, truth))
            else:
                rest = {image: own for image, own in views.items() if image not in part}
                found.append(against_others(small, calibrated(rest, size, args.model)))
        except RigkitError as error:
            print(f"{name} session {seed}: {error}", flush=True)
            continue
        if args.list:
            rows = " | ".join(
                f"{np.sqrt(b.relative):.2f} ({np.sqrt(b.error):.3f}/{np.sqrt(b.stated):.3f})"
                for _, b in sorted(found[-1].items())
            )
            lens = small.camera
            print(f"{name} {seed} {len(part)} [{lens.model} {lens.parameters.size}, {small.boards[0].kind}] {rows}")
    return found


def rows_of(name: str, found: list[dict[int, Band]]) -> str:
    """Return the table's row of a set."""
    by_band: dict[int, list[Band]] = defaultdict(list)
    for one in found:
        for k, band in one.items():
            by_band[k].append(band)
    cells = []
    for k in range(len(BANDS)):
        own = by_band[k]
        if len(own) < 3:
            cells.append("")
            continue
        relative = np.sqrt(np.mean([b.relative for b in own]))
        error, stated = (np.sqrt(np.median([getattr(b, what) for b in own])) for what in ("error", "stated"))
        twice = np.mean([b.error > 4.0 * b.stated for b in own])
        cells.append(f"{relative:.2f} ({error:.3f} / {stated:.3f}, {100 * twice:.0f} %)")
    return f"| {name} ({len(found)}) | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"of {', '.join(CAPTURES)}")
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[1] / "../shared/data")
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument(
        "--middle",
        nargs=2,
        type=float,
        default=[0.45, 0.75],
        metavar="PART",
        help="of the image's half width and height",
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first session")
    parser.add_argument("--model", default="scaramuzza")
    parser.add_argument("--cache", type=Path, default=Path("/tmp/split_halves_cache"), help="of corners")
    parser.add_argument("--list", action="store_true", help="a line for each session")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    heads = ["covered", *(f"{low} to {high}" for low, high in BANDS[1:])]
    lines = [f"| set (sessions) | {' | '.join(heads)} |", "|:--" + "|:--" * len(BANDS) + "|"]
    for name in args.sets or DEFAULT:
        loaded = load(name, args.data, args.cache)
        if loaded[0]:
            lines.append(rows_of(name, sessions(name, loaded, args)))
            print(lines[-1], flush=True)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
