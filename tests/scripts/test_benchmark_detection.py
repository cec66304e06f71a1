"""`benchmark_detection.py`: workers answer, survive crashes of detectors, and verdicts agree with the figures."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from detection_bench.scenes import one_board
from helpers.data import REPOSITORY

from rigkit.core.boards import Board

SCRIPTS = REPOSITORY / "scripts"


@pytest.fixture
def peers(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module("detectors.peers")


def test_a_worker_answers_and_survives(peers: ModuleType, rng: np.random.Generator) -> None:
    scene = one_board(rng, size_px=(320, 240), board=Board("b", 6, 5, 30.0, 30.0))
    image = scene.render()
    worker = peers.Worker("rigkit")
    try:
        assert worker.missing == ""
        answer = worker.run(image, [(6, 5)], budget_s=0.0)
        ((pixels, grid, sigma),) = answer.boards
        assert pixels.shape == grid.shape == (30, 2)
        assert sigma.shape == (30,)
        assert answer.failed == ""
        assert answer.cpu_s > 0.0
        assert 20.0 < answer.peak_mb < 1000.0
        # A detector that crashes costs one answer, one that raises or never ends too.
        os.kill(worker._process.pid, signal.SIGKILL)
        assert "crashed" in worker.run(image, []).failed
        assert "raised" in worker.run(image[0], []).failed
        assert "more than" in worker.run(image, [], limit_s=0.0).failed
        assert len(worker.run(image, [], budget_s=0.0).boards) == 1
    finally:
        worker.close()


def test_missing_detectors_are_reported(peers: ModuleType, tmp_path: Path) -> None:
    assert "did not start" in peers.Worker("rigkit", str(tmp_path / "python")).missing
    # An interpreter without site packages has no peers.
    bare = tmp_path / "bare"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -S "$@"\n')
    bare.chmod(0o755)
    assert peers.Worker("chess-corners", str(bare)).missing
    assert {"libcbdetect", "PyCBD", "chess-corners", "calib-targets"} <= set(peers.PEERS)


def test_verdicts(peers: ModuleType) -> None:
    del peers
    benchmark = importlib.import_module("benchmark_detection")
    assert benchmark.at_most("time", 10.0, 9.5, " ms").line() == "- time: asked at most 10 ms, measured 9.5 ms: met"
    assert benchmark.at_most("time", 10.0, 10.5).line().endswith("MISSED")
    # No answer is no good answer.
    assert not benchmark.at_most("time", 10.0, float("nan")).met
    assert not benchmark.at_least("recall", 1.0, float("nan")).met
