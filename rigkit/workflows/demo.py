"""`rigkit demo`: renders a capture with known truth, calibrates it and validates it."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigkit.core.errors import InputError
from rigkit.core.processes import process_count
from rigkit.core.progress import Progress, silent
from rigkit.io.disk.reading import usable_path
from rigkit.io.manifests.manifest import load_dataset
from rigkit.synthetic.demo import build_demo
from rigkit.workflows.calibration.calibrate import calibrate_session
from rigkit.workflows.options.cameras import Cache, CalibrateOptions, DemoOptions
from rigkit.workflows.options.clouds import ValidateOptions
from rigkit.workflows.validation.validate import DatasetValidation, validate_dataset

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, slots=True)
class DemoResult:
    """The validation of the demo, the folder of its results, and the exact baseline of every pair, mm."""

    validation: DatasetValidation
    output: Path
    exact_baselines_mm: Mapping[str, float]


def run_demo(options: DemoOptions | None = None, *, progress: Progress = silent) -> DemoResult:
    """Render the demo's capture, calibrate its camera and validate its pairs.

    Raises InputError if the folder is not empty or cannot be written.
    """
    options = options or DemoOptions()
    if options.seed < 0:
        raise InputError(f"demo: --seed {options.seed}: a number from 0 upwards is needed")
    process_count(options.jobs)  # an impossible number of jobs is refused before the work
    manifest = build_demo(usable_path(options.output), np.random.default_rng(options.seed), progress)
    _log.info(
        f"capture written to {options.output}: images, boards, {manifest.name}; truth.json, which rigkit does not read"
    )
    dataset = load_dataset(manifest)
    for entry in dataset.cameras:
        if entry.session is not None:
            calibrate_session(
                entry.session, CalibrateOptions(output=entry.calibration, cache=Cache.UPDATE), progress=progress
            )
    out = options.output / "out"
    validation = validate_dataset(dataset, ValidateOptions(output=out, jobs=options.jobs), progress=progress)
    truth = json.loads((options.output / "truth.json").read_text(encoding="utf-8"))
    exact = {name: float(pair["baseline_mm"]) for name, pair in truth["pairs"].items()}
    return DemoResult(validation, out, exact)
