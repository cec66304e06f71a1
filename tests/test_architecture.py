"""The layers, sizes and import times that keep the package easy to work in."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "rigkit"
MODULES = sorted(PACKAGE.rglob("*.py"))

LAYERS: tuple[tuple[str, ...], ...] = (
    ("errors", "arrays", "native"),
    ("geometry", "boards", "detections", "matches", "cloud", "posetype", "processes", "progress", "truth"),
    ("cameras",),
    ("corners", "affine", "fundamental", "calibration", "synthetic", "interop"),
    ("reconstruct", "pairing", "scene"),
    ("validation",),
    ("io",),
    ("report",),
    ("cli",),
)
LEVEL = {name: level for level, row in enumerate(LAYERS) for name in row}

CONTRACTS_FROM_ABOVE = {("matches", "cameras")}
"""`Matches.from_cameras` needs the camera protocol (cameras.base), nothing else of that layer."""

SAME_ROW_MAY_IMPORT = {0, 1, 4}
"""Rows of single modules; the packages of row 3 must not know each other."""

MAX_LINES = 400

HEAVY_HOMES = {
    "open3d": {"interop/open3d.py"},
    "pycolmap": {"interop/colmap.py"},
}
NEVER_AT_IMPORT = ("open3d", "pycolmap", "matplotlib", "scipy.optimize", "cv2", "numpy")


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports_of(tree: ast.AST) -> list[str]:
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append(node.module)
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_module_imports_only_rows_below(path: Path) -> None:
    own = part_of(path)
    if own == "__init__":
        return
    assert own in LEVEL, f"{own} is in no layer"
    for name in imports_of(ast.parse(path.read_text())):
        parts = name.split(".")
        if parts[0] != "rigkit" or len(parts) < 2 or parts[1] == own:
            continue
        other = parts[1]
        if (own, other) in CONTRACTS_FROM_ABOVE:
            continue
        lower = LEVEL[other] < LEVEL[own]
        same = LEVEL[other] == LEVEL[own] and LEVEL[own] in SAME_ROW_MAY_IMPORT
        assert lower or same, f"{path.relative_to(PACKAGE)} imports {name}, which is not below it"


def test_one_camera_knows_nothing_of_rigs() -> None:
    """The package inside `calibration` builds on what lies beside it, not the other way round."""
    for path in (PACKAGE / "calibration").glob("*.py"):
        above = [name for name in imports_of(ast.parse(path.read_text())) if name.startswith("rigkit.calibration.rig")]
        assert not above, f"{path.relative_to(PACKAGE)} imports {above}"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_module_size(path: Path) -> None:
    lines = len(path.read_text().splitlines())
    assert lines <= MAX_LINES, f"{path.relative_to(PACKAGE)} has {lines} lines: split it"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_heavy_packages_stay_in_their_homes(path: Path) -> None:
    relative = path.relative_to(PACKAGE).as_posix()
    tree = ast.parse(path.read_text())
    for name in imports_of(tree):
        root = name.split(".")[0]
        if root in HEAVY_HOMES:
            assert relative in HEAVY_HOMES[root], f"{relative} imports {root}"
    # Even there only inside the functions that need them.
    for node in tree.body:
        for name in imports_of(node) if isinstance(node, (ast.Import, ast.ImportFrom)) else []:
            assert name.split(".")[0] not in (*HEAVY_HOMES, "matplotlib"), f"{relative} imports {name} at module level"


def test_nothing_refers_to_a_workplace() -> None:
    for path in MODULES:
        assert "/work/" not in path.read_text(), path


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from rigkit.cli.main import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        f"print([m for m in {NEVER_AT_IMPORT!r} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    assert "VERB" in done.stdout


def test_public_names_exist() -> None:
    import rigkit

    assert rigkit.__all__
    for name in rigkit.__all__:
        assert getattr(rigkit, name) is not None
