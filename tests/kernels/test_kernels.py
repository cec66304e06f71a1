"""The library is loaded only if complete and built from the present sources; arguments of every call are checked."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import rigkit.kernels as package
from rigkit.core.errors import InstallationError
from rigkit.kernels import kernels
from rigkit.kernels.building import library_name, mismatch
from rigkit.kernels.calls import Struct, make_struct, structure
from rigkit.kernels.declarations import header, parsed
from rigkit.kernels.front import ImageOf
from rigkit.kernels.growth import FitRules, GrowthRules
from rigkit.kernels.lattice import ScatterRules
from rigkit.kernels.patches import PATCH_COLUMNS, PatchRules
from rigkit.kernels.pose import qualities


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the library and its sources, which `kernels` looks into."""
    folder = tmp_path / "rigkit" / "kernels"
    shutil.copytree(package.FOLDER, folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(package, "FOLDER", folder)
    yield folder


def test_a_whole_library_of_these_sources_is_taken(copy: Path) -> None:
    assert mismatch(copy / library_name()) is None
    assert kernels.__wrapped__().instruction_set()


@pytest.mark.parametrize(
    ("file", "change", "printed"),
    [
        (library_name(), None, "are missing"),
        (Path(library_name()).with_suffix(".json").name, None, "no record"),
        (Path(library_name()).with_suffix(".json").name, lambda b: b"{", "no record"),
        (library_name(), lambda b: b[: len(b) // 2], "are damaged"),
        (library_name(), lambda b: b[:-1] + bytes([b[-1] ^ 1]), "are damaged"),
        ("links.c", lambda b: b + b"/* */", "are stale"),
        ("api.h", lambda b: b + b"/* */", "are stale"),
        ("pose_minimum.c", None, "are stale"),
    ],
)
def test_what_is_missing_cut_or_stale_is_refused(copy: Path, file: str, change: object, printed: str) -> None:
    path = copy / file
    before = path.read_bytes()
    path.unlink()
    if callable(change):
        path.write_bytes(change(before))
    with pytest.raises(InstallationError, match=printed) as error:
        kernels.__wrapped__()
    assert "pip install" in str(error.value)


def test_line_ends_of_another_system_are_no_change(copy: Path) -> None:
    path = copy / "links.c"
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert mismatch(copy / library_name()) is None


def test_help_needs_no_kernels() -> None:
    code = (
        "import sys, rigkit; from rigkit.cli.main import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "sys.exit(any(name.startswith('rigkit.kernels') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False).returncode == 0


def test_every_function_is_declared_once_and_there() -> None:
    declared = header().functions
    assert len(declared) > 20
    assert {name for name in declared if getattr(kernels(), name) is None} == set()
    with pytest.raises(AttributeError, match="declares no function 'grow'"):
        kernels().grow  # noqa: B018


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((18, 9), np.complex128), np.zeros((17, 9)), np.zeros((18, 9, 1))],
    ids=["dtype", "shape", "dimensions"],
)
def test_an_array_of_another_kind_is_refused(wrong: np.ndarray) -> None:
    assert qualities(np.ones((18, 9)), np.ones((2, 3, 3)), 2.0).shape == (2,)
    with pytest.raises(TypeError, match="qualities: 'packed' is"):
        qualities(wrong, np.ones((2, 3, 3)), 2.0)


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((2, 4), np.float32), np.zeros((2, 5)), np.zeros((2, 8))[:, ::2]],
    ids=["dtype", "shape", "strided"],
)
def test_what_is_written_to_must_be_as_declared(wrong: np.ndarray) -> None:
    with pytest.raises(TypeError, match="undistort_brown: 'plane' is"):
        kernels().undistort_brown(np.zeros(12), 1.0, 0, np.zeros((2, 4)), wrong)


def test_what_is_only_read_may_be_of_another_type_or_order_and_empty() -> None:
    packed = np.random.default_rng(3).integers(1, 9, (18, 9)).astype(np.float64)
    E21 = np.random.default_rng(4).normal(size=(2, 3, 3))
    wanted = qualities(packed, E21, 2.0)
    doubled = np.repeat(packed, 2, axis=1)
    others: list[np.ndarray] = [packed.astype(np.float32), packed.astype(np.int32), packed.T.copy().T, doubled[:, ::2]]
    for same in others:
        np.testing.assert_array_equal(qualities(same, E21, 2.0), wanted)
        same.flags.writeable = False
        np.testing.assert_array_equal(qualities(same, E21, 2.0), wanted)
    assert qualities(packed, np.ones((0, 3, 3)), 2.0).shape == (0,)


def test_a_structure_keeps_the_copies_that_it_points_to() -> None:
    """What is copied for a structure must live as long as that: the memory of a copy is soon another's."""
    whole = np.arange(8.0)[None, :, None].repeat(3, axis=2)
    matrices = np.zeros((1, 4, 3, 3))
    fit = {
        "offsets": np.zeros((1, 4, 2)),
        "windows": np.zeros((1, 4)),
        "reach": 1,
        "rounds": 1,
        "turn": 1.0,
        "step": 1.0,
    }
    grid = make_struct("plane_grid_t", values=whole[:, ::2], information=matrices, frames=matrices, **fit)
    others = [np.full((1, 4, 3), 7.0) for _ in range(50)]
    read = np.ctypeslib.as_array((ctypes.c_double * 12).from_address(grid.values)).reshape(1, 4, 3)
    np.testing.assert_array_equal(read, whole[:, ::2])
    assert len(others) == 50


def test_a_structure_with_a_member_of_any_name_does_not_keep_itself() -> None:
    rays = np.ones((2, 6, 3))[:, ::2]
    out, slopes = np.empty((2, 3, PATCH_COLUMNS)), np.ones((2, 3, 3, 2))
    grid = make_struct("patch_grid_t", rays1=rays, jacobians1=slopes, out=out, step=1, max_tries=1)
    assert grid._kept["out"] is out and all(kept is not grid for kept in grid._kept.values())


def test_sizes_are_read_from_arrays_and_scratch_is_made() -> None:
    rays, slopes, out = np.ones((2, 5, 3)), np.ones((2, 5, 3, 2)), np.ones((2, 5, PATCH_COLUMNS))
    grid = make_struct("patch_grid_t", rays1=rays, jacobians1=slopes, out=out, step=1, max_tries=1)
    assert (grid.rows, grid.columns) == (2, 5)
    assert (grid._kept["heap"].shape, grid._kept["heap"].dtype) == ((2, 5), np.int32)
    with pytest.raises(TypeError, match=r"qualities: 'packed' is float64 \(18,\), wants \(18, count\)"):
        kernels().qualities(np.ones(18), np.ones((2, 3, 3)), 2.0)
    with pytest.raises(TypeError, match="improve: 't' is"):
        kernels().improve(np.ones((18, 9)), np.ones((2, 3, 3)), np.ones((1, 3)), 1.0, np.arange(5), 1, 1.0)


def test_results_come_after_what_a_function_returns() -> None:
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    depth, homography = kernels().fit_perspective(square, square)
    np.testing.assert_allclose(homography, np.eye(3), atol=1e-12)
    assert depth == pytest.approx(1.0)
    done, mark = kernels().mark_known(square, square[:1], 0.5)
    assert done == 1 and mark.dtype == bool and mark.tolist() == [True, False, False, False]


def test_arguments_are_counted() -> None:
    with pytest.raises(TypeError, match="wants packed, E, noise; was given 1"):
        kernels().qualities(np.ones((18, 9)))


def test_members_are_checked() -> None:
    with pytest.raises(TypeError, match="'brightness' is float64"):
        ImageOf.of(brightness=np.zeros((4, 5)))
    with pytest.raises(TypeError, match="wants brightness; was given brightness, width"):
        ImageOf.of(brightness=np.zeros((4, 5), np.float32), width=5)


def test_the_header_is_read_as_c_reads_it() -> None:
    """Members in their order; sizes and offsets are then those of C, which ctypes follows."""
    assert [member[0] for member in FitRules._fields_] == ["degree", "radius", "leave_out", "width", "ridge"]
    assert ctypes.sizeof(FitRules) == 3 * 8 + 3 * 8
    found = parsed(
        "enum { A = 3, B = 2 * A };  /* int64_t none; */\n#define X 1\n"
        "typedef struct { double a, b[B]; ARRAY(const float, c, n / 2, B); int64_t n; } s_t;\n"
        "EXPORT void f(const s_t *s, ARRAY(void, any, s.n), double x);"
    )
    assert found.constants == {"A": 3, "B": 6}
    assert [(m.name, m.length) for m in found.structures["s_t"]] == [("a", None), ("b", 6), ("c", None), ("n", None)]
    array = found.structures["s_t"][2].array
    assert array is not None and array.shape == "(n // 2, B,)"
    assert [(p.name, p.pointer, p.array is None) for p in found.functions["f"]] == [
        ("s", True, True),
        ("any", False, False),
        ("x", False, True),
    ]
    with pytest.raises(ValueError, match="cannot read"):
        parsed("EXPORT void f(double (*x)(int64_t));")


def test_only_declared_structures_can_be_made() -> None:
    with pytest.raises(KeyError):
        structure("nothing_t")(type("Nothing", (Struct,), {}))


@pytest.mark.parametrize(
    ("kind", "member", "most"),
    [
        (ScatterRules, "last_order", 8),
        (ScatterRules, "degrees", 4),
        (FitRules, "radius", 3),
        (GrowthRules, "tried", 16),
        (PatchRules, "half", 16),
    ],
)
def test_numbers_for_which_a_kernel_has_no_room_are_refused(kind: type[Struct], member: str, most: int) -> None:
    def of(value: int) -> object:
        return (3, value) if member == "degrees" else value

    kind(**{member: of(most)})
    with pytest.raises(ValueError, match=f"'{member}' is larger than {most}"):
        kind(**{member: of(most + 1)})
