"""Build the documentation's site: pictures and the list of the API first, then mkdocs with strict links, into out/site.

pip install -e '.[docs]'
python scripts/docs.py [--serve]
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import rigkit

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / "docs" / "pages"
MADE = PAGES / "made"

FRAMES = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 640 240" font-family="sans-serif" font-size="14">
<rect width="640" height="240" fill="#fff"/>
<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">
<path d="M0 0L8 4L0 8z"/></marker></defs>
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


def made_pictures() -> None:
    """Write the pictures that pages show."""
    MADE.mkdir(exist_ok=True)
    shutil.copyfile(ROOT / "datasets" / "lab-a" / "pictures" / "cloud.jpg", MADE / "cloud.jpg")
    squares = "".join(f'<path d="M{400 + 30 * k} 50V200M400 {50 + 30 * k}H{580}"/>' for k in range(6))
    (MADE / "frames.svg").write_text(FRAMES.replace("BOARD", squares), encoding="utf-8")


def api_page() -> str:
    """Return the page that lists every public name with its docstring, by module."""
    parts = ["# API\n\nEvery public name of `rigkit`, by the module it comes from.\n"]
    for module, names in sorted(rigkit._NAMES_OF.items()):
        parts.append(f"## {module}\n")
        parts += [f"::: {module}.{name}\n" for name in names]
    return "\n".join(parts)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split(":")[0])
    parser.add_argument("--serve", action="store_true", help="serve the pages on this machine instead of building them")
    args = parser.parse_args()
    made_pictures()
    (PAGES / "api.md").write_text(api_page(), encoding="utf-8")
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
