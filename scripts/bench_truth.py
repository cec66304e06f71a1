"""The table of truth: rigkit, OpenCV, mrcal and COLMAP on REAL captures with measured truth.

    python scripts/bench_truth.py [SET ...] [--data DIR] [--work DIR] [--model MODEL] [--json FILE]
        [--page datasets/public/README.md] [--short docs/pages/accuracy-truth.md]

rigkit runs with its defaults on all sets (automatic model and board shape). OpenCV, mrcal (Debian: apt-get install
mrcal python3-mrcal) and COLMAP (pycolmap) get the corners that rigkit kept, so that calibrations and not detectors are
compared; OpenCV also runs on the corners that it detects itself. No constant is changed for a set. Held-out errors are
computed alike for all: every fifth image, with camera and board from the others, and only the pose refitted. Sigmas are
those that a tool states, if any.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from truth import peers
from truth.cameras import aprilgrid_mocap, caliper_board, one_camera, ov_plane, simplestereo
from truth.pairs import cylinder, multicam, stereo, trihedral
from truth.singles import aprilgrid
from truth.table import Bench, Row, as_json, long_table, merged, short_table, with_table

from rigkit.core.errors import RigkitError
from rigkit.workflows.fetch import fetch_public_set, public_sets

BENCHES: Mapping[str, Callable[[Bench], Iterator[Row]]] = {
    "caliper-board": caliper_board,
    "cylinder": cylinder,
    "bumblebee2": stereo("left*.jpg", "right*.jpg", ("baseline", "published baseline")),
    "trihedral-stereo": trihedral,
    "bouguet-stereo": stereo("left*.jpg", "right*.jpg", ("published baseline",)),
    "simplestereo": simplestereo,
    "ov-plane": ov_plane,
    "ocam-fisheye1": one_camera("*.jpg", True, "published rms"),
    "camodocal-fisheye": one_camera("*.png", True, "refitted rms"),
    "aprilgrid": aprilgrid,
    "aprilgrid-mocap": aprilgrid_mocap,
    "circles-regular": one_camera("*.jpg", False),
    "circles-hexagonal": one_camera("*.jpg", False),
    "charuco-lifecam": one_camera("*.jpg", False),
    "charuco-lifecam-legacy": one_camera("*.jpg", False),
    "charuco-stereo": stereo("left*.png", "right*.png", ()),
    "pose2sim": one_camera("*/*.jpg", False),
    "multicam-video": multicam,
}


def measure(name: str, bench: Bench) -> list[Row]:
    """Return the rows of a set, as far as they come."""
    own = list[Row]()
    try:
        for row in BENCHES[name](bench):
            own.append(row)
    except RigkitError as error:
        print(f"{name}: {error}")
    print(long_table(own), flush=True)
    return own


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"of {', '.join(BENCHES)}; default all")
    parser.add_argument("--data", type=Path, default=None, help="folder of captures; default: RIGKIT_DATA or the cache")
    parser.add_argument("--work", type=Path, default=Path("/tmp/rigkit-bench-truth"), help="corners and calibrations")
    parser.add_argument("--model", default="auto", help="rigkit's, of all sets")
    parser.add_argument("--most", type=int, help="images of boards a camera, spread evenly; default: all")
    parser.add_argument("--json", type=Path, help="put the rows of these sets into this file; it keeps other sets'")
    parser.add_argument("--page", type=Path, help="write the long table between the marks of this page")
    parser.add_argument("--short", type=Path, help="write the table with a column a tool into this page")
    args = parser.parse_args()
    if unknown := sorted(set(args.sets) - set(BENCHES)):
        parser.error(f"no set is called {', '.join(unknown)}; known: {', '.join(BENCHES)}")
    args.work.mkdir(parents=True, exist_ok=True)
    if not peers.mrcal_there():
        print("mrcal does not install here: left out")
    known, rows = public_sets(), list[Row]()
    for name in args.sets or BENCHES:
        found = fetch_public_set(known[name], args.data)
        if found.missing:
            print(f"{name}: {len(found.missing)} files are not here, such as '{found.missing[0]}': left out")
            continue
        own = measure(name, Bench(found, args.work, args.model, args.most))
        rows = merged(args.json, own, list(BENCHES)) if args.json else [*rows, *own]
        if args.json:
            args.json.write_text(json.dumps(as_json(rows), indent=1) + "\n")
    for page, table in ((args.page, long_table(rows)), (args.short, short_table(rows))):
        if page:
            page.write_text(with_table(page.read_text(), table))


if __name__ == "__main__":
    main()
