"""Files that are missing are refused at once."""

from __future__ import annotations

import subprocess
import sys


def test_missing_files_are_refused_before_the_work_is_imported() -> None:
    calls = [
        "calibrate n",
        "certify n --length 1 --distance 1",
        "check n n",
        "crosscheck n",
        "detect n",
        "diff n n",
        "export n --to ros -o o",
        "handeye n n --camera n --board n",
        "plan n",
        "pose n --camera n --board n",
        "reconstruct n",
        "reconstruct --images n n --rig n",
        "rectify n --camera n -o o",
        "validate n",
    ]
    code = (
        "import sys; from rigkit.cli.main import main\n"
        f"for words in {calls!r}:\n    assert main(words.split()) == 2, words\n"
        "    assert 'cv2' not in sys.modules, words"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("'n' does not exist") == len(calls)
