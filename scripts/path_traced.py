"""Render captures of boards with exact truth by an independent path tracer, Blender's Cycles.

    python -m venv blender && blender/bin/pip install bpy==4.2.0 -e .       # Python 3.11
    blender/bin/python scripts/path_traced.py -o traced narrow fisheye laboratory
    .venv/bin/python scripts/measure_traced.py traced/*

A SET is a folder with the pictures (8 bit, sRGB, shot and read noise), board.toml and truth.json: the lens's formula,
the cameras' and boards' poses, the board's points. `laboratory` is a data set for `rigkit validate`, with its
dataset.toml; its cameras are those of `narrow` and `fisheye`, which are calibrated first. The same names always give
the same pictures; existing ones are kept. A picture of 800 x 600 takes about 20 s of one core.

Lenses and boards are defined in traced/captures.py, the laboratory in traced/laboratory.py.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import bpy
import cv2
import numpy as np
from traced import blender, laboratory
from traced.captures import CAPTURES, Capture, Exposure, held_poses, looking_along, paper_edge_px
from traced.room import furnish, furnish_corner
from traced.sensor import JPEG_QUALITY, develop

from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.boards.board_file import board_text

LABORATORY = "laboratory"


def written(motion: Rigid3) -> dict[str, list[Any]]:
    return {"rotation": motion.rotation.tolist(), "translation_mm": motion.translation_mm.tolist()}


def save(path: Path, image: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]):
        raise OSError(f"{path} cannot be written")


def truth_of(folder: Path, values: dict[str, Any]) -> None:
    by = f"Cycles of Blender {bpy.app.version_string}"
    (folder / "truth.json").write_text(json.dumps({"rendered_by": by, **values}))


def motion_in_rig(capture: Capture, rig_from_board: Rigid3, rng: np.random.Generator) -> FloatArray:
    """Return how the board moves while the shutter is open, mm: across the view, by so many pixels."""
    lens, around = next(iter(capture.lenses.values())), rng.uniform(0.0, 2.0 * np.pi)
    depth = rig_from_board.apply(capture.points_mm().mean(axis=0))[2]
    length = rng.uniform(*capture.exposure.motion_px) * depth / lens.focal_px
    return np.asarray(length * np.array([np.cos(around), np.sin(around), 0.0]))


def render_capture(name: str, folder: Path) -> None:
    """Render the pictures of a board in hand, the rig elsewhere in the room in each."""
    capture = CAPTURES[name]
    exposure, rng = capture.exposure, np.random.default_rng(capture.seed)
    scene = blender.new_scene(exposure)
    furnish(rng)
    depth = capture.depth_mm if capture.bend_mm else None
    thing = blender.board_object(capture.printed, blender.print_materials(exposure), depth)
    fingers = blender.hands(thing, rng) if capture.hands else []
    level = looking_along(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    views = []
    for k, rig_from_board in enumerate(held_poses(capture, rng)):
        turned = exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])) @ level
        at_mm = [*rng.uniform(-250.0, 250.0, 2), rng.uniform(1100.0, 1500.0)]
        world_from_rig = Rigid3(turned @ exp_so3(np.array([rng.uniform(-0.25, 0.25), 0.0, 0.0])), at_mm)
        seed, shift_mm = int(rng.integers(100_000)), np.zeros(3)
        thing.animation_data_clear()
        blender.hold(fingers, capture.printed, rng)
        blender.place(thing, world_from_rig @ rig_from_board)
        bpy.context.view_layer.update()
        if exposure.motion:
            shift_mm = motion_in_rig(capture, rig_from_board, rng)
            shift_m = world_from_rig.rotation @ shift_mm * blender.M_PER_MM
            blender.set_moving(scene, thing, shift_m, exposure.motion == "rolling")
        for camera, (lens, cam_from_rig) in capture.mounts.items():
            picture = folder / ("images" if len(capture.lenses) == 1 else camera) / f"{k:02d}{exposure.suffix}"
            if picture.is_file():
                continue
            edge = paper_edge_px(capture.printed, lens, cam_from_rig @ rig_from_board)
            world_from_cam = world_from_rig @ cam_from_rig.inverse()
            light = blender.picture(scene, lens, exposure, world_from_cam, edge, seed, folder / "scratch.exr")
            save(picture, develop(light, exposure, np.random.default_rng(seed)))
        views.append({"name": f"{k:02d}", "rig_from_board": written(rig_from_board), "motion_mm": shift_mm.tolist()})
        print(f"{name}: {k + 1} of {capture.count}", file=sys.stderr, flush=True)
    board_file = folder / "board.toml"
    board_file.write_text(board_text(capture.board, "rendered", board_file))
    cameras = {
        camera: {"lens": lens.truth(), "cam_from_rig": written(mount)}
        for camera, (lens, mount) in capture.mounts.items()
    }
    points = capture.points_mm().tolist()
    truth_of(folder, {"exposure": asdict(exposure), "cameras": cameras, "points_mm": points, "views": views})


def render_laboratory(folder: Path) -> None:
    """Render the pairs of the laboratory, and its manifest."""
    exposure, rng = Exposure(), np.random.default_rng(77)
    scene = blender.new_scene(exposure)
    furnish_corner(rng)
    paint, places = blender.print_materials(exposure), laboratory.places()
    for name, board in laboratory.BOARDS.items():
        blender.place(blender.board_object(board, paint, backed=False), places[name])
    for name, pair in laboratory.pairs().items():
        lens = laboratory.LENSES[pair.lens]
        for k, world_from_cam in enumerate((pair.world_from_cam1, pair.world_from_cam2), start=1):
            back = world_from_cam.inverse()
            edges = [paper_edge_px(board, lens, back @ places[b]) for b, board in laboratory.BOARDS.items()]
            seen = np.concatenate(edges)
            light = blender.picture(scene, lens, exposure, world_from_cam, seen, k, folder / "scratch.exr")
            save(folder / "images" / name / f"view{k}.png", develop(light, exposure, rng))
        print(f"{LABORATORY}: {name}", file=sys.stderr, flush=True)
    (folder / "dataset.toml").write_text(laboratory.manifest())
    truth_of(folder, {"pairs": {name: pair.baseline_mm for name, pair in laboratory.pairs().items()}})


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument(
        "sets", nargs="+", metavar="SET", choices=[*CAPTURES, LABORATORY], help=", ".join([*CAPTURES, LABORATORY])
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("traced"), help="a folder for the sets (default: traced)"
    )
    arguments = parser.parse_args()
    for name in arguments.sets:
        folder = arguments.output / name
        folder.mkdir(parents=True, exist_ok=True)
        if name == LABORATORY:
            render_laboratory(folder)
        else:
            render_capture(name, folder)


if __name__ == "__main__":
    main()
