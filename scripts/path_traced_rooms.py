"""Render pairs of images of textured rooms by an independent path tracer, with the exact surface at every pixel.

python scripts/path_traced_rooms.py rooms fisheye:1 perspective:2      in a Python that has `pip install bpy` (5)
python scripts/bench_clouds.py rooms                                   with rigkit

Blender's Cycles renders a room of boxes, balls, cylinders, posts and boards in painted textures, one wall nearly plain,
from two places. Each image is rendered again with one sample at the centre of every pixel for positions and normals.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

SAMPLES = 12
"""Of a pixel: with direct light alone, about the noise of a camera indoors."""
WIDTH_M, DEPTH_M, HEIGHT_M = 2.4, 3.5, 1.6
"""Half sides of the room, and how far its far wall is."""
LENSES = {"fisheye": ((800, 800), 185.0), "perspective": ((800, 600), 68.0)}
"""Sizes of images, px, and fields of view across, degrees; the fisheye is equidistant."""
TEXELS = 1024
SMOOTHED = 1.2
"""Width of Cycles' filter, px."""


def texture(rng: np.random.Generator, plain: bool) -> Any:
    """Return a picture of clouds and patches in a colour of its own; a `plain` one has hardly any."""
    across, down = np.fft.fftfreq(TEXELS), np.fft.rfftfreq(TEXELS)
    frequency = np.maximum(np.hypot(across[:, None], down), 2.0 / TEXELS)
    spectrum = np.fft.rfft2(rng.normal(size=(TEXELS, TEXELS))) / frequency ** rng.uniform(0.9, 1.5)
    clouds = np.fft.irfft2(spectrum, (TEXELS, TEXELS))
    clouds = (clouds - clouds.mean()) / clouds.std()
    value = clouds[..., None] + np.stack([0.15 * np.roll(clouds, 200 * k, 0) for k in range(3)], axis=-1)
    for _ in range(0 if plain else 60):
        (left, top), (wide, high) = rng.integers(0, TEXELS, 2), rng.integers(10, 120, 2)
        value[top : top + high, left : left + wide] += 1.2 * rng.normal()
    value = rng.uniform(0.3, 0.6, 3) * (1.0 + (0.03 if plain else 0.35) * np.tanh(0.8 * value))
    image = bpy.data.images.new("texture", TEXELS, TEXELS, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    pixels = np.concatenate([np.clip(value, 0.01, 1.0), np.ones((TEXELS, TEXELS, 1))], axis=-1)
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    image.pack()
    return image


def paint(rng: np.random.Generator, *, scale: float, plain: bool = False, shine: float = 0.0) -> None:
    """Paint the active object."""
    material = bpy.data.materials.new("paint")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = 0.5 if shine else 0.95
    surface.inputs["Specular IOR Level"].default_value = shine
    picture = nodes.new("ShaderNodeTexImage")
    picture.image, picture.projection = texture(rng, plain), "BOX"
    place, size = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    size.inputs["Scale"].default_value = (scale,) * 3
    links.new(place.outputs["Object"], size.inputs["Vector"])
    links.new(size.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], surface.inputs["Base Color"])
    bpy.context.object.data.materials.append(material)


def box(at: tuple[float, ...], size: tuple[float, ...], turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> None:
    bpy.ops.mesh.primitive_cube_add(size=1, location=at, rotation=turn)
    bpy.context.object.scale = size
    bpy.ops.object.transform_apply(location=False, rotation=False, scale=True)


def build_walls(rng: np.random.Generator) -> None:
    wide, deep, high, thin = 2 * WIDTH_M, 2 * DEPTH_M, 2 * HEIGHT_M, 0.1
    for at, size in (
        ((0.0, DEPTH_M, 0.0), (wide, thin, high)),
        ((0.0, 1.0 - DEPTH_M, 0.0), (wide, thin, high)),
        ((-WIDTH_M, 0.5, 0.0), (thin, deep, high)),
        ((WIDTH_M, 0.5, 0.0), (thin, deep, high)),
        ((0.0, 0.5, -HEIGHT_M), (wide, deep, thin)),
        ((0.0, 0.5, HEIGHT_M), (wide, deep, thin)),
    ):
        box(at, size)
        paint(rng, scale=0.8, plain=at[0] > 0.0)


def build_things(rng: np.random.Generator, half_field_rad: float, count: int) -> None:
    """Put things all over the field of view, 0.8 to 2.2 m away."""
    for k, azimuth in enumerate(np.linspace(-half_field_rad, half_field_rad, count) + 0.05 * rng.normal(size=count)):
        elevation, distance, side = rng.uniform(-0.5, 0.45), rng.uniform(0.8, 2.2), rng.uniform(0.15, 0.4)
        turn = tuple(rng.uniform(-0.7, 0.7, 3))
        level = distance * np.cos(elevation)
        at = (level * np.sin(azimuth), level * np.cos(azimuth), distance * np.sin(elevation))
        if k % 5 == 0:
            box(at, (side, side, side), turn)
            paint(rng, scale=2.0, shine=0.3)
        elif k % 5 == 1:
            bpy.ops.mesh.primitive_uv_sphere_add(segments=192, ring_count=96, radius=0.6 * side, location=at)
            bpy.ops.object.shade_smooth()
            paint(rng, scale=2.0)
        elif k % 5 == 2:
            box(at, (1.6 * side, 0.02, side), turn)
            paint(rng, scale=1.5)
        elif k % 5 == 3:
            bpy.ops.mesh.primitive_cylinder_add(
                vertices=256, radius=0.4 * side, depth=2.0 * side, location=at, rotation=turn
            )
            paint(rng, scale=2.0)
        else:
            box((at[0], at[1], 0.0), (0.03, 0.03, 2.0 * HEIGHT_M), (0.0, 0.0, turn[2]))
            paint(rng, scale=4.0)


def light() -> None:
    for at, watts, side in (
        ((-1.2, -0.8, 1.4), 45.0, 0.8),
        ((1.2, 1.6, 1.4), 45.0, 0.8),
        ((0.0, -1.6, 0.4), 30.0, 0.8),
    ):
        lamp = bpy.data.lights.new("lamp", "AREA")
        lamp.energy, lamp.size = watts, side
        there = bpy.data.objects.new("lamp", lamp)
        there.location = at
        if at[2] < 1.0:
            there.rotation_euler = (np.pi / 2.0, 0.0, 0.0)
        bpy.context.scene.collection.objects.link(there)


def turned(vector: np.ndarray) -> np.ndarray:
    """Return the rotation by a vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def lens_of(kind: str) -> Any:
    lens = bpy.data.cameras.new(kind)
    field = np.radians(LENSES[kind][1])
    if kind == "fisheye":
        lens.type, lens.panorama_type, lens.fisheye_fov = "PANO", "FISHEYE_EQUIDISTANT", field
    else:
        lens.type, lens.sensor_fit, lens.angle_x = "PERSP", "HORIZONTAL", field
    lens.clip_start = 0.01
    return lens


def draw(path: Path, seed: int) -> None:
    """Draw what the scene's camera sees."""
    scene = bpy.context.scene
    scene.compositing_node_group = None
    scene.cycles.samples, scene.cycles.filter_width, scene.cycles.seed = SAMPLES, SMOOTHED, seed
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGB"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def surface(folder: Path) -> dict[str, np.ndarray]:
    """Return positions and normals (H, W, 3) in the world behind the middles of pixels; normals 0 where nothing is."""
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.filter_width = 1, 0.01
    scene.compositing_node_group = tree = bpy.data.node_groups.new("passes", "CompositorNodeTree")
    layers, out = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeOutputFile")
    out.directory, out.format.media_type = str(folder), "IMAGE"
    out.format.file_format, out.format.color_depth, out.format.color_mode = "OPEN_EXR", "32", "RGB"
    for name in ("Position", "Normal"):
        out.file_output_items.new("VECTOR", name)
        tree.links.new(layers.outputs[name], out.inputs[name])
    scene.render.filepath = str(folder / "unused.png")
    bpy.ops.render.render()
    read = {}
    for name in ("Position", "Normal"):
        image = bpy.data.images.load(str(next(folder.glob(f"*{name}*.exr"))))
        image.colorspace_settings.name = "Non-Color"
        values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
        image.pixels.foreach_get(values)
        # Blender's rows go upwards.
        read[name] = values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3].astype(np.float64)
        bpy.data.images.remove(image)
    return read


def make_room(folder: Path, kind: str, seed: int) -> dict[str, Any]:
    """Draw a pair, and return its entry of pairs.json."""
    rng = np.random.default_rng(seed)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.max_bounces, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = 0, False, False
    scene.world = bpy.data.worlds.new("dark")
    scene.view_settings.view_transform = "Standard"
    scene.view_layers[0].use_pass_position = scene.view_layers[0].use_pass_normal = True
    (width, height), field = LENSES[kind]
    scene.render.resolution_x, scene.render.resolution_y = width, height
    fisheye = kind == "fisheye"
    build_walls(rng)
    build_things(rng, 1.5 if fisheye else 0.45, 14 if fisheye else 9)
    light()
    # Cameras look along y, their x to the right and their y downwards.
    ahead = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    first = ahead @ turned(0.03 * rng.normal(size=3))
    second = first @ turned(np.radians(3.0) * rng.normal(size=3))
    baseline = np.array([0.11 if fisheye else 0.16, 0.0, 0.0]) + np.array([0.0, 0.02, 0.02]) * rng.normal(size=3)
    name, lens = f"{kind}-{seed}", lens_of(kind)
    for k, (turn, at) in enumerate(((first, np.zeros(3)), (second, baseline))):
        placed = np.eye(4)
        placed[:3, :3], placed[:3, 3] = turn @ np.diag([1.0, -1.0, -1.0]), at
        scene.camera = bpy.data.objects.new("camera", lens)
        scene.collection.objects.link(scene.camera)
        scene.camera.matrix_world = Matrix(placed.tolist())
        draw(folder / f"{name}-{k + 1}.png", k)
        if k == 0:
            with tempfile.TemporaryDirectory() as there:
                seen = surface(Path(there))
    hit = np.linalg.norm(seen["Normal"], axis=-1) > 0.5
    distance = np.where(hit, np.linalg.norm(seen["Position"], axis=-1), np.nan)
    normals = np.where(hit[..., None], seen["Normal"] @ first, np.nan)
    normals *= -np.sign(np.sum(normals * (seen["Position"] @ first), axis=-1, keepdims=True))
    np.savez_compressed(folder / f"{name}.npz", range=distance.astype(np.float32), normals=normals.astype(np.float32))
    middle = [(width - 1) / 2, (height - 1) / 2]
    f = width / np.radians(field) if fisheye else width / 2 / np.tan(np.radians(field) / 2)
    model, more = ("kannala_brandt", [0.0] * 4) if fisheye else ("pinhole", [])
    camera = [model, [width, height], [f, f, *middle, *more]]
    direction = second.T @ -baseline / np.linalg.norm(baseline)
    return {
        "set": kind,
        "name": name,
        "image1": f"{name}-1.png",
        "image2": f"{name}-2.png",
        "camera1": camera,
        "camera2": camera,
        "cam2_from_cam1_R": (second.T @ first).tolist(),
        "cam2_from_cam1_t_direction": direction.tolist(),
        "baseline": float(np.linalg.norm(baseline)),
        "surface": f"{name}.npz",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("rooms", nargs="+", metavar="KIND:SEED", help=f"{' or '.join(LENSES)}, and a number")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    index = args.folder / "pairs.json"
    entries = {entry["name"]: entry for entry in json.loads(index.read_text())} if index.exists() else {}
    for room in args.rooms:
        kind, _, seed = room.partition(":")
        entry = make_room(args.folder.resolve(), kind, int(seed))
        entries[entry["name"]] = entry
        index.write_text(json.dumps(list(entries.values()), indent=1))


if __name__ == "__main__":
    main()
