#!/usr/bin/env python3
"""Compare the baselines with OpenCV's fisheye model and Scaramuzza's model: L. Hajder's experiment.

The cameras of a data set are calibrated from the same corners with each model, and the pairs with a measured baseline
are reconstructed with each calibration. Prints a row for each pair.

Usage: python scripts/lens_models.py datasets/lab-a [--models kannala_brandt scaramuzza] [--pair fisheye-standard ...]
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from rigkit.calibration.result import Calibration
from rigkit.core.errors import RigkitError
from rigkit.io.manifests.manifest import Dataset, Pair, load_dataset
from rigkit.io.manifests.session import load_session
from rigkit.workflows.calibration.calibrate import calibration_from
from rigkit.workflows.inputs.corners import session_corners
from rigkit.workflows.reconstruction.pairs import match_images, reconstruct_with


def calibrations(dataset: Dataset, pairs: list[Pair], models: list[str]) -> dict[tuple[str, str], Calibration]:
    """Return the calibration by camera and model, each camera's from one set of corners."""
    out = {}
    for name in sorted({entry.camera_id for pair in pairs for entry in (pair.camera1, pair.camera2)}):
        path = dataset.camera(name).session
        if path is None:
            raise SystemExit(f"camera '{name}' has no session to calibrate from")
        session = load_session(path)
        corners = session_corners(session)
        for model in models:
            out[name, model] = calibration_from(replace(session, model=model, degree=None), corners)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("--models", nargs="+", default=["kannala_brandt", "scaramuzza"])
    parser.add_argument("--pair", nargs="+", default=[])
    args = parser.parse_args()
    dataset = load_dataset(args.dataset).select(args.pair)
    pairs = [pair for pair in dataset.pairs if pair.truth.baseline is not None]
    if not pairs:
        raise SystemExit("no pair with a measured baseline")
    known = calibrations(dataset, pairs, args.models)
    for (name, model), calibration in known.items():
        print(f"{name}, {model}: rms {calibration.rms_px:.4f} px")
    print("pair, measured mm, " + ", ".join(f"{model} mm" for model in args.models))
    for pair in pairs:
        assert pair.truth.baseline is not None
        cells = []
        for model in args.models:
            cameras = [known[entry.camera_id, model].camera for entry in (pair.camera1, pair.camera2)]
            try:
                matched, _, _ = match_images(pair, cameras[0], cameras[1], "raw")
                found = reconstruct_with(matched, pair, "3SDIR")
                cells.append(f"{found.baseline_mm:.3f} +- {found.baseline_sigma_mm:.3f}")
            except RigkitError as error:
                cells.append(f"({error})")
        truth = pair.truth.baseline
        print(f"{pair.pair_id}, {truth.value_mm:g} +- {truth.sigma_mm:g}, " + ", ".join(cells))


if __name__ == "__main__":
    main()
