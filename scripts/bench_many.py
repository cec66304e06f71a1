"""Validate 200 small RENDERED data sets with local processes and on a local Dask cluster: the tables must be equal.
Needs joblib and distributed (pip install 'rigkit[cluster]').

python scripts/bench_many.py [--count 200] [--workers 2]
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigkit.cameras.brown import Brown
from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.io.boards.board_file import board_text
from rigkit.io.calibrations.calibration_file import save_camera
from rigkit.synthetic.pairs import trihedral_pair
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics
from rigkit.workflows.options.clouds import ValidateOptions
from rigkit.workflows.validation.validate_many import ManyValidation, validate_datasets

CAMERA = Brown((480, 360), np.array([300.0, 300.5, 241.0, 179.0, -0.05, 0.01, 0.0, 0.0, 0.0]))
PLANES = (Board("plane1", 8, 6, 50.0, 50.0), Board("plane2", 7, 6, 50.0, 50.0), Board("plane3", 6, 9, 50.0, 50.0))
OPTICS, PHOTOMETRY = Optics(0.6, supersample=2), Photometry(noise_levels=1.5)
WRONG_EVERY = 10
"""Of so many data sets one says another angle than the one that stands there: its check fails."""


def make_set(folder: Path, index: int) -> Path:
    """Render one pair of three boards, and write down what a person would have measured."""
    rng = np.random.default_rng([7, index])
    scene = trihedral_pair(PLANES, CAMERA, PoseType.GENERAL, rng, distance=(1.3, 1.9), parallax_deg=(12.0, 30.0))
    folder.mkdir(parents=True)
    for view, image in enumerate(scene.images(optics=OPTICS, photometry=PHOTOMETRY, rng=rng), start=1):
        cv2.imwrite(str(folder / f"view{view}.png"), image)
    save_camera(folder / "camera.json", CAMERA)
    angle = 87.0 if index % WRONG_EVERY == WRONG_EVERY - 1 else 90.0
    lines = ['schema = "rigkit.dataset/1"', f'name = "set{index:03d}"']
    for board in PLANES:
        path = folder / f"{board.board_id}.toml"
        path.write_text(board_text(board, "rendered", path), encoding="utf-8")
        lines += ["[[boards]]", f'id = "{board.board_id}"', f'file = "{path.name}"']
    lines += ["[[cameras]]", 'id = "camera"', 'calibration = "camera.json"', "[[pairs]]", 'id = "pair"']
    lines += ['camera1 = "camera"', 'camera2 = "camera"', 'image1 = "view1.png"', 'image2 = "view2.png"']
    lines += ['pose_type = "general"', f"boards = {json.dumps([b.board_id for b in PLANES])}", "[pairs.truth]"]
    lines += [f'angles = [{{ a = "plane1", b = "plane2", value_deg = {angle}, sigma_deg = 0.3, how = "set square" }}]']
    (folder / "dataset.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def table_of(done: ManyValidation) -> list[tuple[Any, ...]]:
    """Return the table's cells."""
    return [tuple(cell.value for cell in row) for row in done.table.rows]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split(":")[0])
    parser.add_argument("--count", type=int, default=200, help="data sets")
    parser.add_argument("--workers", type=int, default=2, help="processes, and workers of the cluster")
    args = parser.parse_args()
    distributed = importlib.import_module("distributed")
    with tempfile.TemporaryDirectory() as work:
        root = Path(work)
        started = time.monotonic()
        sets = [make_set(root / "sets" / f"set{k:03d}", k) for k in range(args.count)]
        print(f"{args.count} data sets rendered in {time.monotonic() - started:.0f} s", flush=True)
        tables = {}
        for name in ("processes", "Dask cluster"):
            out = ValidateOptions(output=root / name, pictures=False, crosscheck=False)
            started = time.monotonic()
            if name == "processes":
                done = validate_datasets(sets, out, jobs=args.workers)
            else:
                with distributed.LocalCluster(
                    n_workers=args.workers, threads_per_worker=1, dashboard_address=None
                ) as cluster:
                    done = validate_datasets(sets, out, cluster=cluster.scheduler_address)
            tables[name] = table_of(done)
            verdicts = [outcome.code for outcome in done.outcomes]
            print(
                f"by {name}: {time.monotonic() - started:.0f} s; {verdicts.count(0)} pass, {verdicts.count(1)} fail, "
                f"{sum(code > 1 for code in verdicts)} could not be validated",
                flush=True,
            )
    same = tables["processes"] == tables["Dask cluster"]
    print("the same table" if same else "the tables DIFFER")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
