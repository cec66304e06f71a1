"""The session file for folders of images of one camera, or of several on one mount."""

from __future__ import annotations

import glob
import logging
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.core.identifiers import check_identifier, natural_key
from rigkit.core.progress import Progress, silent
from rigkit.io.boards.board_file import board_text
from rigkit.io.boards.board_words import WORDS_HELP, board_in_words, board_of_words, with_length
from rigkit.io.disk.toml_reader import relative_path, toml_text
from rigkit.io.manifests.rig_session import NAME_PART
from rigkit.io.manifests.session import SESSION_NAME, SESSION_SCHEMA
from rigkit.io.media.images import (
    folder_of_images,
    further_images,
    images_below,
    images_of_folder,
    no_images,
    require_folder,
    warn_of_unread_formats,
)
from rigkit.io.media.video import is_video
from rigkit.workflows.inputs.identify_board import Suggestion, suggestion
from rigkit.workflows.inputs.layouts import CameraLayout, layouts_of
from rigkit.workflows.options.cameras import CalibrateOptions, Known

_log = logging.getLogger(__name__)

SIDE = r"left|right|cam(?:era)?[_-]?\d{1,3}"
"""Common names of a rig's cameras."""
NAMED_FIRST = re.compile(rf"(?P<side>{SIDE})(?P<gap>[_-]?)(?P<rest>\d+|(?<=[_-]).*\d)", re.IGNORECASE)
NAMED_LAST = re.compile(r"(?P<rest>.*\d)(?P<gap>[_-]?)(?P<side>left|right|(?<=[_-])[lr])", re.IGNORECASE)
NAMED_WITHIN = re.compile(
    r"(?P<before>|.*[_-])(?P<side>left|right|[lr])(?P<gap>[_-]?)(?P<rest>(?<=[lrt_-])\d+|(?<=[_-]).*\d)", re.IGNORECASE
)
"""A side behind what all images begin with, or of one letter: img_left01, img_L_01, L01."""
NAMES = (NAMED_FIRST, NAMED_LAST, NAMED_WITHIN)
MIN_IN_COMMON = 0.5
"""Fraction of the image names that another camera must have too, apart from the side. Names such as "left_tilted_1" and
"right_far_1" describe board positions before one camera."""
NUMBERED_FOLDER = re.compile(r"(.*[ _-])?image[_-]?\d\d", re.IGNORECASE)
SIDE_FOLDER = re.compile(
    rf"(.*[ _-])?({SIDE}|infra(?:red)?[_-]?\d|[lr])|{NUMBERED_FOLDER.pattern.replace('(', '(?:', 1)}", re.IGNORECASE
)
"""A camera's folder: also KITTI's image_00 and RealSense's infra1."""
ImagesByCamera = Mapping[str, Sequence[tuple[Path, str]]]
"""(folder, pattern) pairs of the images of each camera; a single camera is called ""."""


def session_of_folders(
    folders: Sequence[Path],
    boards: Sequence[str],
    path: Path,
    *,
    model: str = "auto",
    options: CalibrateOptions | None = None,
    cameras: ImagesByCamera | None = None,
    by_order: bool = False,
    progress: Progress = silent,
) -> dict[Path, str]:
    """Return the session file `path` of one folder of images, or of one folder for each camera, and its board files.

    Raises InputError: no board, a folder without images, or names that a session cannot hold.

    Parameters
    ----------
    folders : folders of images; see `cameras_in`.
    boards : board files, or words such as 9x6x25: see `rigkit.io.boards.board_words`.
    path : session file; the paths in it are relative to its folder.
    model : camera model of all cameras.
    options : their file of the calibration (None: named after the session), known lenses and rig are used.
    cameras : the images of each camera; by default those of `cameras_in`.
    by_order : images are of one moment by their order, not by their names.
    progress : of the search for the board that images show, to say what is missing.
    """
    if not boards:
        raise InputError(_missing_board_message(folders, progress))
    cameras, options = cameras or cameras_in(folders), options or CalibrateOptions()
    for folder in dict.fromkeys(folder for own in cameras.values() for folder, _ in own):
        warn_of_unread_formats(folder)
    place = path.parent
    files: dict[Path, str] = {}
    names = [_board_file(words, place, files) for words in boards]
    named = "" if options.output is None else f" -o {options.output.name}"
    shown = " ".join(["rigkit calibrate", *map(str, folders), *(f"--board {words}" for words in boards)])
    lines = [
        "# " + " ".join(f"Written by {shown}".split()),
        f"# Calibrate again with: rigkit calibrate {path.name}{named} --force",
        f'schema = "{SESSION_SCHEMA}"',
        "",
        "# The board in the images; a rule over many of its squares tells their true size.",
        f"board = {toml_text(names[0])}" if len(names) == 1 else f"boards = [{', '.join(map(toml_text, names))}]",
        "",
        '# A camera model, or "auto": the one that predicts images best that it was not fitted to.',
        f"model = {toml_text(model)}",
        "",
        "# Images, relative to this file: names, or patterns such as *.jpg.",
    ]
    if len(cameras) == 1:
        lines.append(f"images = {_patterns_toml(cameras[''], place)}")
    else:
        lines += _cameras_in_words(cameras, place, options.known, by_order=by_order)
    return files | {path: "\n".join(lines).rstrip() + "\n"}


def _cameras_in_words(cameras: ImagesByCamera, place: Path, known: Known, *, by_order: bool) -> list[str]:
    """Return the lines for several cameras of a session in folder `place`."""
    lines = ["# Those of one moment have the same name, the same number at its end, or nearly the same time as name."]
    if by_order:
        lines = ["# The first images of all cameras are of one moment, and so on.", 'frames = "order"']
    lines.append("")
    if known.rig is not None:
        rig = f"rig = {toml_text(relative_path(known.rig, place))}"
        lines += ["# Its cameras stay as they are, lens and mount.", rig, ""]
    lenses = known.of_cameras(list(cameras))
    for name, patterns in cameras.items():
        lines += ["[[cameras]]", f"id = {toml_text(name)}", f"images = {_patterns_toml(patterns, place)}"]
        lines += [f"calibration = {toml_text(relative_path(lenses[name], place))}", ""] if name in lenses else [""]
    lines += [
        "# What a rule says of the distance of two cameras is compared with the result:",
        "# [[baselines]]",
        f"# a = {toml_text(next(iter(cameras)))}",
        f"# b = {toml_text(list(cameras)[1])}",
        "# value_mm = 100.0",
        "# sigma_mm = 1.0",
        '# how = "steel rule"',
    ]
    return lines


def session_of_future_images(patterns: Mapping[str, str], boards: Sequence[str], place: Path) -> dict[Path, str]:
    """Return the session in folder `place` for images to be taken, which will match `patterns` (by camera), as files.

    Images of one moment will have the same name. Boards and errors are as for `session_of_folders`.
    """
    files: dict[Path, str] = {}
    names = [_board_file(words, place, files) for words in boards]
    lines = [f'schema = "{SESSION_SCHEMA}"', f"boards = [{', '.join(map(toml_text, names))}]"]
    if len(patterns) == 1:
        lines += [f"images = {toml_text(pattern)}" for pattern in patterns.values()]
    else:
        lines.append('frames = "name"')
        for name, pattern in patterns.items():
            check_identifier(name, "camera")
            lines += ["", "[[cameras]]", f"id = {toml_text(name)}", f"images = {toml_text(pattern)}"]
    return files | {place / SESSION_NAME: "\n".join(lines) + "\n"}


def boards_seen(places: Sequence[Path], side_mm: float, progress: Progress = silent) -> tuple[str, ...]:
    """Return, in words, the boards that folders of images or videos show, with squares (tags, circle spacings) of
    `side_mm`.

    Raises InputError if none is recognised.
    """
    shown = _board_suggestion(places, progress)
    if shown.words is None:
        part = shown.part and f"the images show {shown.part}, and give it as --board {WORDS_HELP}"
        if shown.fault or part:
            raise InputError(f"calibrate: {shown.fault or part}")
        doubt = f" ({shown.doubt})" if shown.doubt is not None else ""
        below = next(filter(None, map(further_images, places)), None)
        other = f", but '{below}' below has others: give it instead if they show one" if below else ""
        raise InputError(
            f"calibrate: no board is seen in the images{doubt}{other}; if one is, give it, such as --board {WORDS_HELP}"
        )
    if shown.beside:
        _log.info(f"also seen, and left out: --board {' --board '.join(shown.beside)}; give all boards that are yours")
    return tuple(with_length(words, side_mm) for words in shown.words.split(" --board "))


def _board_suggestion(places: Sequence[Path], progress: Progress) -> Suggestion:
    if any(is_video(place) for place in places):
        return suggestion(places, progress)
    try:
        entries = [entry for found in cameras_in(places).values() for entry in found]
    except InputError:
        entries = cameras_in(places, 1)[""]
    return suggestion(images_of_camera(entries), progress)


def _missing_board_message(folders: Sequence[Path], progress: Progress) -> str:
    """Return the error message for a missing --board, with the board that the images show."""
    shown = _board_suggestion(folders, progress)
    if shown.fault is not None:
        return f"calibrate: {shown.fault}"
    such = f"give the board, such as --board {WORDS_HELP}, or --board board.toml"
    if shown.words is not None:
        such = f"they show --board {shown.words}: measure a square, and give that with its mm for MM, or --square-mm"
    return f"calibrate: images cannot tell how large squares are; {such}"


def cameras_in(folders: Sequence[Path], count: int | None = None) -> dict[str, list[tuple[Path, str]]]:
    """Return the images of every camera as (folder, pattern), by camera name; a single camera is named "".

    Several folders are one camera each. One folder holds several cameras if all its images are named left01, right01
    (or cam0_01, 01_left, left_pose_1, img_L_01; of one moment left and right), or if it has no images but folders left
    and right (or cam0, cam1), or mav0/cam0/data and mav0/cam1/data below it. With a `count`, the images are those of so
    many cameras: of one, all images of all folders and below them; of several, by any part of their paths
    (`layouts_of`).

    Raises InputError for a folder without images, two folders of the same name, and images that are not of `count`
    cameras by their names.
    """
    if count == 1:
        return {"": [entry for folder in folders for entry in _all_below(folder)]}
    found: dict[str, list[tuple[Path, str]]] = {}
    try:
        found = _by_words(folders)
        if count in (None, len(found)):
            return found
    except InputError:
        if count is None or len(folders) > 1:
            raise
    layouts = layouts_of(images_below(folders[0])) if len(folders) == 1 else []
    fitting = [layout for layout in layouts if len(layout.cameras) == count]
    if len(fitting) != 1:
        read = " or ".join(map(str, layouts)) or (f"cameras {', '.join(found)}" if len(found) > 1 else "one camera")
        raise InputError(
            f"by their names the images in '{folders[0]}' are of {read}, not of {count} cameras; give a folder of "
            "images for each"
        )
    return images_of_layout(fitting[0])


def images_of_layout(layout: CameraLayout) -> dict[str, list[tuple[Path, str]]]:
    """Return the images of a layout as `cameras_in` does."""
    out: dict[str, list[tuple[Path, str]]] = {}
    for name, own in layout.cameras.items():
        mine = set(own.values())
        for folder in dict.fromkeys(image.parent for image in own.values()):
            inside = images_of_folder(folder)
            whole = mine.issuperset(inside)
            patterns = [f"*{suffix}" for suffix in _suffixes(inside)] if whole else _patterns(inside, mine)
            out.setdefault(name, []).extend((folder, pattern) for pattern in patterns)
    return out


def _patterns(images: Sequence[Path], chosen: Collection[Path]) -> list[str]:
    """Return patterns of the `chosen` ones of a folder's images: one of the name's part that they share, or names."""
    names = [path.name for path in images if path in chosen]
    for part in NAME_PART.findall(Path(names[0]).stem) if len(names) > 1 else ():
        for pattern in (f"{glob.escape(part)}*{Path(names[0]).suffix}", f"*{glob.escape(part)}{Path(names[0]).suffix}"):
            if [path.name for path in images if fnmatch(path.name, pattern)] == names:
                return [pattern]
    return [glob.escape(name) for name in names]


def _all_below(folder: Path) -> list[tuple[Path, str]]:
    """Return all images of a folder and below it."""
    require_folder(folder)
    places = dict.fromkeys(image.parent for image in images_below(folder))
    if not places:
        raise InputError(no_images(folder))
    return [(place, f"*{suffix}") for place in places for suffix in _suffixes(images_of_folder(place))]


def _by_words(folders: Sequence[Path]) -> dict[str, list[tuple[Path, str]]]:
    """Return the images of every camera by the words in the names of images or folders."""
    if len(folders) > 1:
        return _folder_for_each_camera(folders)
    folder = folders[0]
    images = _images(folder)
    if images:
        return _by_names(folder, images)
    return _cameras_below(folder)


def images_of_camera(patterns: Iterable[tuple[Path, str]]) -> list[Path]:
    """Return the images of a camera of `cameras_in`, sorted."""
    return sorted(image for folder, pattern in patterns for image in images_of_folder(folder, pattern))


def _cameras_below(folder: Path) -> dict[str, list[tuple[Path, str]]]:
    """Return the cameras of the folders below that have images, and whose paths differ in the name of a camera only.

    The group nearest to `folder` counts. Without one, a single folder with images is one camera. Raises InputError if
    there are several folders, or two such groups at one depth.
    """
    groups: dict[tuple[tuple[str, ...], tuple[str, ...]], dict[str, Path]] = {}
    for place in dict.fromkeys(image.parent for image in images_below(folder)):
        parts = place.relative_to(folder).parts
        for k, name in enumerate(parts):
            if SIDE_FOLDER.fullmatch(name) and _images(place):
                groups.setdefault((parts[:k], parts[k + 1 :]), {})[name] = place
    depths = {key: len(key[0] + key[1]) for key, own in groups.items() if len(own) > 1 and _of_cameras(own)}
    nearest = [key for key, depth in depths.items() if depth == min(depths.values())]
    if not nearest:
        only = folder_of_images(folder)
        return _by_names(only, images_of_folder(only))
    if len(nearest) > 1:
        raise InputError(no_images(folder))
    rig = groups[nearest[0]]
    return _by_folder({name: rig[name] for name in sorted(rig, key=natural_key)})


def _of_cameras(named: Mapping[str, Path]) -> bool:
    """Return whether folders are those of cameras: image_01 to image_20 with an image or two are moments of one."""
    return len(named) <= max(len(_images(folder)) for folder in named.values()) or not all(
        NUMBERED_FOLDER.fullmatch(name) for name in named
    )


def _images(folder: Path) -> list[Path]:
    require_folder(folder)
    return images_of_folder(folder)


def _folder_for_each_camera(folders: Sequence[Path]) -> dict[str, list[tuple[Path, str]]]:
    named: dict[str, Path] = {}
    for folder in folders:
        name = folder.resolve().name
        if name in named:
            raise InputError(f"two folders are called '{name}', which names a camera; rename one")
        named[name] = folder if _images(folder) else folder_of_images(folder)
    return _by_folder(named)


def _by_folder(named: Mapping[str, Path]) -> dict[str, list[tuple[Path, str]]]:
    """Return the images of cameras, each with a folder of its own."""
    for name, folder in named.items():
        check_identifier(name, f"folder '{folder}', the name of a camera,")
    return {name: [(named[name], f"*{suffix}") for suffix in _suffixes(_images(named[name]))] for name in named}


def _by_names(folder: Path, images: Sequence[Path]) -> dict[str, list[tuple[Path, str]]]:
    """Return the cameras by the images' names: several only if every name has a side, or is one (one moment)."""
    alone = {image.stem.lower(): [(folder, image.name)] for image in images}
    if set(alone) == {"left", "right"} and len(images) == 2:
        return dict(sorted(alone.items()))
    sides: dict[str, dict[str, None]] = {}
    found = [next((m for form in NAMES if (m := form.fullmatch(image.stem))), None) for image in images]
    named = [name.groupdict("") for name in found if name is not None]
    rests = Counter((name.get("before", ""), name["rest"]) for name in named)
    numbered = all(rest.isdigit() for _, rest in rests)
    # "board_left_1" and "L1" may also say where the board was: then right has other numbers.
    sure = numbered and all(len(name["side"]) > 1 and "before" not in name for name in named)
    shared = sum(count for count in rests.values() if count > 1)
    if len(named) == len(images) and (sure or shared >= MIN_IN_COMMON * len(images)):
        for image, name in zip(images, named, strict=True):
            side, gap, start = name["side"], name["gap"], name.get("before", "")
            begin = f"{glob.escape(start)}{side}{gap}{'[0-9]*' if numbered else '*[0-9]'}"
            pattern = begin if image.stem.startswith(start + side) else f"*[0-9]{gap}{side}"
            sides.setdefault(side.lower(), {})[pattern + image.suffix] = None
    if len(sides) < 2:
        return {"": [(folder, f"*{suffix}") for suffix in _suffixes(images)]}
    return {side: [(folder, pattern) for pattern in sides[side]] for side in sorted(sides, key=natural_key)}


def _suffixes(images: Iterable[Path]) -> list[str]:
    return sorted({image.suffix for image in images})


def _board_file(words: str, place: Path, files: dict[Path, str]) -> str:
    """Return the path of a board's file in the session; the file of a board in words is added to `files`."""
    board = board_of_words(words)
    if board_in_words(words) is None:
        return relative_path(Path(words), place)
    path = place / f"{board.board_id}.toml"
    files[path] = board_text(board, f"as given by --board {words}; squares are best measured over many", path)
    return path.name


def _patterns_toml(patterns: Sequence[tuple[Path, str]], place: Path) -> str:
    texts = []
    for folder, pattern in patterns:
        inside = relative_path(folder, place)
        texts.append(toml_text(pattern if inside == "." else f"{glob.escape(inside)}/{pattern}"))
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"
