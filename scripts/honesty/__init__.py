"""The small sessions of `measure_honesty.py`, of scenes that the tests have, too."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
