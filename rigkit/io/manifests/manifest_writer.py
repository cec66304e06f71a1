"""Writer of a new manifest: pairs and boards found in images, and what a person states."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.io.boards.board_file import board_values
from rigkit.io.disk.toml_reader import relative_path, toml_text
from rigkit.io.manifests.manifest import DATASET_SCHEMA
from rigkit.io.media.images import IMAGE_ENDINGS, images_below

SIDES = (
    (re.compile(r"(left|_l|-l|view1|cam1|_1|-1|a)$", re.IGNORECASE), 1),
    (re.compile(r"(right|_r|-r|view2|cam2|_2|-2|b)$", re.IGNORECASE), 2),
)
"""Marks of the two images of a pair at the end of a name."""

SIDES_FIRST = (
    (re.compile(r"^left(?=[ _-]|\d)", re.IGNORECASE), 1),
    (re.compile(r"^right(?=[ _-]|\d)", re.IGNORECASE), 2),
)
"""Marks at the beginning of a name: left01, right_p0."""

SIDE_FOLDERS = (
    (re.compile(r"(left|cam(era)?[_-]?0*1)$", re.IGNORECASE), 1),
    (re.compile(r"(right|cam(era)?[_-]?0*2)$", re.IGNORECASE), 2),
)
"""Marks at the end of a folder's name; bare numbers and letters usually number pairs."""

NUMBERED = re.compile(r"(.*\D)0*(\d+)")
"""A name that ends in a number."""


SAME_PLACE_PX = 2.0
"""Largest distance between the ends of the boards in an image and in a picture of its results: what is drawn over the
corners moves them. Boards of two captures are never all so near, in both images of a pair."""


@dataclass(frozen=True, slots=True)
class ImageBoards:
    """The size of an image and of the complete boards found in it, and the (left, top, right, bottom) ends of each."""

    image: Path
    size_px: tuple[int, int]
    boards: tuple[tuple[int, int], ...]
    ends_px: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class DeclaredBoard:
    """A declared board: in a `file`, or by its keys."""

    board: Board
    file: Path | None = None

    def lines(self, root: Path) -> list[str]:
        """Return the lines of the board in a manifest in folder `root`."""
        named = ["[[boards]]", f"id = {toml_text(self.board.board_id)}"]
        if self.file is not None:
            return [*named, f"file = {toml_text(relative_path(self.file, root))}", ""]
        values = board_values(self.board)
        return [*named, *(f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in values.items()), ""]


@dataclass(frozen=True, slots=True)
class FoundPair:
    """Two images that form a pair by their names or folders."""

    name: str
    first: ImageBoards
    second: ImageBoards

    def repeats(self, other: FoundPair) -> bool:
        """Return whether both images are in deeper folders than those of `other`, or named after these and their
        folders (`detect --overlay`), and show boards only where these do: pictures of results, or copies."""
        return all(
            (
                len(mine.image.parts) > len(its.image.parts)
                or mine.image.stem == f"{its.image.parent.name}_{its.image.stem}"
            )
            and mine.size_px == its.size_px
            and all(_is_among(*board, its) for board in zip(mine.boards, mine.ends_px, strict=True))
            for mine, its in ((self.first, other.first), (self.second, other.second))
        )


def _is_among(size: tuple[int, int], ends: Sequence[float], image: ImageBoards) -> bool:
    """Return whether `image` shows the board, or a larger one, of which it lacks what was drawn over."""
    for whole, others in zip(image.boards, image.ends_px, strict=True):
        inside_px = np.multiply([1.0, 1.0, -1.0, -1.0], np.subtract(ends, others))
        larger = whole[0] * whole[1] > size[0] * size[1]
        if inside_px.min() > -SAME_PLACE_PX and (larger or inside_px.max() < SAME_PLACE_PX):
            return True
    return False


def find_images(folder: Path) -> list[Path]:
    """Return all images below `folder`, sorted; raises InputError if there are none, or a name is not UTF-8."""
    if not folder.is_dir():
        raise InputError(f"init: '{folder}' is not a folder; give the folder that holds the images")
    images = images_below(folder)
    if not images:
        raise InputError(f"init: no images ({', '.join(IMAGE_ENDINGS)}) under '{folder}'")
    undecodable = [path for path in images if path.name != path.name.encode("utf-8", "ignore").decode()]
    if undecodable:
        raise InputError(
            f"init: the name of image '{undecodable[0]}' is not UTF-8, which a manifest cannot hold; rename the file"
        )
    return images


def image_boards(image: Path, size_px: tuple[int, int], detections: Sequence[BoardDetection]) -> ImageBoards:
    """Return what `detections` show: sizes (larger, smaller), the largest first, of boards that are complete or
    identified, and where they end."""
    found = [
        (
            (max(d.columns, d.rows), min(d.columns, d.rows)),
            (*d.pixels.min(axis=0).tolist(), *d.pixels.max(axis=0).tolist()),
        )
        for d in detections
        if d.complete or d.board_id is not None
    ]
    found.sort(reverse=True)
    return ImageBoards(image, size_px, tuple(size for size, _ in found), tuple(ends for _, ends in found))


def group_pairs(shown: Sequence[ImageBoards], root: Path) -> list[FoundPair]:
    """Return the pairs, sorted by name; images without a board are ignored.

    Pairs are images whose names differ in the mark of the side only, images of the same name in two marked folders,
    NAME1 and NAME2 if there are no other numbers, or the only two images of a folder.
    """
    free = [s for s in shown if s.boards]
    pairs: list[FoundPair] = []
    for marks in (SIDES_FIRST, SIDES, SIDE_FOLDERS):
        sides: dict[tuple[Path, str], dict[int, ImageBoards]] = {}
        for one in free:
            found = _by_folder(one.image, root) if marks is SIDE_FOLDERS else _by_name(one.image, marks)
            if found is not None:
                place, side = found
                sides.setdefault(place, {})[side] = one
        pairs += [FoundPair(_pair_name(*place, root), s[1], s[2]) for place, s in sides.items() if len(s) == 2]
        taken = {s.image for pair in pairs for s in (pair.first, pair.second)}
        free = [s for s in free if s.image not in taken]
    of_name: dict[tuple[Path, str], dict[int, ImageBoards]] = {}
    for one in free:
        numbered = NUMBERED.fullmatch(one.image.stem)
        if numbered is not None:
            of_name.setdefault((one.image.parent, numbered[1].rstrip("_- ")), {})[int(numbered[2])] = one
    of_name = {place: own for place, own in of_name.items() if sorted(own) == [1, 2]}
    pairs += [FoundPair(_pair_name(*place, root), own[1], own[2]) for place, own in of_name.items()]
    by_folder: dict[Path, list[ImageBoards]] = {}
    for one in (s for s in free if not any(s in own.values() for own in of_name.values())):
        by_folder.setdefault(one.image.parent, []).append(one)
    for parent, two in by_folder.items():
        if len(two) == 2:
            pairs.append(FoundPair(_pair_name(parent, "", root), two[0], two[1]))
    return sorted(pairs, key=lambda pair: pair.name)


def _by_name(image: Path, marks: Sequence[tuple[re.Pattern[str], int]]) -> tuple[tuple[Path, str], int] | None:
    """Return (folder, name without the mark) and the side 1 or 2; None without a mark."""
    found = _side(image.stem, marks)
    return None if found is None else ((image.parent, found[0]), found[1])


def _by_folder(image: Path, root: Path) -> tuple[tuple[Path, str], int] | None:
    """Return the same by the name of the folder: left/0001.png."""
    parent = image.parent
    found = None if parent == root else _side(parent.name, SIDE_FOLDERS)
    return None if found is None else ((parent.parent / found[0], image.stem), found[1])


def _side(name: str, marks: Sequence[tuple[re.Pattern[str], int]]) -> tuple[str, int] | None:
    for pattern, side in marks:
        rest, count = pattern.subn("", name)
        if count:
            return rest.strip("_- "), side
    return None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class NewManifest:
    """The content of a new manifest.

    Attributes
    ----------
    name : name of the data set.
    pairs : one pair or more.
    declared : the boards, or the measured side of a square of all chessboards found, mm.
    calibrations : camera -> path of its calibration file, absolute or relative to the manifest's folder.
    cameras : pair -> cameras of its two images.
    pose_types : pair -> pose type.
    baselines : pair -> measured (mm, sigma mm).
    angles : pair -> measured (deg, sigma deg) between every two boards.
    """

    name: str
    pairs: Sequence[FoundPair]
    declared: Sequence[DeclaredBoard] | float
    calibrations: Mapping[str, str]
    cameras: Mapping[str, tuple[str, str]]
    pose_types: Mapping[str, str]
    baselines: Mapping[str, tuple[float, float]]
    angles: Mapping[str, tuple[float, float]]


def manifest_text(new: NewManifest, root: Path) -> str:
    """Return the text of the manifest in folder `root`, with what was found in images as comments."""
    pairs, declared = new.pairs, new.declared
    if not pairs:
        raise InputError(
            "init: no two images look like a pair; name them left01/right01, ...left/...right, view1/view2 or "
            "NAME1/NAME2, put them into folders named so, or each pair into a folder of its own"
        )
    out = [
        "# Started by `rigkit init`; what a person measured is for a person to check.",
        f'schema = "{DATASET_SCHEMA}"',
    ]
    most = max((s.boards for pair in pairs for s in (pair.first, pair.second)), key=len)
    out += [f"name = {toml_text(new.name)}", ""]
    if isinstance(declared, float):
        counts = ", ".join(f"{n} of {c}x{r}" for (c, r), n in Counter(most).items())
        out.append(f"# Most boards in one image: {counts}.")
        for number, (columns, rows) in enumerate(most, start=1):
            out += ["[[boards]]", f'id = "plane{number}"', f"columns = {columns}", f"rows = {rows}"]
            out += [f"square_mm = {declared:g}", ""]
        ids = [f"plane{number}" for number in range(1, len(most) + 1)]
    else:
        declared = with_copies(declared, most)
        out += [line for board in declared for line in board.lines(root)]
        ids = [board.board.board_id for board in declared]
    size = pairs[0].first.size_px
    out.append(f"# Images are {size[0]}x{size[1]} px.")
    if len(new.calibrations) == 1:
        out += ["# All taken as those of one camera that was moved. Where there are two, add another [[cameras]]"]
        out += ["# with its own calibration, and name it in camera2 below."]
    for camera, calibration in new.calibrations.items():
        out += ["[[cameras]]", f"id = {toml_text(camera)}", f"calibration = {toml_text(calibration)}", ""]
    alone = next((name for name in new.angles if len(ids) < 2), None)
    if alone is not None:
        raise InputError(f"init: --angle-deg is between two boards, but pair '{alone}' has one; give each with --board")
    for pair in pairs:
        out += _pair_lines(pair, root, new.cameras[pair.name], new.pose_types[pair.name], ids)
        out += _truth_lines(new.baselines.get(pair.name), new.angles.get(pair.name), ids)
    return "\n".join(out)


def with_copies(declared: Sequence[DeclaredBoard], seen: Sequence[tuple[int, int]]) -> list[DeclaredBoard]:
    """Return the boards, a chessboard in words declared once followed by its copies among the sizes `seen` in an image.

    Copies of a marked board cannot be told apart; those of a board's file are a person's to name.
    """
    sizes = Counter((max(b.board.size), min(b.board.size)) for b in declared)
    out = list(declared)
    for one in declared:
        size = (max(one.board.size), min(one.board.size))
        if one.file is None and isinstance(one.board.pattern, Chessboard) and sizes[size] == 1:
            out += [one] * (Counter(seen)[size] - 1)
    return [
        one if k < len(declared) else replace(one, board=replace(one.board, board_id=f"plane{k + 1}"))
        for k, one in enumerate(out)
    ]


def _pair_lines(
    pair: FoundPair, root: Path, cameras: tuple[str, str], pose_type: str, boards: Sequence[str]
) -> list[str]:
    seen = " and ".join(_words(s) for s in (pair.first, pair.second))
    out = [f"# Complete boards found: {seen}.", "[[pairs]]", f'id = "{pair.name}"']
    out += [f"camera{i} = {toml_text(camera)}" for i, camera in enumerate(cameras, start=1)]
    out += [
        f"image{i} = {toml_text(relative_path(s.image, root))}"
        for i, s in enumerate((pair.first, pair.second), start=1)
    ]
    return [*out, f'pose_type = "{pose_type}"', f"boards = [{', '.join(map(toml_text, boards))}]", ""]


def _truth_lines(
    baseline: tuple[float, float] | None, angle: tuple[float, float] | None, boards: Sequence[str]
) -> list[str]:
    """Return the lines of a pair's measured truth; commented examples for what was not measured."""
    out = ["[pairs.truth]"]
    if baseline is not None:
        value, sigma = baseline
        out.append(f'baseline = {{ value_mm = {value:g}, sigma_mm = {sigma:g}, how = "as given to rigkit init" }}')
    else:
        out.append('# baseline = { value_mm = 300.0, sigma_mm = 2.0, how = "steel rule between tripod marks" }')
    if angle is not None and len(boards) > 1:
        tail = f'value_deg = {angle[0]:g}, sigma_deg = {angle[1]:g}, how = "as given to rigkit init"'
        rows = [f"    {{ a = {toml_text(a)}, b = {toml_text(b)}, {tail} }}," for a, b in combinations(boards, 2)]
        out += ["angles = [", *rows, "]"]
    else:
        out.append(
            '# angles = [ { a = "plane1", b = "plane2", value_deg = 90.0, sigma_deg = 0.3, how = "set square" } ]'
        )
    return [*out, ""]


def _pair_name(parent: Path, stem: str, root: Path) -> str:
    parts = [part for part in parent.relative_to(root).parts if part not in ("images", ".")]
    words = "-".join([*parts, stem] if stem else parts) or "pair"
    return re.sub(r"[^A-Za-z0-9_-]+", "-", words)


def _words(found: ImageBoards) -> str:
    return ", ".join(f"{columns}x{rows}" for columns, rows in found.boards)
