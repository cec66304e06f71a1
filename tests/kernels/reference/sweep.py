"""What kernels/sweep.c computes, in numpy: a level of the sweep, or a line of a path, after the other."""

from __future__ import annotations

import cv2
import numpy as np

REACH = 2
RIVAL_REACH = 5
BITS = (2 * REACH + 1) ** 2 - 1


def census(samples: np.ndarray) -> np.ndarray:
    """Return which neighbours of each sample (R, C) are darker, one bit each; those beyond the border are not."""
    padded = np.pad(samples, REACH, constant_values=np.inf)
    rows, columns = samples.shape
    out = np.zeros((rows, columns), np.uint32)
    for dr in range(2 * REACH + 1):
        for dc in range(2 * REACH + 1):
            if (dr, dc) != (REACH, REACH):
                out <<= np.uint32(1)
                out |= padded[dr : dr + rows, dc : dc + columns] < samples
    return out


def swept_costs(image2: np.ndarray, samples1: np.ndarray, table: np.ndarray, spacing: int) -> np.ndarray:
    """Return the bits (R, C, K) in which the census of both images differs at each level; half where there is none."""
    rows, columns = samples1.shape
    first = census(samples1)
    at = np.meshgrid(*(np.arange(n, dtype=np.float32) / spacing for n in (columns, rows)))
    out = np.empty((rows, columns, len(table)), np.uint8)
    for k, places in enumerate(table):
        u, v = np.moveaxis(cv2.remap(places, at[0], at[1], cv2.INTER_LINEAR), -1, 0)
        height, width = image2.shape
        with np.errstate(invalid="ignore"):
            inside = (u >= 0.0) & (v >= 0.0) & (u <= width - 1.0) & (v <= height - 1.0)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        left, top = (np.minimum(x.astype(int), n - 2) for x, n in ((u, width), (v, height)))
        right, below = u - left, v - top
        upper = image2[top, left] * (1.0 - right) + image2[top, left + 1] * right
        lower = image2[top + 1, left] * (1.0 - right) + image2[top + 1, left + 1] * right
        there = np.where(inside, upper * (1.0 - below) + lower * below, np.nan).astype(np.float32)
        out[..., k] = np.where(inside, np.bitwise_count(first ^ census(there)), BITS // 2)
    return out


def total_costs(costs: np.ndarray, samples1: np.ndarray, *, bend: int, jump: int, even: float) -> np.ndarray:
    """Return the costs (R, C, K) with those of the best surfaces that lead there along eight paths."""
    total = np.zeros(costs.shape, np.int64)
    for turned in (False, True):
        # Paths along columns, downwards and upwards, then along rows; diagonals go with the first.
        there, image, here = (np.swapaxes(x, 0, 1) if turned else x for x in (costs, samples1, total))
        for lines in (range(len(there)), range(len(there) - 1, -1, -1)):
            for lateral in (0,) if turned else (-1, 0, 1):
                before, last = there[lines[0]].astype(np.int64), lines[0]
                here[last] += before
                for line in lines[1:]:
                    came = np.roll(before, lateral, axis=0)
                    least = came.min(axis=1, keepdims=True)
                    change = np.nan_to_num(np.abs(image[line] - np.roll(image[last], lateral)))
                    far = least + (bend + (jump - bend) / (1.0 + change / even)).astype(int)[:, None]
                    best = np.minimum(came, far)
                    best[:, 1:] = np.minimum(best[:, 1:], came[:, :-1] + bend)
                    best[:, :-1] = np.minimum(best[:, :-1], came[:, 1:] + bend)
                    best -= least
                    if lateral:
                        # Nothing comes from beyond the border.
                        best[0 if lateral > 0 else -1] = 0
                    before, last = there[line] + best, line
                    here[line] += before
    return total


def rivals(
    costs: np.ndarray, samples1: np.ndarray, samples: np.ndarray, surfaces: np.ndarray, *, radius: float, alike: float
) -> np.ndarray:
    """Return what each surface costs a sample, at most a level off, and the cheapest other one, (N, 2)."""
    rows, columns, levels = costs.shape
    out = np.full((len(samples), 2), np.nan)
    number = np.arange(levels)
    for n, ((row, column), (level, by_row, by_column, apart)) in enumerate(zip(samples, surfaces, strict=True)):
        total, weights = np.zeros(levels), 0.0
        for j in range(-RIVAL_REACH, RIVAL_REACH + 1):
            for i in range(-RIVAL_REACH, RIVAL_REACH + 1):
                if not (0 <= row + j < rows and 0 <= column + i < columns):
                    continue
                unlike = abs(float(samples1[row + j, column + i]) - float(samples1[row, column])) / alike
                weight = np.exp(-unlike - 0.5 * (i * i + j * j) / radius**2)
                if not np.isfinite(weight):
                    continue
                shift = int(np.floor(by_row * j + by_column * i + 0.5))
                total += weight * costs[row + j, column + i, np.clip(number + shift, 0, levels - 1)]
                weights += weight
        own, other = np.abs(number - level) <= 1.0, np.abs(number - level) > apart
        if own.any() and other.any() and weights > 0.0:
            out[n] = total[own].min() / weights, total[other].min() / weights
    return out


def level_planes(
    winners: np.ndarray,
    seen: np.ndarray,
    brightness: np.ndarray,
    samples: np.ndarray,
    *,
    reach: int,
    radius: float,
    alike: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return planes (N, 3), normal matrices (N, 3, 3), and the share of samples that agree and their variance, (N,)."""
    planes, normals, agree, variance = [], [], [], []
    for row, column in samples:
        r, c = np.indices(winners.shape)
        near = seen & (abs(r - row) <= reach) & (abs(c - column) <= reach)
        y, x, level = (r - row)[near], (c - column)[near], winners[near]
        unlike = np.abs(brightness[near] - brightness[row, column]) / alike
        weight = np.exp(-unlike - 0.5 * (x * x + y * y) / radius**2)
        X, plane = np.stack([np.ones(len(x)), y, x], axis=1), np.array([winners[row, column], 0.0, 0.0])
        for loss in (4.0, 2.0, 1.0, 1.0, None):
            off = level - X @ plane
            w = weight / (1.0 + (off / (loss or 1.0)) ** 2) ** 2
            normal = X.T @ (w[:, None] * X) + np.diag([1e-6, 1e-2, 1e-2])
            if loss is not None:
                # Relative to the level of the middle, as its slants are pulled to a flat surface.
                plane = np.linalg.solve(normal, X.T @ (w * (level - winners[row, column])))
                plane[0] += winners[row, column]
        planes.append(plane)
        normals.append(normal)
        agree.append(w.sum() / weight.sum())
        variance.append(np.sum(w * off**2) / w.sum())
    return np.array(planes), np.array(normals), np.array(agree), np.array(variance)
