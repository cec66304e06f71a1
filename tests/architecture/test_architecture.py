"""The layers, sizes and import times that keep the package easy to work in."""

from __future__ import annotations

import ast
import functools
import gc
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "rigkit"
MODULES = sorted(PACKAGE.rglob("*.py"))
KERNELS = sorted([*PACKAGE.rglob("*.c"), *PACKAGE.rglob("*.h")])

LAYERS: tuple[tuple[str, ...], ...] = (
    ("kernels",),
    ("core", "optim"),
    ("geometry",),
    ("cameras",),
    ("rectification",),
    ("affine", "relative_pose", "calibration", "synthetic", "interop"),
    ("detection", "identification"),
    ("reconstruction", "planning"),
    ("validation", "study"),
    ("io",),
    ("report", "coach"),
    ("workflows",),
    ("cli",),
)
"""From the ground up; a part imports rows below its own; `core.arrays` and `core.errors` are for all."""
LEVEL = {name: level for level, row in enumerate(LAYERS) for name in row}

FOR_ALL = {"rigkit.core.arrays", "rigkit.core.errors"}

MAX_LINES = 400

MAX_FUNCTION_LINES = 60
MAX_VERB_LINES = 120
MAX_POSITIONAL_FIELDS = 6
"""Nobody remembers the order of more: classes of more fields take keywords."""

HEAVY_HOMES = {
    "open3d": {"interop/open3d.py"},
    "pycolmap": {"interop/colmap.py"},
}
NEVER_AT_IMPORT = ("open3d", "pycolmap", "matplotlib", "scipy.optimize", "cv2", "numpy")


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports_of(statements: Iterable[ast.AST]) -> list[str]:
    found = []
    for node in statements:
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append(node.module)
    return found


def names_in(tree: ast.AST) -> set[str]:
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def module_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def import_graph() -> dict[str, set[str]]:
    """Which modules of rigkit each module imports, wherever in it the import stands."""
    known = {module_of(path) for path in MODULES}
    graph: dict[str, set[str]] = {}
    for path in MODULES:
        wanted: set[str] = set()
        for node in statements_of(path):
            if isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names} & known
                wanted |= inner or {node.module}
            elif isinstance(node, ast.Import):
                wanted |= {alias.name for alias in node.names}
        graph[module_of(path)] = (wanted & known) - {module_of(path), "rigkit"}
    return graph


def circles(graph: Mapping[str, Iterable[str]]) -> list[str]:
    """Return the nodes on a circle: what is left when nodes that need nothing that is left are taken away."""
    left = {node: set(targets) for node, targets in graph.items()}
    while True:
        leaves = {node for node, targets in left.items() if not targets & set(left)}
        if not leaves:
            return sorted(left)
        left = {node: targets for node, targets in left.items() if node not in leaves}


def test_a_module_imports_only_rows_below() -> None:
    wrong = []
    for path in MODULES:
        own = part_of(path)
        if own in {"__init__", "__main__"}:
            continue
        assert own in LEVEL, f"{own} is in no layer"
        for name in import_graph()[module_of(path)] - FOR_ALL:
            other = name.split(".")[1]
            if other != own and LEVEL[other] >= LEVEL[own]:
                wrong.append(f"{path.relative_to(PACKAGE)} imports {name}, which is not below it")
    assert not wrong


def test_the_layers_are_those_of_the_docstring() -> None:
    import rigkit

    rows = re.findall(r"^ {4}([ \d]\d)  (\w+(?: \| \w+)*)", rigkit.__doc__ or "", re.MULTILINE)
    reported = {int(level): set(names.split(" | ")) for level, names in rows}
    assert reported == {level: set(row) for level, row in enumerate(LAYERS)}
    assert set(LEVEL) == {path.parent.name for path in PACKAGE.glob("*/__init__.py")}


def test_no_module_is_part_of_a_circle() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["a", "b", "c"]
    assert circles(import_graph()) == []


def room_of(module: str) -> str:
    """The folder of a module that lies in a folder of a part, else the module itself."""
    return ".".join(module.split(".")[:3])


def test_no_folder_is_part_of_a_circle() -> None:
    """Also the folders inside a part: what stands beside them counts as a folder of its own."""
    for part in sorted({module.split(".")[1] for module in import_graph() if "." in module}):
        graph: dict[str, set[str]] = {}
        for module, targets in import_graph().items():
            if module.startswith(f"rigkit.{part}."):
                own = room_of(module)
                graph.setdefault(own, set()).update(
                    room_of(target) for target in targets if target.startswith(f"rigkit.{part}.")
                )
                graph[own].discard(own)
        assert circles(graph) == [], part


def test_one_camera_knows_nothing_of_rigs() -> None:
    """The package inside `calibration` builds on what lies beside it, not the other way round."""
    for path in (PACKAGE / "calibration").rglob("*.py"):
        if "rig" in path.relative_to(PACKAGE).parts:
            continue
        above = [name for name in imports_of(statements_of(path)) if name.startswith("rigkit.calibration.rig")]
        assert not above, f"{path.relative_to(PACKAGE)} imports {above}"


def test_module_size() -> None:
    beside = [path for folder in ("tests", "scripts") for path in (PACKAGE.parent / folder).rglob("*.py")]
    paths = [*MODULES, *KERNELS, *beside]
    lines = {str(path.relative_to(PACKAGE.parent)): len(path.read_text().splitlines()) for path in paths}
    assert not {name: n for name, n in lines.items() if n > MAX_LINES}, "split them"


def test_a_verb_is_a_page() -> None:
    """What it takes, one call of a workflow, what it prints; longer ones do work that belongs below."""
    from rigkit.cli.main import VERBS

    lines = {verb: len((PACKAGE / f"cli/{verb}.py").read_text().splitlines()) for verb in VERBS}
    assert not {verb: n for verb, n in lines.items() if n > MAX_VERB_LINES}


def test_every_folder_has_a_docstring() -> None:
    """And calibration lists modules that there are, in the order of the work."""
    rooms = [path for path in MODULES if path.name == "__init__.py"]
    assert not [path for path in rooms if not ast.get_docstring(tree_of(path))]
    calibration = PACKAGE / "calibration"
    listed = set(re.findall(r"`(\w+)(?:\.py)?`", ast.get_docstring(tree_of(calibration / "__init__.py")) or ""))
    there = {path.stem if path.name != "__init__.py" else path.parent.name for path in calibration.rglob("*.py")}
    assert listed <= there


def place_of(path: Path, name: str) -> str:
    return f"{path.relative_to(PACKAGE).as_posix()}:{name}"


@functools.cache
def tree_of(path: Path) -> ast.Module:
    # Trees hold no circles, and are kept: to look for some, now or later, takes two thirds of the time.
    gc.disable()
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    finally:
        gc.freeze()
        gc.enable()


@functools.cache
def statements_of(path: Path) -> tuple[ast.AST, ...]:
    """Return a module and the statements in it, also those inside others; expressions are most of a tree's nodes."""
    found: list[ast.AST] = [tree_of(path)]
    for node in found:
        for part in ("body", "handlers", "orelse", "finalbody", "cases"):
            found += getattr(node, part, ())
    return tuple(found)


def test_function_size() -> None:
    long = {
        place_of(path, node.name)
        for path in MODULES
        for node in statements_of(path)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and (node.end_lineno or node.lineno) - node.lineno >= MAX_FUNCTION_LINES
    }
    assert not long, f"more than {MAX_FUNCTION_LINES} lines: {sorted(long)}"


def c_functions(text: str) -> dict[str, int]:
    """How many lines each function of a C file has, from its name to the brace that closes it."""
    return {
        found.group("name"): found.group().count("\n") + 1
        for found in re.finditer(
            r"^(?:[A-Za-z_][\w ]*[ *])(?P<name>\w+)\([^;{}]*\)\n?\s*\{\n.*?^\}$", text, re.MULTILINE | re.DOTALL
        )
    }


def test_function_size_of_kernels() -> None:
    assert c_functions("INLINE int one(\n    int a)\n{\n    return a;\n}\n") == {"one": 5}
    found = {path.name: c_functions(path.read_text(encoding="utf-8")) for path in KERNELS}
    assert sum(map(len, found.values())) > 200, "functions are not seen"
    long = {
        (name, function) for name, sizes in found.items() for function, n in sizes.items() if n > MAX_FUNCTION_LINES
    }
    assert not long, f"more than {MAX_FUNCTION_LINES} lines: {sorted(long)}"


def test_classes_of_many_fields_take_keywords() -> None:
    positional = set()
    for path in MODULES:
        for node in statements_of(path):
            decorator = next((d for d in getattr(node, "decorator_list", ()) if "dataclass" in ast.unparse(d)), None)
            if not isinstance(node, ast.ClassDef) or decorator is None or "kw_only=True" in ast.unparse(decorator):
                continue
            fields = [ast.unparse(n) for n in node.body if isinstance(n, ast.AnnAssign)]
            fields = fields[: fields.index("_: KW_ONLY")] if "_: KW_ONLY" in fields else fields
            if sum("ClassVar" not in field for field in fields) > MAX_POSITIONAL_FIELDS:
                positional.add(place_of(path, node.name))
    assert not positional, f"need kw_only=True: {sorted(positional)}"


def test_what_begins_with_an_underscore_stays_in_its_module() -> None:
    """The underscore says which names are a module's own; all others may be imported."""
    taken = []
    for path in MODULES:
        for node in statements_of(path):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rigkit."):
                taken += [place_of(path, alias.name) for alias in node.names if alias.name.startswith("_")]
    assert not taken


def test_a_fault_of_the_installation_is_never_taken_for_a_fault_of_the_data() -> None:
    """Who drops an error names those of data: stale kernels are not "no board is seen"."""
    of_rigkit = {"RigkitError", "InstallationError", "InternalError"}
    dropped = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in MODULES
        for node in statements_of(path)
        if isinstance(node, ast.ExceptHandler)
        and node.name is None
        and node.type is not None
        and of_rigkit & names_in(node.type)
    ]
    assert not dropped, f"name the errors of data (InputError, DegenerateError): {dropped}"


def test_a_class_name_means_one_thing() -> None:
    homes: dict[str, list[str]] = {}
    for path in MODULES:
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(place_of(path, node.name))
    several = {name: places for name, places in homes.items() if len(places) > 1}
    assert not several, several


def assigned(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield (name, value as written) of what a module assigns, also several at once: A, B = 1, 2."""
    for node in tree.body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                pairs = [(target, node.value)]
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = list(zip(target.elts, node.value.elts, strict=True))
                yield from ((name.id, ast.unparse(value)) for name, value in pairs if isinstance(name, ast.Name))


def test_a_constant_has_one_value() -> None:
    assert dict(assigned(ast.parse("A, B = 1, 2\nC: int = 3"))) == {"A": "1", "B": "2", "C": "3"}
    values: dict[str, dict[str, str]] = {}
    for path in MODULES:
        for name, value in assigned(tree_of(path)):
            if name.isupper() and not name.startswith("_"):
                values.setdefault(name, {})[place_of(path, name)] = value
    several = {n: known for n, known in values.items() if len(set(known.values())) > 1}
    assert not several, several


def test_heavy_packages_stay_in_their_homes() -> None:
    for path in MODULES:
        relative = path.relative_to(PACKAGE).as_posix()
        for name in imports_of(statements_of(path)):
            root = name.split(".")[0]
            if root in HEAVY_HOMES:
                assert relative in HEAVY_HOMES[root], f"{relative} imports {root}"
        # Even there only inside the functions that need them.
        for name in imports_of(tree_of(path).body):
            heavy = name.split(".")[0] in (*HEAVY_HOMES, "matplotlib")
            assert not heavy, f"{relative} imports {name} at module level"


def test_nothing_refers_to_a_workplace() -> None:
    for path in MODULES:
        assert "/work/" not in path.read_text(), path


@pytest.mark.parametrize(("option", "shown"), [("--help", "VERB"), ("--version", "kernels")])
def test_help_and_version_import_nothing_heavy(option: str, shown: str) -> None:
    code = (
        "import sys; from rigkit.cli.main import main\n"
        f"try: main([{option!r}])\nexcept SystemExit: pass\n"
        f"print([m for m in {NEVER_AT_IMPORT!r} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    assert shown in done.stdout


def test_verbs_begin_without_scipy() -> None:
    """It takes a quarter of a second, and most sessions have no use for it."""
    verbs = ("calibration.calibrate_any", "detect", "reconstruction.reconstruct_scene", "validation.validate")
    paths = {module_of(path): path for path in MODULES}
    loaded = [f"rigkit.workflows.{verb}" for verb in verbs]
    for name in loaded:
        imported = set(imported_first(tree_of(paths[name]).body))
        assert not any(other.startswith("scipy") for other in imported), name
        loaded += sorted((imported & paths.keys()).difference(loaded))
    assert len(loaded) > 200


def imported_first(body: Sequence[ast.stmt]) -> Iterator[str]:
    """Yield what a module imports when it is imported itself, as `package.name` too where that may be a module."""
    for node in body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" not in names_in(node.test):
            yield from imported_first([*node.body, *node.orelse])
        elif isinstance(node, (ast.Try, ast.With, ast.ClassDef)):
            yield from imported_first(node.body)


def test_public_names_exist() -> None:
    import rigkit

    assert rigkit.__all__
    for name in rigkit.__all__:
        assert getattr(rigkit, name) is not None


def test_every_script_is_listed() -> None:
    """In the page that says which script answers which question; parts of scripts lie in folders."""
    folder = PACKAGE.parent / "scripts"
    page = (folder / "README.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"`(\w+\.py)", page))
    assert listed - {"__init__.py"} == {path.name for path in folder.glob("*.py")}
    for part in folder.glob("*/__init__.py"):
        named = re.findall(r"`(\w+\.py)`", ast.get_docstring(tree_of(part)) or "")
        assert all((folder / name).is_file() for name in named), part
