"""Build a capture's meshes, materials and cameras in Blender; needs `bpy`. Blender's lengths are in m, ours in mm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.boards import Board
from rigkit.geometry.rigid3 import Rigid3
from traced.captures import CIRCLES_BEFORE_MM, PAPER_MARGIN, Exposure
from traced.lenses import Lens

M_PER_MM = 1e-3
PITCH_MM = 0.005
"""Side of a pixel: only Blender's units hang on it."""
AMBIENT = 0.35
"""Every surface gives so much of its colour as light: what the room would throw back, without rays and their noise."""
WHITE, BLACK = 0.8, 0.04
CIRCLE_SIDES = 128
SKIN = ((0.55, 0.35, 0.26), (0.25, 0.14, 0.09))
FINGERS, FINGER_MM = 6, (40.0, 9.0, 8.0)
"""Of both hands, and their half axes."""
BACKING_MM = 5.0
MARGIN_PX = 12
"""All samples are taken so far around the boards, too."""
BLENDER_CAMERA = Rigid3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
"""Blender's cameras look along -z with y up."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
Numbers = Sequence[float] | FloatArray


def new_scene(exposure: Exposure) -> Any:
    """Return an empty scene for Cycles: direct light and one mirroring, linear values, one thread."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.use_denoising, cycles.use_adaptive_sampling = "CPU", False, False
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces, cycles.transmission_bounces = 1, 0, 1, 0
    cycles.use_light_tree = cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.pixel_filter_type = "BLACKMAN_HARRIS" if exposure.filter_px else "BOX"
    cycles.filter_width = exposure.filter_px or 1.0
    scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.view_settings.view_transform = "Raw"
    settings = scene.render.image_settings
    settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGB"
    return scene


def material(colour: Numbers, *, gloss: float = 0.0, roughness: float = 0.3, tiles: Sequence[Any] = ()) -> Any:
    """Return a diffuse material that mirrors `gloss` of the light. `tiles`: (kind of texture, scale, two colours)."""
    made = bpy.data.materials.new("material")
    made.use_nodes = True
    nodes, link = made.node_tree.nodes, made.node_tree.links.new
    nodes.clear()
    diffuse, glow = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeEmission")
    glow.inputs["Strength"].default_value = AMBIENT
    if tiles:
        kind, scale, one, two = tiles
        texture = nodes.new(f"ShaderNodeTex{kind}")
        texture.inputs["Scale"].default_value = scale
        texture.inputs["Color1"].default_value, texture.inputs["Color2"].default_value = (*one, 1.0), (*two, 1.0)
        link(nodes.new("ShaderNodeTexCoord").outputs["Object"], texture.inputs["Vector"])
    for shader in (diffuse, glow):
        shader.inputs["Color"].default_value = (*colour, 1.0)
        if tiles:
            link(texture.outputs["Color"], shader.inputs["Color"])
    glossy, mixed = nodes.new("ShaderNodeBsdfGlossy"), nodes.new("ShaderNodeMixShader")
    glossy.inputs["Roughness"].default_value, mixed.inputs[0].default_value = roughness, gloss
    link(diffuse.outputs[0], mixed.inputs[1])
    link(glossy.outputs[0], mixed.inputs[2])
    both = nodes.new("ShaderNodeAddShader")
    link(mixed.outputs[0], both.inputs[0])
    link(glow.outputs[0], both.inputs[1])
    link(both.outputs[0], nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return made


def print_materials(exposure: Exposure) -> list[Any]:
    return [material([v] * 3, gloss=exposure.gloss, roughness=exposure.roughness) for v in (WHITE, BLACK)]


def mesh(
    vertices_m: FloatArray, faces: Sequence[Sequence[int]], materials: list[Any], which: Sequence[int] = ()
) -> Any:
    """Return a new object; `which` of the materials each face has, the first where not given."""
    data = bpy.data.meshes.new("mesh")
    data.from_pydata(np.asarray(vertices_m).tolist(), [], [[int(k) for k in face] for face in faces])
    for one in materials:
        data.materials.append(one)
    if which:
        data.polygons.foreach_set("material_index", np.asarray(which, dtype=np.int32))
    data.update()
    thing = bpy.data.objects.new("object", data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def box(centre_m: Numbers, size_m: Numbers, paint: Any, turn: float = 0.0) -> Any:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size_m
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    thing = mesh(corners, faces, [paint])
    thing.location, thing.rotation_euler = centre_m, (0.0, 0.0, turn)
    return thing


def place(thing: Any, world_from_thing: Rigid3) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = world_from_thing.rotation, world_from_thing.translation_mm * M_PER_MM
    thing.matrix_world = Matrix(pose.tolist())


def _cells(board: Board, step_mm: float) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the cuts along x and along y, and which cells between them are printed (rows, columns)."""
    ink, side = board.ink(), np.array(board.squares_mm)
    low, high = board.pattern.outline(*board.size)
    low, high = (low - PAPER_MARGIN) * side, (high + PAPER_MARGIN) * side
    printed = ink.rectangles
    if ink.first_black is not None:
        row, column = np.mgrid[-1 : board.rows, -1 : board.columns]
        black = (row + column) % 2 == (0 if ink.first_black else 1)
        squares = np.stack([column[black], row[black], np.ones(black.sum()), np.ones(black.sum())], axis=1)
        printed = np.concatenate([printed, squares * np.tile(side, 2)])
    cuts = []
    for axis in (0, 1):
        at = [printed[:, axis], printed[:, axis] + printed[:, axis + 2], [low[axis], high[axis]]]
        steps = np.arange(low[axis], high[axis], step_mm) if step_mm else np.zeros(0)
        cuts.append(np.unique(np.round(np.concatenate([*at, steps]), 6)))
    (x, y), dark = cuts, np.zeros((len(cuts[1]) - 1, len(cuts[0]) - 1), dtype=bool)
    middle_x, middle_y = 0.5 * (x[1:] + x[:-1]), 0.5 * (y[1:] + y[:-1])
    for left, top, width, height in printed:
        across, down = (middle_x > left) & (middle_x < left + width), (middle_y > top) & (middle_y < top + height)
        dark |= down[:, None] & across
    return x, y, dark


def board_object(board: Board, paint: list[Any], depth_mm: Any = None, *, backed: bool = True) -> Any:
    """Return a board in its own frame: cells of paper and ink, exact to the edges of the ink, on a backing.

    `depth_mm` : of a bent board, how far behind z = 0 it lies at (N, 2).
    """
    x, y, dark = _cells(board, 0.25 * min(board.squares_mm) if depth_mm else 0.0)
    xy = np.stack([grid.ravel() for grid in np.meshgrid(x, y)], axis=1)
    vertices = np.column_stack([xy, depth_mm(xy) if depth_mm else np.zeros(len(xy))])
    row, column = np.mgrid[: len(y) - 1, : len(x) - 1]
    first = (row * len(x) + column).ravel()
    faces = np.stack([first, first + len(x), first + len(x) + 1, first + 1], axis=1).tolist()
    ink = board.ink()
    which = (dark.ravel() ^ ink.inverted).astype(int).tolist()
    turn = np.linspace(0.0, 2.0 * np.pi, CIRCLE_SIDES, endpoint=False)
    for u, v, radius in ink.circles:
        faces.append((len(vertices) + np.arange(CIRCLE_SIDES)).tolist())
        rim = [u + radius * np.cos(turn), v + radius * np.sin(turn), np.full(CIRCLE_SIDES, -CIRCLES_BEFORE_MM)]
        vertices = np.concatenate([vertices, np.column_stack(rim)])
        which.append(int(not ink.inverted))
    thing = mesh(vertices * M_PER_MM, faces, paint, which)
    if not backed:
        return thing
    size, middle = 0.96 * np.array([np.ptp(x), np.ptp(y)]), 0.5 * np.array([x[0] + x[-1], y[0] + y[-1]])
    behind = vertices[:, 2].max() + 1.0 + 0.5 * BACKING_MM
    back = box((0.0, 0.0, 0.0), np.array([*size, BACKING_MM]) * M_PER_MM, material((0.3, 0.22, 0.15)))
    back.parent, back.location = thing, np.array([*middle, behind]) * M_PER_MM
    return thing


def hands(thing: Any, rng: np.random.Generator) -> list[Any]:
    """Return fingers, as ellipsoids that go with a board."""
    skin, out = [material(colour, roughness=0.5, gloss=0.05) for colour in SKIN], []
    paint = skin[int(rng.integers(len(skin)))]
    for _ in range(FINGERS):
        bpy.ops.mesh.primitive_uv_sphere_add(segments=32, ring_count=16, radius=1.0)
        finger = bpy.context.object
        finger.data.materials.append(paint)
        finger.parent, finger.scale = thing, np.array(FINGER_MM) * M_PER_MM
        out.append(finger)
    return out


def hold(fingers: list[Any], board: Board, rng: np.random.Generator) -> None:
    """Put the fingers of the left and the right hand before the board, some way in from the edges of its paper."""
    low, high = board.pattern.outline(*board.size)
    low, high = (low - PAPER_MARGIN) * board.squares_mm, (high + PAPER_MARGIN) * board.squares_mm
    hand = rng.uniform(low[1] + 20.0, high[1] - 20.0, 2)
    for k, finger in enumerate(fingers):
        side, along = k % 2, 2.2 * FINGER_MM[1] * (k // 2 - 0.25 * FINGERS + 0.5)
        reach = rng.uniform(0.2, 0.75) * FINGER_MM[0]
        x = low[0] + reach - FINGER_MM[0] if side == 0 else high[0] - reach + FINGER_MM[0]
        finger.location = [x * M_PER_MM, (hand[side] + along) * M_PER_MM, -FINGER_MM[2] * M_PER_MM]
        finger.rotation_euler = (0.0, 0.0, rng.uniform(-0.2, 0.2))


def lamp(at_m: Sequence[float], watt: float, side_m: float) -> None:
    data = bpy.data.lights.new("lamp", "AREA")
    data.energy, data.size = watt, side_m
    thing = bpy.data.objects.new("lamp", data)
    thing.location = at_m
    bpy.context.scene.collection.objects.link(thing)


def camera_object(lens: Lens, exposure: Exposure) -> Any:
    """Return the camera, with the lens in it."""
    data = bpy.data.cameras.new("camera")
    width = lens.size_px[0] + 2 * abs(lens.offset_px[0])
    data.sensor_fit, data.sensor_width, data.clip_start = "HORIZONTAL", width * PITCH_MM, 0.01
    data.lens = lens.focal_px * PITCH_MM
    if lens.kind != "perspective":
        data.type = "PANO"
        data.fisheye_fov = math.radians(lens.field_deg)
    if lens.kind == "equisolid":
        data.panorama_type, data.fisheye_lens = "FISHEYE_EQUISOLID", lens.focal_px * PITCH_MM
    elif lens.kind == "polynomial":
        data.panorama_type = "FISHEYE_LENS_POLYNOMIAL"
        for k, term in enumerate((0.0, *lens.terms, 0.0, 0.0, 0.0)[:5]):
            setattr(data, f"fisheye_polynomial_k{k}", -term / PITCH_MM**k)
    if exposure.aperture_mm:
        data.dof.use_dof, data.dof.focus_distance = True, exposure.focus_mm * M_PER_MM
        data.dof.aperture_fstop = data.lens / exposure.aperture_mm
    thing = bpy.data.objects.new("camera", data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def _window(scene: Any, lens: Lens, low: Sequence[int], high: Sequence[int]) -> None:
    """Render only the pixels from low to high of the picture, which is cut out of one about the principal point."""
    render = scene.render
    offset = np.array(lens.offset_px)
    full, corner = np.array(lens.size_px) + 2 * np.abs(offset), np.abs(offset) - offset
    render.resolution_x, render.resolution_y, render.resolution_percentage = int(full[0]), int(full[1]), 100
    render.use_border = render.use_crop_to_border = True
    # A hundredth of a pixel on top: Blender cuts to whole pixels, and counts rows from below.
    start, end = corner + low, corner + high
    render.border_min_x, render.border_max_x = ((at + 0.01) / full[0] for at in (start[0], end[0]))
    render.border_min_y, render.border_max_y = ((full[1] - at + 0.01) / full[1] for at in (end[1], start[1]))


def _rendered(scene: Any, samples: int, seed: int, scratch: Path) -> FloatArray:
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.render.filepath = str(scratch)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(scratch), check_existing=False)
    image.colorspace_settings.name = "Non-Color"
    width, height = image.size
    values = np.empty(width * height * image.channels, dtype=np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    scratch.unlink()
    return np.asarray(values.reshape(height, width, -1)[::-1, :, :3] @ LUMINANCE, dtype=np.float64)


def picture(
    scene: Any, lens: Lens, exposure: Exposure, world_from_cam: Rigid3, seen_px: FloatArray, seed: int, scratch: Path
) -> FloatArray:
    """Return the light (height, width) that the camera sees: all samples in the box about `seen_px` (N, 2)."""
    camera = camera_object(lens, exposure)
    place(camera, world_from_cam @ BLENDER_CAMERA)
    scene.camera = camera
    _window(scene, lens, (0, 0), lens.size_px)
    out = _rendered(scene, exposure.background_samples, seed, scratch)
    low = np.maximum(np.floor(seen_px.min(axis=0)).astype(int) - MARGIN_PX, 0)
    high = np.minimum(np.ceil(seen_px.max(axis=0)).astype(int) + MARGIN_PX + 1, lens.size_px)
    _window(scene, lens, low.tolist(), high.tolist())
    out[low[1] : high[1], low[0] : high[0]] = _rendered(scene, exposure.samples, seed + 1, scratch)
    bpy.data.objects.remove(camera)
    return out


def set_moving(scene: Any, thing: Any, shift_m: FloatArray, rolling: bool) -> None:
    """Move the thing by `shift_m` while the shutter is open, its place now in the middle; `rolling`: row after row."""
    at = np.array(thing.location)
    for frame, part in ((0, -1.0), (2, 1.0)):
        thing.location = at + part * shift_m
        thing.keyframe_insert("location", frame=frame)
    for curve in thing.animation_data.action.fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
    scene.cycles.rolling_shutter_type, scene.cycles.rolling_shutter_duration = "TOP" if rolling else "NONE", 0.05
    scene.frame_set(1)
