"""A first manifest from a folder of images: what the images tell is filled in, what only a person knows is given."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigkit.detections import BoardDetection
from rigkit.errors import InputError
from rigkit.io.manifest import SCHEMA

__all__ = ["FoundPair", "Sighting", "board_sizes", "find_images", "group_pairs", "manifest_text"]

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}

SIDES = (
    (re.compile(r"(left|_l|-l|view1|cam1|_1|-1|a)$", re.IGNORECASE), 1),
    (re.compile(r"(right|_r|-r|view2|cam2|_2|-2|b)$", re.IGNORECASE), 2),
)
"""How people mark the two images of a pair at the end of a name."""


@dataclass(frozen=True, slots=True)
class Sighting:
    """What was found in one image: its size and the sizes of the complete boards."""

    image: Path
    size_px: tuple[int, int]
    boards: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class FoundPair:
    """Two images that look like a pair."""

    name: str
    first: Sighting
    second: Sighting


def find_images(folder: Path) -> list[Path]:
    """Return all images below `folder`, sorted; raises InputError where there are none."""
    if not folder.is_dir():
        raise InputError(f"init: '{folder}' is not a folder; give the folder that holds the images")
    images = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    if not images:
        raise InputError(f"init: no images ({', '.join(sorted(SUFFIXES))}) under '{folder}'")
    return images


def board_sizes(detections: Sequence[BoardDetection]) -> tuple[tuple[int, int], ...]:
    """Return the sizes of complete boards, wider than high: which way round a board hangs is not a fact about it."""
    sizes = [(max(d.columns, d.rows), min(d.columns, d.rows)) for d in detections if d.complete]
    return tuple(sorted(sizes, reverse=True))


def group_pairs(sightings: Sequence[Sighting], root: Path) -> list[FoundPair]:
    """Return the pairs: images whose names differ only in how the two sides are marked, or the two of a folder.

    Images that show no board are left out.
    """
    useful = [s for s in sightings if s.boards]
    by_stem: dict[tuple[Path, str], dict[int, Sighting]] = {}
    for sighting in useful:
        for pattern, side in SIDES:
            stem, count = pattern.subn("", sighting.image.stem)
            if count:
                by_stem.setdefault((sighting.image.parent, stem.rstrip("_- ")), {})[side] = sighting
                break
    pairs = [
        FoundPair(_pair_name(parent, stem, root), both[1], both[2])
        for (parent, stem), both in by_stem.items()
        if len(both) == 2
    ]
    taken = {s.image for pair in pairs for s in (pair.first, pair.second)}
    by_folder: dict[Path, list[Sighting]] = {}
    for sighting in useful:
        if sighting.image not in taken:
            by_folder.setdefault(sighting.image.parent, []).append(sighting)
    for parent, two in by_folder.items():
        if len(two) == 2:
            pairs.append(FoundPair(_pair_name(parent, "", root), two[0], two[1]))
    return sorted(pairs, key=lambda pair: pair.name)


def manifest_text(
    name: str,
    root: Path,
    pairs: Sequence[FoundPair],
    square_mm: float,
    calibration: str,
    pose_types: Mapping[str, str],
    baselines: Mapping[str, tuple[float, float]],
) -> str:
    """Return the manifest as text, with what was found as comments.

    Parameters
    ----------
    name : of the data set.
    root : folder of the manifest; images are named relative to it.
    pairs : at least one.
    square_mm : side of a square of all boards, as a person measured it.
    calibration : path of the calibration file, as it shall stand in the manifest.
    pose_types : pair -> pose type.
    baselines : pair -> (mm, sigma mm), where measured.
    """
    if not pairs:
        raise InputError(
            "init: no two images look like a pair; name them ...left/...right or view1/view2, or by folder"
        )
    most = max((s.boards for pair in pairs for s in (pair.first, pair.second)), key=len)
    counts = Counter(most)
    out = ["# Started by `rigkit init`; what a person measured is for a person to check.", f'schema = "{SCHEMA}"']
    out += [
        f'name = "{name}"',
        "",
        f"# Most boards in one image: {', '.join(f'{n} of {c}x{r}' for (c, r), n in counts.items())}.",
    ]
    for number, (columns, rows) in enumerate(most, start=1):
        out += ["[[boards]]", f'id = "plane{number}"', f"columns = {columns}", f"rows = {rows}"]
        out += [f"square_mm = {square_mm:g}", ""]
    size = pairs[0].first.size_px
    out += [
        f"# Images are {size[0]}x{size[1]} px.",
        "[[cameras]]",
        'id = "camera"',
        f'calibration = "{calibration}"',
        "",
    ]
    boards = ", ".join(f'"plane{n}"' for n in range(1, len(most) + 1))
    for pair in pairs:
        seen = " and ".join(_words(s) for s in (pair.first, pair.second))
        out += [f"# Complete boards found: {seen}.", "[[pairs]]", f'id = "{pair.name}"']
        out += ['camera1 = "camera"', 'camera2 = "camera"']
        out += [f'image{i} = "{_relative(s.image, root)}"' for i, s in enumerate((pair.first, pair.second), start=1)]
        out += [f'pose_type = "{pose_types[pair.name]}"', f"boards = [{boards}]", "", "[pairs.truth]"]
        if pair.name in baselines:
            value, sigma = baselines[pair.name]
            out.append(f'baseline = {{ value_mm = {value:g}, sigma_mm = {sigma:g}, how = "as told to rigkit init" }}')
        else:
            out.append('# baseline = { value_mm = 300.0, sigma_mm = 2.0, how = "steel rule between tripod marks" }')
        out.append(
            '# angles = [ { a = "plane1", b = "plane2", value_deg = 90.0, sigma_deg = 0.3, how = "set square" } ]'
        )
        out.append("")
    return "\n".join(out)


def _pair_name(parent: Path, stem: str, root: Path) -> str:
    parts = [part for part in parent.relative_to(root).parts if part not in ("images", ".")]
    words = "-".join([*parts, stem] if stem else parts) or "pair"
    return re.sub(r"[^A-Za-z0-9_-]+", "-", words)


def _words(sighting: Sighting) -> str:
    return ", ".join(f"{columns}x{rows}" for columns, rows in sighting.boards)


def _relative(path: Path, root: Path) -> str:
    import os

    return Path(os.path.relpath(path, root)).as_posix()
