"""A room with board-like distractors: floor tiles, tiled boxes, keyboards on posters; needs `bpy`."""

from __future__ import annotations

import math

import bpy
import numpy as np

from traced.blender import box, lamp, material, mesh

TILES = ("Checker", 2.5, (0.55, 0.55, 0.52), (0.12, 0.12, 0.13))
BRICKS = ("Brick", 2.0, (0.45, 0.25, 0.18), (0.35, 0.2, 0.15))
SIDE_M, HEIGHT_M = 6.0, 3.0
THINGS, POSTERS = 26, 6


def furnish(rng: np.random.Generator) -> None:
    """Put a closed room with boxes, posters and one lamp round the origin, z up."""
    plain = [material(rng.uniform(0.15, 0.65, 3)) for _ in range(8)]
    brick, half = material((0.5, 0.5, 0.5), tiles=BRICKS), 0.5 * SIDE_M
    box((0.0, 0.0, -0.05), (SIDE_M, SIDE_M, 0.1), material((0.5, 0.5, 0.5), tiles=TILES))
    box((0.0, 0.0, HEIGHT_M + 0.05), (SIDE_M, SIDE_M, 0.1), material((0.7, 0.7, 0.7)))
    for k, (x, y) in enumerate(((half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half))):
        wall = (0.1, SIDE_M, HEIGHT_M) if x else (SIDE_M, 0.1, HEIGHT_M)
        box((x, y, 0.5 * HEIGHT_M), wall, brick if k in (0, 2) else plain[k])
    for k in range(THINGS):
        around, away = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(1.9, 2.7)
        size = rng.uniform([0.15, 0.15, 0.3], [0.7, 0.6, 1.9])
        paint = plain[k % len(plain)]
        if k % 4 == 0:
            paint = material((0.5, 0.5, 0.5), tiles=("Checker", rng.uniform(6.0, 16.0), (0.7,) * 3, (0.08,) * 3))
        at = (away * math.cos(around), away * math.sin(around), 0.5 * size[2])
        box(at, size, paint, rng.uniform(0.0, 3.0))
    for _ in range(POSTERS):
        _poster(rng)
    lamp((0.4, 0.3, HEIGHT_M - 0.05), 80.0, 1.0)


def furnish_corner(rng: np.random.Generator) -> None:
    """Put the walls x = 0 and y = 0, a tiled floor, boxes and a lamp about the laboratory's three boards."""
    box((-0.05, 1.5, 1.2), (0.1, 3.2, 2.6), material((0.5, 0.5, 0.5), tiles=BRICKS))
    box((1.5, -0.05, 1.2), (3.2, 0.1, 2.6), material((0.3, 0.35, 0.4)))
    box((1.5, 1.5, -0.05), (3.2, 3.2, 0.1), material((0.5, 0.5, 0.5), tiles=("Checker", 3.3, *TILES[2:])))
    for k in range(12):
        along, size = rng.uniform(0.8, 2.6), rng.uniform(0.15, 0.4, 3)
        at = (along, 0.3) if k % 2 else (0.3, along)
        box((*at, 0.5 * size[2]), size, material(rng.uniform(0.1, 0.6, 3)), rng.uniform(0.0, 3.0))
    lamp((1.3, 1.5, 2.3), 60.0, 0.8)


def _poster(rng: np.random.Generator) -> None:
    """Hang up a light sheet with rows of dark keys, facing the middle of the room."""
    columns, rows = int(rng.integers(5, 15)) - 1, int(rng.integers(4, 9)) - 1
    step, part = rng.uniform(0.03, 0.09), rng.uniform(0.6, 0.9)
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    sheet = corner * [columns + 2.0, rows + 2.0] - 1.0
    row, column = np.divmod(np.arange(columns * rows), columns)
    keys = np.stack([column, row], axis=1)[:, None] + part * corner
    flat = np.concatenate([sheet, keys.reshape(-1, 2)]) * step
    # Keys lie 3 mm before the sheet.
    depth = np.where(np.arange(len(flat)) < 4, -0.001, -0.004)
    vertices = np.column_stack([flat[:, 0], depth, flat[:, 1]])
    faces = np.arange(len(flat)).reshape(-1, 4).tolist()
    thing = mesh(vertices, faces, [material((0.7,) * 3), material((0.08,) * 3)], [0] + [1] * (len(faces) - 1))
    around = rng.uniform(0.0, 2.0 * np.pi)
    thing.location = (1.75 * math.cos(around), 1.75 * math.sin(around), rng.uniform(0.6, 1.8))
    thing.rotation_euler = (0.0, 0.0, around - 0.5 * np.pi)
    bpy.context.view_layer.update()
