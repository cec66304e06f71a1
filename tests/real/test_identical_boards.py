"""Three identical, symmetric boards in RENDERED images: never identified wrongly.

`scripts/benchmark_detection.py --parts pairs` does the same for 200 pairs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detection_bench.pairs import EQUAL_BOARDS, PairVerdict, equal_boards_pair, evaluate_pair
from detection_bench.scenes import BENCH_PHOTOMETRY, bench_field_deg

from rigkit.detection.detect import detect_boards
from rigkit.identification.identify import identify_pair
from rigkit.synthetic.render import Optics

BATCH = 10
RESIDUAL_PX = 0.03
"""Rms of the rigid scene, 2-D: corners are good to about 0.01 px at blur 0.7 and noise 2."""


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 40, BATCH))
@pytest.mark.parametrize("noise_levels", [2.0, 8.0])
def test_rendered_pairs(first: int, noise_levels: float) -> None:
    for seed in range(first, first + BATCH):
        what, scene = equal_boards_pair(seed)
        images = scene.images(
            optics=Optics(0.7, field_deg=bench_field_deg(what.split(",")[0])),
            photometry=replace(BENCH_PHOTOMETRY, noise_levels=noise_levels),
            rng=np.random.default_rng(seed),
        )
        one, two = map(detect_boards, images)
        found = identify_pair(one, two, EQUAL_BOARDS, scene.camera1, scene.camera2)
        verdict = evaluate_pair(scene, found.pairs(), found.ambiguous)
        assert verdict != PairVerdict.WRONG, f"seed {seed}: {what}"
        symmetric = "symmetric" in what
        if verdict == PairVerdict.RIGHT and not symmetric:
            assert found.residual_px < RESIDUAL_PX * noise_levels / 2.0
        # An answer of "cannot tell" is timid but where boards can be exchanged, and due where they exactly can.
        if " 0 mm" in what:
            assert verdict == PairVerdict.AMBIGUOUS
        elif not symmetric:
            assert verdict == PairVerdict.RIGHT, f"seed {seed}: {what}"
