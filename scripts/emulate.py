"""Run the tests of the kernels with the library of another system: Windows' under wine, aarch64's under qemu.

    pip install ziglang; apt-get install wine64 wine qemu-user libc6-arm64-cross
    python scripts/emulate.py windows-x86_64|linux-aarch64 [PYTEST_ARGUMENT...]       (default: tests/kernels)

Python and the tests run on this system; a small program of the other system loads the library and makes every call
(`emulation/`). Exit code: that of pytest.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from cross_compile import cross_compile
from emulation.host import compile_host
from emulation.remote import COMMAND

from rigkit.kernels.declarations import header

ROOT = Path(__file__).resolve().parents[1]

EMULATORS = {"windows-x86_64": ["wine"], "linux-aarch64": ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"]}


def main(arguments: Sequence[str]) -> int:
    """Compile library and program, say what runs them, and run pytest."""
    target, *rest = arguments or ["nothing"]
    if target not in EMULATORS:
        raise SystemExit(f"which system: {' or '.join(EMULATORS)}?")
    emulator = EMULATORS[target]
    if shutil.which(emulator[0]) is None:
        raise SystemExit(f"{emulator[0]} is missing; the head of this file says what to install")
    with tempfile.TemporaryDirectory(prefix="emulate-") as name:
        folder = Path(name)
        library = cross_compile(target, folder)
        program = compile_host(header(), target, folder)
        surroundings = os.environ | {"WINEDEBUG": "-all"}
        surroundings[COMMAND] = shlex.join([*emulator, str(program), str(library), str(folder / "shared")])
        surroundings["PYTHONPATH"] = os.pathsep.join(
            [str(ROOT), str(ROOT / "scripts"), os.environ.get("PYTHONPATH", "")]
        )
        print(f"{target}:", flush=True)
        paths = [] if any(word.startswith("tests") for word in rest) else ["tests/kernels"]
        command = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "emulation.remote", *paths, *rest]
        return subprocess.run([sys.executable, *command], cwd=ROOT, env=surroundings).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
