"""Propagate corner noise and calibration errors to a length, a depth, a plane or an angle.

The first-order change of a quantity g of points X_i, with pixels q_i in the cameras and calibration theta (intrinsics
and extrinsics), is

    dg = sum_i c_i . dX_i,      dX = A (dq - D dtheta),      A = (J^T J)^-1 J^T,

where J = d q / d X and D = d q / d theta stack both cameras (the points are triangulated by least squares). One camera
measures only directions: its points are at the stated distance, and A = r d ray / d pixel is perpendicular to the ray.
Corners have independent noise; the calibration is common to all points of a measurement, the boards' scale to all
lengths.

Errors along the rays are many times those perpendicular to them. If they do not change a length or an angle to first
order, they do to second: a length becomes longer, an angle smaller. With the Hessian H of g by the points, and C their
covariance, q = dX^T H dX / 2 has the mean square

    E q^2 = tr(HC)^2 / 4 + tr(HCHC) / 2

(JCGM 100 "GUM", 5.1.2, note; q and dg are uncorrelated). That of the corners' noise alone is added to their variance;
what the calibration's errors add to it, to that of the lenses. For the flatness of a plane it is negligible.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rigkit.calibration.rig.certainty.uncertainty import RigProjection
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Points, Rays, scaled_pinv
from rigkit.core.errors import DegenerateError
from rigkit.core.measurement_task import Quantity, Task
from rigkit.geometry.rigid3 import Rigid3
from rigkit.validation.monitoring.evidence import Monitored

PLANE_POINTS = 5
"""Points along each side of a measured plane."""
ANGLE_TURNS = 8
"""Orientations of a measured right angle about its vertex, a multiple of four: half right angles apart, so that an
error that shears a square and one that stretches it are both seen (at one orientation the other is missed)."""
OF_CORNERS, OF_LENSES, OF_MOUNTS, OF_SCALE, OF_DISTANCE = "corners", "lenses", "mounts", "board scale", "distance"
"""Causes of error."""

MAP_CELLS = (33, 25)
"""Columns and rows of the grid on which the bound is evaluated."""


def measured_points(rays: Rays, task: Task, is_rig: bool) -> tuple[Points, FloatArray]:
    """Return the measured points (N, K, 3) around N `rays`, in the first camera's frame, and the gradients (N, M, K, 3)
    of M quantities by these points."""
    level = np.cross(np.broadcast_to([0.0, 1.0, 0.0], rays.shape), rays)
    steep = np.linalg.norm(level, axis=-1, keepdims=True) < 1e-6
    level = np.where(steep, [1.0, 0.0, 0.0], level)
    level -= np.sum(level * rays, axis=-1, keepdims=True) * rays
    level /= np.linalg.norm(level, axis=-1, keepdims=True)
    upright = np.cross(rays, level)
    middle, half = task.distance_mm * rays, 0.5 * task.size_mm
    if task.quantity is Quantity.DEPTH:
        points = np.stack([middle - half * rays, middle + half * rays], axis=1)
        return points, np.stack([-rays, rays], axis=1)[:, None]
    if task.quantity is Quantity.ANGLE:
        turn = 2.0 * np.pi / ANGLE_TURNS * np.arange(ANGLE_TURNS)[:, None]
        edges = np.cos(turn) * level[:, None] + np.sin(turn) * upright[:, None]
        points = middle[:, None] + task.size_mm * np.concatenate([np.zeros_like(rays)[:, None], edges], axis=1)
        # cos = a . b with unit edges a and b: at a right angle d angle = -(da . b + db . a).
        turned = np.zeros((len(rays), ANGLE_TURNS, 1 + ANGLE_TURNS, 3))
        one, other = np.arange(ANGLE_TURNS), _other_edges()
        turned[:, one, 0] = edges + edges[:, other]
        turned[:, one, 1 + one], turned[:, one, 1 + other] = -edges[:, other], -edges
        return points, turned / task.size_mm
    if task.quantity is Quantity.PLANE:
        steps = np.linspace(-half, half, PLANE_POINTS)
        x, y = (side.ravel() for side in np.meshgrid(steps, steps))
        points = middle[:, None] + x[:, None] * level[:, None] + y[:, None] * upright[:, None]
        basis = np.stack([np.ones_like(x), x, y], axis=1)
        left_over = np.eye(len(x)) - basis @ np.linalg.pinv(basis)
        return points, left_over[None, :, :, None] * rays[:, None, None, :]
    points = np.stack(
        [middle + sign * half * direction for direction in (level, upright) for sign in (-1.0, 1.0)], axis=1
    )
    by_points = np.zeros((len(rays), 2, 4, 3))
    for k, direction in enumerate((level, upright)):
        own = slice(2 * k, 2 * k + 2)
        by_ends = np.stack([-direction, direction], axis=1)
        if not is_rig:
            # length = 2 D tan(angle / 2): moving an end by s perpendicular to its ray changes the angle by s / range.
            opening = task.distance_mm * (1.0 + (half / task.distance_mm) ** 2) / np.hypot(task.distance_mm, half)
            sight = points[:, own] / np.linalg.norm(points[:, own], axis=-1, keepdims=True)
            by_ends = by_ends - np.sum(by_ends * sight, axis=-1, keepdims=True) * sight
            by_ends = opening * by_ends / np.linalg.norm(by_ends, axis=-1, keepdims=True)
        by_points[:, k, own] = by_ends
    return points, by_points


def hessians(points: Points, quantity: Quantity) -> FloatArray:
    """Return the Hessians (N, M, 3 K, 3 K) of M lengths, depths or angles by their `measured_points` (N, K, 3)."""
    count = points.shape[1]
    each = []
    if quantity is Quantity.ANGLE:
        edges = points[:, 1:] - points[:, :1]
        square = np.sum(edges[:, 0] ** 2, axis=-1)[:, None, None]
        for one, other in enumerate(_other_edges()):
            a, b = (edges[:, end] / np.sqrt(square[:, 0]) for end in (one, other))
            along = np.cross(a, b)
            # angle = -(da . r)(db . r) + (da . a)(da . b) + (db . a)(db . b) over the square, with r across both edges.
            own = (a[:, :, None] * b[:, None, :] + b[:, :, None] * a[:, None, :]) / square
            both = -along[:, :, None] * along[:, None, :] / square
            by_edge = np.block([[own, both], [both, own]])
            out = _differences([(0, 1 + one), (0, 1 + other)], count)
            each.append(out.T @ by_edge @ out)
        return np.asarray(np.stack(each, axis=1))
    for first in range(0, count, 2):
        direction = points[:, first + 1] - points[:, first]
        length = np.linalg.norm(direction, axis=-1)[:, None, None]
        unit = direction / length[:, 0]
        across = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / length
        out = _differences([(first, first + 1)], count)
        each.append(out.T @ across @ out)
    return np.asarray(np.stack(each, axis=1))


def _other_edges() -> IntArray:
    """Return the index of the second edge of the right angle that begins with each edge, (ANGLE_TURNS,)."""
    return np.roll(np.arange(ANGLE_TURNS), -(ANGLE_TURNS // 4))


def _differences(pairs: Sequence[tuple[int, int]], count: int) -> FloatArray:
    """Return the matrix (3 P, 3 count) that maps `count` stacked points to the stacked differences of P pairs."""
    out = np.zeros((len(pairs), count))
    for row, (start, end) in enumerate(pairs):
        out[row, start], out[row, end] = -1.0, 1.0
    return np.asarray(np.kron(out, np.eye(3)))


class Gradients(NamedTuple):
    """Derivatives of M quantities at each of N places, and of their K points, for C cameras, one or two.

    Attributes
    ----------
    by_corner : (N, M, K, 2 C) d quantity / d pixel.
    by_calibration : (N, M, P) d quantity / d calibration, in the order of `Layout.of_cameras`.
    points_by_pixel : (N, K, 3, 2 C) d point / d pixel.
    points_by_calibration : (N, K, 3, P) d point / d calibration.
    seen : (N,) whether all cameras see the place.
    """

    by_corner: FloatArray
    by_calibration: FloatArray
    points_by_pixel: FloatArray
    points_by_calibration: FloatArray
    seen: BoolArray


def gradients(
    cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3], points: Points, weights: FloatArray
) -> Gradients:
    """Return the derivatives at `points` (N, K, 3) mm with the gradients `weights` (N, M, K, 3) of the quantities, both
    in the frame of the first camera."""
    layout, placed = Layout.of_cameras(cameras), zip(cameras, cam_from_rig, strict=True)
    rig_from_first = cam_from_rig[0].inverse()
    in_rig = rig_from_first.apply(points)
    each = [RigProjection.of(camera, pose, in_rig, layout, k) for k, (camera, pose) in enumerate(placed)]
    seen = np.all([own.seen for own in each], axis=(0, 2))
    J, D = (
        np.where(seen[:, None, None, None], np.concatenate(part, axis=2), 0.0)
        for part in (
            [own.d_pixels_d_point @ rig_from_first.rotation for own in each],
            [own.d_pixels_d_globals for own in each],
        )
    )
    if len(cameras) > 1:
        normal = np.swapaxes(J, -1, -2) @ J
        # Any invertible matrix will do out of view.
        normal[~seen] = np.eye(3)
        try:
            by_pixel = np.linalg.solve(normal, np.swapaxes(J, -1, -2))
        except np.linalg.LinAlgError as error:
            raise DegenerateError(
                "certificate: the cameras look from one place, so that nothing they see has a distance; give two that "
                "are apart"
            ) from error
    else:
        # The pseudo-inverse of a 2x3 Jacobian moves a point perpendicular to its ray.
        by_pixel = np.linalg.pinv(J)
    by_corner = np.einsum("nmkx,nkxp->nmkp", weights, by_pixel)
    by_calibration = -np.einsum("nmkp,nkpt->nmt", by_corner, D)
    return Gradients(by_corner, by_calibration, by_pixel, -by_pixel @ D, seen)


def variances(instrument: Monitored, task: Task, points: Points, found: Gradients) -> dict[str, FloatArray]:
    """Return the variance (N, M) by each cause, from `points` (N, K, 3) and their `gradients`.

    The part of the extrinsics' error that is correlated with the lenses counts as theirs: dm = C_ml C_ll^-1 dl + rest.
    """
    split = instrument.layout.cameras[-1].stop
    covariance = instrument.covariance
    lens, mount = found.by_calibration[..., :split], found.by_calibration[..., split:]
    own = covariance[:split, :split]
    follows = covariance[split:, :split] @ scaled_pinv(own)
    with_lens = lens + mount @ follows
    variance = {
        OF_CORNERS: instrument.sigma_px**2 * np.sum(found.by_corner**2, axis=(-1, -2)),
        OF_LENSES: np.einsum("nmi,ij,nmj->nm", with_lens, own, with_lens),
    }
    if instrument.is_rig and task.quantity is not Quantity.PLANE:
        bent, noise, errors = hessians(points, task.quantity), *_of_points(instrument, found)
        by_noise, by_both = _second_order(bent, noise), _second_order(bent, noise + errors)
        variance[OF_CORNERS] = variance[OF_CORNERS] + by_noise
        variance[OF_LENSES] = variance[OF_LENSES] + by_both - by_noise
    if instrument.is_rig:
        rest = covariance[split:, split:] - follows @ covariance[:split, split:]
        variance[OF_MOUNTS] = np.einsum("nmi,ij,nmj->nm", mount, rest, mount)
    if task.quantity in (Quantity.LENGTH, Quantity.DEPTH):
        relative = instrument.scale_sigma if instrument.is_rig else task.distance_sigma_mm / task.distance_mm
        cause = OF_SCALE if instrument.is_rig else OF_DISTANCE
        variance[cause] = np.full(lens.shape[:2], (relative * task.size_mm) ** 2)
    return {cause: np.maximum(value, 0.0) for cause, value in variance.items()}


def systematic(instrument: Monitored, by_calibration: FloatArray) -> FloatArray:
    """Return the square (N, M) of the error that is expected, from `gradients`: a part of the lenses' variance."""
    square = np.einsum("nmi,ij,nmj->nm", by_calibration, instrument.mean_products, by_calibration)
    return np.asarray(np.maximum(square, 0.0))


def _of_points(instrument: Monitored, found: Gradients) -> tuple[FloatArray, FloatArray]:
    """Return the covariances (N, 3 K, 3 K), mm^2, of the points by the corners' noise and by the calibration's
    errors."""
    by_pixel, by_calibration = found.points_by_pixel, found.points_by_calibration
    count, points = by_pixel.shape[:2]
    noise = np.zeros((count, points, 3, points, 3))
    own = instrument.sigma_px**2 * by_pixel @ np.swapaxes(by_pixel, -1, -2)
    noise[:, np.arange(points), :, np.arange(points)] = np.moveaxis(own, 1, 0)
    stacked = by_calibration.reshape(count, 3 * points, -1)
    return noise.reshape(count, 3 * points, -1), stacked @ instrument.covariance @ np.swapaxes(stacked, -1, -2)


def _second_order(bent: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the mean square (N, M) of the second-order change, from the `hessians` and the covariance (N, 3 K, 3 K) of
    the points."""
    moved = bent @ covariance[:, None]
    trace = np.trace(moved, axis1=-2, axis2=-1)
    return np.asarray(0.25 * trace**2 + 0.5 * np.einsum("nmij,nmji->nm", moved, moved))
