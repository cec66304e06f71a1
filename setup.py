"""The optional compiled kernels of rigkit.kernels, one library a C file; everything else is in pyproject.toml.

Without a C compiler the package installs and works all the same, slower.
"""

import hashlib
from pathlib import Path

from setuptools import Extension, setup

HEADER = Path("rigkit/kernels/kernels.h")


def library(source: Path) -> Extension:
    # The loader compares this with the files beside it: a library that was built from others is not used.
    digest = hashlib.sha256(source.read_bytes() + HEADER.read_bytes()).hexdigest()[:16]
    return Extension(
        f"rigkit.kernels._{source.stem}",
        sources=[str(source)],
        depends=[str(HEADER)],
        define_macros=[("RIGKIT_SOURCE", f'"{digest}"')],
        extra_compile_args=["-O3", "-std=gnu11", "-Wall", "-fno-math-errno", "-fno-trapping-math", "-fopenmp-simd"],
        optional=True,
    )


setup(ext_modules=[library(source) for source in sorted(HEADER.parent.glob("*.c"))])
