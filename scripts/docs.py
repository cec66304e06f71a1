"""Build the documentation's site: pictures and the list of the API first, then mkdocs with strict links, into out/site.

pip install -e '.[docs]'
python scripts/docs.py [--serve]
"""

from __future__ import annotations

import argparse
import ast
import itertools
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import round_trips

import rigkit
from rigkit.cameras.pinhole import Pinhole
from rigkit.cli.main import VERBS
from rigkit.geometry.rotation import exp_so3
from rigkit.geometry.sampson import epipolar_normals
from rigkit.io.schema import SCHEMAS, key_rows, schema_text
from rigkit.report.pages.calibration_drawings import uncertainty_svg

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / "docs" / "pages"
MADE = PAGES / "made"

ARROW = """<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">
<path d="M0 0L8 4L0 8z"/></marker></defs>"""
FRAMES = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 740 240" font-family="sans-serif" font-size="14">
<style>text { paint-order: stroke; stroke: #fff; stroke-width: 4px }</style><rect width="740" height="240" fill="#fff"/>
ARROW
<g stroke="#333" fill="none"><path d="M110 120L40 70V170zM110 120L40 70M110 120L40 170"/></g>
<g stroke="#000" stroke-width="2" marker-end="url(#tip)"><path d="M110 120H230"/><path d="M110 120V215"/>
<path d="M110 120L165 85"/></g>
<g><text x="236" y="125">z, forward</text><text x="118" y="228">y, down</text>
<text x="170" y="82">x, to the right</text>
<text x="30" y="40">camera</text><text x="392" y="30">board, as seen: z goes away from the camera</text></g>
<g stroke="#888" fill="none">BOARD</g>
<g stroke="#000" stroke-width="2" marker-end="url(#tip)"><path d="M430 80H590"/><path d="M430 80V200"/></g>
<text x="596" y="85">x</text><text x="426" y="218">y</text><circle cx="430" cy="80" r="4"/>
<text x="384" y="60">corner (0, 0)</text></svg>
"""


PIXELS = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 740 200" font-family="sans-serif" font-size="14">
<style>text { paint-order: stroke; stroke: #fff; stroke-width: 4px }</style><rect width="740" height="200" fill="#fff"/>
<g stroke="#888" fill="none">GRID</g>
<circle cx="80" cy="70" r="4"/><text x="92" y="66">(0, 0): the centre of the first pixel</text>
<circle cx="50" cy="40" r="4" fill="#b3261e"/>
<text x="62" y="30" fill="#b3261e">(-0.5, -0.5): the corner of the image</text>
<text x="400" y="70">OpenCV, Kalibr, ROS, mrcal: the same</text>
<text x="400" y="100">COLMAP: 0.5 more, (0, 0) is the corner</text>
<text x="400" y="130">MATLAB: 1 more, (1, 1) is the centre</text></svg>
"""
POSES = (
    ("general", "M100 90l-26 40h52z", "M180 60l-44 18l30 34z"),
    ("planar", "M100 90l-26 40h52z", "M178 84l-40 26l46 22z"),
    ("standard", "M100 90l-26 40h52z", "M190 90l-26 40h52z"),
    ("forward", "M100 100l-26 40h52z", "M100 50l-26 40h52z"),
)
"""Name, and two cameras from above that look downwards in the drawing."""


def poses_svg() -> str:
    """Draw how two cameras may stand, from above."""
    out = ['<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 880 180" font-family="sans-serif" font-size="14">']
    out.append('<rect width="880" height="180" fill="#fff"/>')
    for k, (name, first, second) in enumerate(POSES):
        out.append(f'<g transform="translate({220 * k} 0)"><path d="{first}" fill="none" stroke="#1f4e8c"/>')
        out.append(
            f'<path d="{second}" fill="none" stroke="#b3261e"/><text x="60" y="170">{name}, from above</text></g>'
        )
    return "".join([*out, "</svg>\n"])


def two_views_svg() -> str:
    """Draw a board in two views: a corner with the normals of its epipolar lines, and the board's edges as directions,
    the second ones as A21 maps the first."""
    board = rigkit.Board("board", 6, 4, 40.0, 40.0)
    lens = Pinhole((360, 260), np.array([330.0, 330.0, 179.5, 129.5]))
    turn = exp_so3(np.array([0.35, 0.45, 0.1]))
    cam1_from_board = rigkit.Rigid3(turn, np.array([0.0, 0.0, 420.0]) - turn @ np.array([100.0, 60.0, 0.0]))
    cam2_from_cam1 = rigkit.Rigid3(exp_so3(np.array([-0.1, 0.35, 0.05])), [-150.0, 15.0, 20.0])
    lattice, at = board.points(), np.array([80.0, 40.0, 0.0])
    poses = (cam1_from_board, cam2_from_cam1 @ cam1_from_board)
    seen = [lens.project(pose.apply(lattice))[0] for pose in poses]
    q1, q2 = (lens.project(pose.apply(at[None]))[0] for pose in poses)
    rays, jacobians = zip(*((lens.unproject(q)[0], lens.ray_jacobian(q)) for q in (q1, q2)), strict=True)
    t = cam2_from_cam1.translation_mm
    E21 = np.cross(t, cam2_from_cam1.rotation, axisb=0, axisc=0)
    _, n1, n2 = epipolar_normals(E21, *rays, *jacobians)
    step = 1e-3 * np.eye(3)[:2]
    d1, d2 = (
        40.0 * 1e3 * (lens.project(pose.apply(at + step))[0] - q) for pose, q in zip(poses, (q1, q2), strict=True)
    )
    A21 = d2.T @ np.linalg.inv(d1.T)
    assert np.allclose(A21.T @ n2[0] + n1[0], 0.0, atol=1e-3 * np.linalg.norm(n1))
    out = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 760 300" font-family="sans-serif" font-size="14">'
        '<rect width="760" height="300" fill="#fff"/>' + ARROW
    ]
    names = (("q1", "n1", "d1", "image 1"), ("q2", "n2", "d2 = A21 d1", "image 2"))
    for k, (corners, q, n, d, words) in enumerate(
        zip(seen, (q1[0], q2[0]), (n1[0], n2[0]), (d1, d2), names, strict=True)
    ):
        out.append(
            f'<g transform="translate({10 + 380 * k} 10)"><rect width="360" height="260" fill="#fbfcfd" stroke="#888"/>'
        )
        out += [f'<circle cx="{u:.1f}" cy="{v:.1f}" r="2.5" fill="#1f4e8c"/>' for u, v in corners]
        normal = n / np.linalg.norm(n)
        along = np.array([-normal[1], normal[0]])
        ends = np.array([q + s * along for s in np.linspace(-400.0, 400.0, 2001)])
        inside = ends[((ends >= 0.0) & (ends <= [360.0, 260.0])).all(axis=1)]
        (a, b), (c, e) = inside[0], inside[-1]
        out.append(f'<path d="M{a:.1f} {b:.1f}L{c:.1f} {e:.1f}" stroke="#e6550d" stroke-width="1.5"/>')
        tips = [
            (q + 45.0 * normal, words[1], "#e6550d"),
            (q + d[0], words[2], "#000"),
            (q + d[1], "", "#000"),
        ]
        for tip, name, colour in tips:
            out.append(
                f'<path d="M{q[0]:.1f} {q[1]:.1f}L{tip[0]:.1f} {tip[1]:.1f}" stroke="{colour}" stroke-width="2" '
                f'marker-end="url(#tip)"/><text x="{tip[0] + 6:.1f}" y="{tip[1] + 4:.1f}">{name}</text>'
            )
        out.append(f'<text x="{q[0] + 6:.1f}" y="{q[1] - 8:.1f}">{words[0]}</text>')
        out.append(f'<text x="8" y="20">{words[3]}</text></g>')
    return "".join([*out, '<text x="10" y="292" fill="#e6550d">epipolar lines with their normals</text></svg>\n'])


def keys_page() -> str:
    """Return the page with every key of every file."""
    parts = ["# All keys\n\nMade of the definitions that `rigkit schema` prints and that readers are held against.\n"]
    for name, schema in SCHEMAS.items():
        parts.append(f'## {name}\n\n{schema["title"]}: `schema = "{schema["properties"]["schema"]["const"]}"`')
        parts.append(f"([JSON Schema](made/{name}.json)).\n\n| key | holds | |\n| :-- | :-- | :-- |")
        for key, kind, words in key_rows(schema):
            parts.append("| " + " | ".join(text.replace("|", "\\|") for text in (f"`{key}`", kind, words)) + " |")
        parts.append("")
    return "\n".join(parts)


def made_pictures() -> None:
    """Write the pictures and tables that pages show, and the schemas."""
    MADE.mkdir(exist_ok=True)
    shutil.copyfile(ROOT / "datasets" / "lab-a" / "pictures" / "cloud.jpg", MADE / "cloud.jpg")
    calibration = rigkit.load_calibration(ROOT / "calib" / "cameras" / "mvca020_r61" / "calibration.json")
    drawing, end, _ = uncertainty_svg(calibration).partition("</svg>")
    (MADE / "uncertainty.svg").write_text(drawing + end, encoding="utf-8")
    grid = "".join(f'<path d="M{50 + 60 * k} 40V160M50 {40 + 60 * k}H290"/>' for k in range(3))
    grid += '<path d="M230 40V160M290 40V160"/>'
    (MADE / "pixels.svg").write_text(PIXELS.replace("GRID", grid), encoding="utf-8")
    (MADE / "poses.svg").write_text(poses_svg(), encoding="utf-8")
    (MADE / "round-trips.md").write_text(round_trips.table(), encoding="utf-8")
    (MADE / "rig-round-trips.md").write_text(round_trips.rigs_table(), encoding="utf-8")
    (MADE / "two-views.svg").write_text(two_views_svg(), encoding="utf-8")
    for name in SCHEMAS:
        (MADE / f"{name}.json").write_text(schema_text(name), encoding="utf-8")
    squares = "".join(f'<path d="M{400 + 30 * k} 50V200M400 {50 + 30 * k}H{580}"/>' for k in range(6))
    (MADE / "frames.svg").write_text(FRAMES.replace("ARROW", ARROW).replace("BOARD", squares), encoding="utf-8")


def api_page() -> str:
    """Return the page that lists every public name with its docstring, by module."""
    parts = ["# API\n\nEvery public name of `rigkit`, by the module it comes from.\n"]
    homes = sorted((module, name) for name, module in vars(rigkit)["_homes"]().items())
    for module, names in itertools.groupby(homes, key=lambda home: home[0]):
        parts.append(f"## {module}\n")
        parts += [f"::: {module}.{name}\n" for _, name in names]
    return "\n".join(parts)


def commands_page() -> str:
    """Return the page with the help of every verb."""
    parts = ["# All commands\n\nWhat `rigkit VERB --help` prints.\n"]
    for verb in VERBS:
        command = [sys.executable, "-m", "rigkit", verb, "--help"]
        words = subprocess.run(command, env=os.environ | {"COLUMNS": "100"}, capture_output=True, text=True, check=True)
        parts.append(f"## {verb}\n\n```text\n{words.stdout}```\n")
    return "\n".join(parts)


def code_page() -> str:
    """Return the page that says of every module in a line what it is about, by room, from the top layer down."""
    layers = re.findall(r"^ {4,5}\d+ {2,}(\w.*?)(?: {2,}|$)", str(rigkit.__doc__), re.MULTILINE)
    parts = ["# Every module in a line\n\nMade of their first lines, from the command line down.\n"]
    for room in (name for row in layers for name in row.split(" | ")):
        for folder in sorted(path.parent for path in (ROOT / "rigkit" / room).rglob("__init__.py")):
            parts.append(
                f"## {folder.relative_to(ROOT / 'rigkit').as_posix()}\n\n{_first_line(folder / '__init__.py')}\n"
            )
            modules = sorted(path for path in folder.glob("*.py") if path.stem != "__init__")
            parts += [f"- `{path.stem}`: {_first_line(path)}" for path in modules]
            parts.append("")
    return "\n".join(parts)


def _first_line(path: Path) -> str:
    words = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return words.partition("\n\n")[0].replace("\n", " ")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split(":")[0])
    parser.add_argument("--serve", action="store_true", help="serve the pages on this machine instead of building them")
    args = parser.parse_args()
    made_pictures()
    (PAGES / "keys.md").write_text(keys_page(), encoding="utf-8")
    (PAGES / "commands.md").write_text(commands_page(), encoding="utf-8")
    (PAGES / "api.md").write_text(api_page(), encoding="utf-8")
    (PAGES / "code.md").write_text(code_page(), encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "serve" if args.serve else "build",
        "-f",
        str(ROOT / "docs" / "mkdocs.yml"),
    ]
    return subprocess.run(command, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
