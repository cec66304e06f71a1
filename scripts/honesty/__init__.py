"""Laboratories and small sessions of `measure_honesty.py`, with scenes of the tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
