"""Test the stated uncertainties of REAL calibrations: calibrate two halves of one camera's images separately.

The images of every set are split randomly into halves. The difference of two calibrations of the same camera, after the
best rotation and where both had boards, must agree with its prediction: the ratio of observed to predicted difference
is 1 on average over many splits. Splits of few images are strongly correlated, and a difference has few degrees of
freedom, so this ratio scatters. The interval of 95 % of such ratios for true sigmas is printed too (same splits, new
errors of all images). More splits narrow it little; the last line combines all sets. The power of the test is measured
as well: other cameras, and slightly moved lenses, must be found.

    python scripts/split_halves.py [SET ...] [--data DIR] [--splits 6] [--images N] [--cache DIR] [--power]
        [--model MODEL] [--without IMAGE ...] [--twins N] [--small N] [--seed N]

--images N: calibrate N images against all others, for the sigmas of small sessions. --without: leave the named images
out, to see whether a ratio comes from one of them. --twins N: halves of N SIMULATED sessions like the real one, with
equal errors of all images (`honesty.twins`): if these agree with their sigmas and the real one does not, one of its
images has another error. --small N: N random draws of 3, 4, 5, 7 and 10 images against all others (`honesty.small`;
with --twins of SIMULATED sessions), with the sigmas and verdicts of small sessions; --model auto is what a user gets.
Sets of frames of several cameras are compared as rigs (`halves.rigs`). --seed N: other random splits, draws and twins.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from halves.captures import CAPTURES, OTHERS, Loaded, load
from halves.comparing import calibrated, in_words, own_scatter, seeds_of, two_parts
from halves.power import power
from halves.rigs import RIGS, split_rig
from honesty.small import Drawn, drawn_sessions, print_small, table
from honesty.twins import twin

from rigkit.calibration.compare import CalibrationComparison, CameraVerdict, compare_calibrations
from rigkit.core.errors import RigkitError

WITHIN_95 = 1.96


def split(name: str, loaded: Loaded, args: argparse.Namespace) -> list[CalibrationComparison]:
    """Print and return the comparisons of random halves of a set, or of so many images with all others."""
    rng = np.random.default_rng(seeds_of(name, args.seed))
    found = []
    for k in range(args.splits):
        parts = two_parts(loaded[0], rng, args.images)
        try:
            a, b = (calibrated(part, loaded[1], args.model) for part in parts)
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


def twins(name: str, loaded: Loaded, count: int, model: str, seed: int) -> None:
    """Print what halves of so many SIMULATED sessions like the real one come to."""
    views, size = loaded
    found, ratios, other = calibrated(views, size, model), [], 0
    for k in range(count):
        rng = np.random.default_rng([k, *seeds_of(name, seed)])
        a, b = (calibrated(part, size, model) for part in two_parts(twin(found, views, rng), rng))
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
        low, typical, high = own_scatter(views, size, len(found), args.model, seeds_of(name, args.seed)).tolist()
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
    found = drawn_sessions(
        lambda rng: views if whole is None else twin(whole, views, rng),
        args.small,
        lambda part: calibrated(part, size, args.model),
        seeds_of(name, args.seed),
    )
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
    parser.add_argument(
        "sets", nargs="*", metavar="SET", help=f"of {', '.join([*CAPTURES, *RIGS])}; default all cameras"
    )
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[1] / "../shared/data")
    parser.add_argument("--splits", type=int, default=6)
    parser.add_argument("--cache", type=Path, default=Path("/tmp/split_halves_cache"), help="of corners")
    parser.add_argument("--model", default="scaramuzza")
    parser.add_argument("--images", type=int, help="so many against all others, instead of halves")
    parser.add_argument("--power", action="store_true", help="find other cameras and moved lenses")
    parser.add_argument("--without", nargs="+", default=[], metavar="IMAGE", help="leave these images out")
    parser.add_argument("--twins", type=int, metavar="N", help="halves of so many simulated sessions like the real one")
    parser.add_argument("--small", type=int, metavar="N", help="so many draws of 3 to 10 images against all others")
    parser.add_argument("--seed", type=int, default=0, help="of splits, draws and twins")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    if unknown := [name for name in args.sets if name not in CAPTURES and name not in RIGS]:
        print(f"no set is called '{unknown[0]}'; there are {', '.join([*CAPTURES, *RIGS])}", file=sys.stderr)
        sys.exit(2)
    for name in [name for name in args.sets if name in RIGS]:
        split_rig(name, args.data, args.cache, args.splits, args.model, args.seed)
    if args.sets and not set(args.sets) & set(CAPTURES):
        return
    args.sets = [name for name in args.sets if name in CAPTURES]
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
            twins(name, loaded, args.twins, args.model, args.seed)
        else:
            everything[name] = loaded, split(name, loaded, args)
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
