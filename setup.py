"""Builds the library of rigkit.kernels into a wheel for any Python 3; everything else is in pyproject.toml."""

from __future__ import annotations

import runpy
import shutil
import sys
from itertools import chain
from multiprocessing.pool import ThreadPool
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

FOLDER = Path("rigkit/kernels")
BUILDING = runpy.run_path(str(FOLDER / "building.py"))
LIBRARY = BUILDING["library_name"]()


class build_kernels(build_ext):
    """One library that knows nothing of Python, and beside it the record that rigkit checks before it loads it."""

    def get_ext_filename(self, fullname: str) -> str:
        return str(Path(*fullname.split(".")).with_name(LIBRARY))

    def get_libraries(self, ext: Extension) -> list[str]:
        return ext.libraries

    def get_export_symbols(self, ext: Extension) -> list[str]:
        # The C files say what they export.
        return []

    def build_extension(self, ext: Extension) -> None:
        library = Path(self.get_ext_fullpath(ext.name))
        library.parent.mkdir(parents=True, exist_ok=True)
        if sys.platform == "win32":
            # Visual C++ lacks the vector extensions; this compiler comes with pip (pyproject.toml).
            zig = [sys.executable, "-m", "ziglang", "cc", "-target", "x86_64-windows-gnu", "-fno-sanitize=undefined"]
            self.spawn([*zig, *BUILDING["FLAGS"], "-s", "-shared", *ext.sources, "-o", str(library)])
            BUILDING["remove_import_library"](library)
            compiler = "ziglang"
        else:
            ext.extra_objects, ext.sources = self._objects(ext), []
            # A library older than these is linked again.
            ext.depends = ext.extra_objects
            super().build_extension(ext)
            compiler = " ".join(self.compiler.compiler_so[:1])
        BUILDING["write_record"](library, FOLDER, compiler)

    def _objects(self, ext: Extension) -> list[str]:
        """Compile side by side the sources that are newer than their objects; setuptools takes one after another."""
        headers = max(Path(header).stat().st_mtime for header in [*ext.depends, FOLDER / "building.py"])

        def compiled(source: str) -> list[str]:
            names: list[str] = self.compiler.object_filenames([source], output_dir=self.build_temp)
            made = [Path(name).stat().st_mtime for name in names if Path(name).exists()]
            if made and not self.force and min(made) > max(headers, Path(source).stat().st_mtime):
                return names
            options = {"output_dir": self.build_temp, "extra_postargs": ext.extra_compile_args}
            return list(self.compiler.compile([source], **options))

        # The largest first, so that no processor waits for it at the end.
        largest_first = sorted(ext.sources, key=lambda source: -Path(source).stat().st_size)
        with ThreadPool() as pool:
            return sorted(chain.from_iterable(pool.imap_unordered(compiled, largest_first)))

    def copy_extensions_to_source(self) -> None:
        super().copy_extensions_to_source()
        for ext in self.extensions:
            record = Path(self.get_ext_fullpath(ext.name)).with_suffix(".json")
            built = Path(self.build_lib, self.get_ext_filename(self.get_ext_fullname(ext.name))).with_suffix(".json")
            if not record.exists() or built.resolve() != record.resolve():
                shutil.copyfile(built, FOLDER / record.name)

    def get_outputs(self) -> list[str]:
        outputs = super().get_outputs()
        return [*outputs, *(str(Path(name).with_suffix(".json")) for name in outputs if name.endswith(LIBRARY))]


class py3_wheel(bdist_wheel):
    """A wheel for the platform, whatever the version of Python."""

    def get_tag(self) -> tuple[str, str, str]:
        return ("py3", "none", super().get_tag()[2])


setup(
    ext_modules=[
        Extension(
            "rigkit.kernels.rigkit_kernels",
            sources=[str(path) for path in BUILDING["sources"](FOLDER)],
            depends=[str(path) for path in FOLDER.glob("*.h")],
            extra_compile_args=list(BUILDING["FLAGS"]),
            libraries=[] if sys.platform == "win32" else ["m"],
        )
    ],
    cmdclass={"build_ext": build_kernels, "bdist_wheel": py3_wheel},
)
