"""Laboratories and small sessions for `measure_honesty.py` and `split_halves.py`; their scenes are those of
`tests/helpers`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
