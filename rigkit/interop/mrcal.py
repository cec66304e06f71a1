"""mrcal's .cameramodel: pinhole, OpenCV models of 4, 5, 8 and 12 terms, stereographic, CAHVOR, and its splines.

Pixel (0, 0) is the centre of the first pixel, as in rigkit; lengths are in metres; the pose is rt_cam_ref, a rotation
vector and a translation. The splined model, a grid of control points of a bicubic B-spline, fits any smooth lens. It is
written for fisheye lenses, which no other model of mrcal fits. Splines, CAHVOR and thin prisms are refitted when read.
"""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from typing import Any

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Pixels, Rays
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3
from rigkit.interop.exchange import MM_PER_M, PERSPECTIVE, Written, best_accepted, camera_of, field, image_size, numbers
from rigkit.interop.foreign_lenses import brown_prism_lens, cahvor_lens
from rigkit.interop.nearest import nearest_camera_of

SPLINED = re.compile(
    r"^LENSMODEL_SPLINED_STEREOGRAPHIC_(?:spline_)?order=(?P<order>\d)_Nx=(?P<nx>\d{1,4})_Ny=(?P<ny>\d{1,4})_fov_x_deg=(?P<fov>\d{1,3})$"
)
KNOTS_X = 40
MAX_FOV_DEG = 350
"""Field of view: the stereographic plane is infinite at 360."""
MAX_KNOTS_Y = 160
"""An image four times as high as wide, in angle, is damage rather than a lens, and takes 330 MB."""
SMOOTHING = 1e-6
"""Weight of the second differences of the control points, which extrapolates the surface over the image border."""
SPLINE_GRID = (161, 121)
"""Grid of pixels at which the spline is fitted."""
CHECK_GRID = (233, 187)
"""Another grid, at which its error is measured."""
CLOSE_ENOUGH_PX = 0.1
"""A parametric model with a smaller error is preferred to the spline: more programs read it."""
INTRINSICS = {"PINHOLE": 4, "STEREOGRAPHIC": 4, "OPENCV4": 8, "OPENCV5": 9, "OPENCV8": 12, "OPENCV12": 16, "CAHVOR": 9}
"""Numbers of parameters of the lens models that are read, besides splines."""


def write_cameramodel(camera: Camera, cam_from_ref: Rigid3 | None = None, *, outline: Pixels | None = None) -> Written:
    """Return the camera as a .cameramodel file.

    `cam_from_ref` is its pose, by default the identity; `outline` (N, 2) of the corners is its valid-intrinsics region.
    """
    pose = Rigid3.identity() if cam_from_ref is None else cam_from_ref
    try:
        chosen = best_accepted(camera, PERSPECTIVE, "mrcal")
    except InputError:
        chosen = None
    if chosen is not None and chosen.covered == 1.0 and chosen.max_error_px < CLOSE_ENOUGH_PX:
        p = chosen.camera.parameters
        lens = {4: "PINHOLE", 8: "OPENCV4", 9: "OPENCV5", 12: "OPENCV8"}[p.size]
        return replace(chosen, text=_text(f"LENSMODEL_{lens}", p, camera.size_px, pose, outline))
    lens, intrinsics = _spline_of(camera)
    pixels, rays = _samples(camera, CHECK_GRID)
    projected, inside = _spline_project(rays, lens, intrinsics)
    error = np.linalg.norm(projected - pixels, axis=-1)[inside]
    note = f"written as a spline of {(intrinsics.size - 4) // 2} knots, off by {error.max():.2g} px at most"
    text = _text(lens, intrinsics, camera.size_px, pose, outline)
    return Written(camera, float(error.max()), float(inside.mean()), note, text)


def read_cameramodel(text: str, name: str = "cameramodel") -> tuple[Camera, Rigid3, float]:
    """Return the camera, cam_from_ref, and the largest error of a refit, px (0 without refit).

    A lens that rigkit wrote as a spline comes back as its original model. Raises InputError for damaged files and for
    unknown lens models (CAHVORE, panoramas).
    """
    try:
        data = ast.literal_eval(text[text.index("{") :])
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        data = None
    if not isinstance(data, dict):
        raise InputError(f"'{name}': not a .cameramodel of mrcal, a dictionary of Python; is the file whole?")
    lens = str(data.get("lensmodel", data.get("lens_model", "")))
    size = image_size(field(data, "imagersize", name), name, "imagersize")
    intrinsics = numbers(field(data, "intrinsics", name), name, "intrinsics")
    pose_key = "rt_cam_ref" if "rt_cam_ref" in data else "extrinsics"
    rt = numbers(field(data, pose_key, name), name, pose_key, 6)
    pose = Rigid3(exp_so3(rt[:3]), rt[3:] * MM_PER_M)
    camera, error_px = _camera_of_model(lens, intrinsics, size, name)
    return camera, pose, error_px


def _camera_of_model(lens: str, intrinsics: FloatArray, size_px: tuple[int, int], name: str) -> tuple[Camera, float]:
    """Return the camera of a lens model and its intrinsics, and the largest error of a refit, px (0 without refit)."""
    kind = lens.removeprefix("LENSMODEL_")
    if SPLINED.match(lens) is not None:
        return _from_spline(lens, intrinsics, size_px, name)
    if kind not in INTRINSICS:
        raise InputError(
            f"'{name}': lens model '{lens}' is not supported; known: {', '.join(INTRINSICS)}, splined (cubic); bring "
            "it into one of them with mrcal-convert-lensmodel"
        )
    if intrinsics.size != INTRINSICS[kind]:
        raise InputError(
            f"'{name}': {lens} has {INTRINSICS[kind]} intrinsics, found {intrinsics.size}; is the file whole?"
        )
    if kind == "STEREOGRAPHIC":
        # 2 f tan(theta / 2) is the unified model with alpha one half.
        return camera_of("ucm", size_px, np.append(intrinsics, 0.5), name), 0.0
    core, terms = intrinsics[:4], intrinsics[4:]
    if kind == "CAHVOR":
        return nearest_camera_of(cahvor_lens(core, terms[:2], terms[2:]), size_px, name, np.pi / 2.0)
    if kind == "OPENCV12" and terms[8:].any():
        return nearest_camera_of(brown_prism_lens(core, terms), size_px, name, np.pi / 2.0)
    return camera_of("brown" if terms.size else "pinhole", size_px, intrinsics[:12], name), 0.0


def _text(lens: str, intrinsics: FloatArray, size_px: tuple[int, int], pose: Rigid3, outline: Pixels | None) -> str:
    rt = [*log_so3(pose.rotation).tolist(), *(pose.translation_mm / MM_PER_M).tolist()]
    region = ""
    if outline is not None:
        closed = ", ".join(f"[ {x:.1f}, {y:.1f} ]" for x, y in [*outline, outline[0]])
        region = f"\n    # where boards were seen\n    'valid_intrinsics_region': [ {closed},],\n"
    return (
        "# lengths in metres, pixels with (0, 0) at the centre of the top-left one\n"
        "{\n"
        f"    'lensmodel':  '{lens}',\n\n"
        f"    'intrinsics': [ {', '.join(repr(float(v)) for v in intrinsics)},],\n\n"
        "    # rotation vector and translation of the camera against the reference\n"
        f"    'extrinsics': [ {', '.join(repr(float(v)) for v in rt)},],\n\n"
        f"    'imagersize': [ {size_px[0]}, {size_px[1]},],\n"
        f"{region}}}\n"
    )


def _samples(camera: Camera, grid: tuple[int, int]) -> tuple[Pixels, Rays]:
    u, v = (np.linspace(-0.5, size - 0.5, count) for size, count in zip(camera.size_px, grid, strict=True))
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    return pixels[valid], rays[valid]


def _stereographic(rays: Rays) -> FloatArray:
    """Return 2 tan(theta / 2) (x, y) / r of unit rays."""
    return np.asarray(2.0 * rays[..., :2] / (1.0 + rays[..., 2:]))


def _spline_of(camera: Camera) -> tuple[str, FloatArray]:
    """Return lens model and intrinsics of the spline that fits the camera, by linear least squares."""
    pixels, rays = _samples(camera, SPLINE_GRID)
    if not len(rays):
        raise InputError("mrcal: this camera has no valid rays in its image; calibrate again")
    if (rays[:, 2] < np.cos(np.radians(MAX_FOV_DEG / 2.0))).any():
        raise InputError(
            f"mrcal: the field of view is beyond {MAX_FOV_DEG} degrees, where its splines end; choose another format"
        )
    u = _stereographic(rays)
    # The spline covers fov_x_deg horizontally, and vertically as much as its knots.
    half_x, half_y = 2.0 * np.arctan(np.abs(u).max(axis=0) / 2.0)
    fov_x = int(np.ceil(np.degrees(2.0 * half_x))) + 2
    reach = 2.0 * np.tan(np.radians(fov_x) / 4.0)
    ny = int(np.ceil((KNOTS_X - 3) * 2.0 * np.tan(half_y / 2.0) / reach)) + 4
    if ny > MAX_KNOTS_Y:
        raise InputError(
            f"mrcal: in angle this camera's image is {ny / KNOTS_X:.0f} times as high as wide, which its splines do "
            "not follow; check its fx and fy"
        )
    lens = f"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={KNOTS_X}_Ny={ny}_fov_x_deg={fov_x}"
    focal, centre = camera.focal_px, camera.axis_px
    basis, inside = _basis(u, lens)
    target = ((pixels - centre) / focal - u)[inside]
    normal = (basis[inside].T @ basis[inside]).toarray()
    normal += SMOOTHING * _roughness(KNOTS_X, ny)
    control = np.linalg.solve(normal, basis[inside].T @ target)
    return lens, np.concatenate([[focal, focal, *centre], control.reshape(-1)])


def _roughness(nx: int, ny: int) -> FloatArray:
    """Return the matrix of the quadratic form: sum of squared second differences of control points in x and y."""
    dx, dy = (np.diff(np.eye(n), 2, axis=0) for n in (nx, ny))
    return np.asarray(np.kron(np.eye(ny), dx.T @ dx) + np.kron(dy.T @ dy, np.eye(nx)))


def _spline_project(rays: Rays, lens: str, intrinsics: FloatArray) -> tuple[Pixels, BoolArray]:
    """Return pixels = f (u + surface(u)) + centre, and a mask of the rays inside the spline's knots."""
    u = _stereographic(rays)
    basis, inside = _basis(u, lens)
    surface = basis @ intrinsics[4:].reshape(-1, 2)
    return intrinsics[:2] * (u + surface) + intrinsics[2:4], inside


def _basis(u: FloatArray, lens: str) -> tuple[Any, BoolArray]:
    """Return the sparse matrix (N, Ny Nx) of the bicubic B-spline at u, and a mask of points with all 4x4 knots."""
    from scipy import sparse

    match = SPLINED.match(lens)
    if match is None or match["order"] != "3":
        raise InputError(f"lens model '{lens}': only cubic splines are supported")
    count = np.array([int(match["nx"]), int(match["ny"])])
    if (count < 4).any() or not 0 < int(match["fov"]) < 360:
        raise InputError(f"lens model '{lens}': at least 4 knots each way and a field of view below 360 degrees")
    segments_per_u = (count[0] - 3) / (4.0 * np.tan(np.radians(int(match["fov"])) / 4.0))
    position = u * segments_per_u + (count - 1) / 2.0
    cell = np.floor(position)
    inside = ((cell >= 1) & (cell + 2 <= count - 1)).all(axis=-1)
    cell = np.clip(np.nan_to_num(cell), 1, count - 3).astype(np.int64)
    t = position - cell
    cubics = [(1.0 - t) ** 3, 3.0 * t**3 - 6.0 * t**2 + 4.0, -3.0 * t**3 + 3.0 * t**2 + 3.0 * t + 1.0, t**3]
    weights = np.stack(cubics, axis=-1) / 6.0
    step = np.arange(4)
    columns = (cell[:, 1, None, None] + step[:, None] - 1) * count[0] + cell[:, 0, None, None] + step - 1
    values = weights[:, 1, :, None] * weights[:, 0, None, :]
    rows = np.repeat(np.arange(len(u)), 16)
    shape = (len(u), int(count.prod()))
    return sparse.csr_array((values.reshape(-1), (rows, columns.reshape(-1))), shape=shape), inside


def _from_spline(lens: str, intrinsics: FloatArray, size_px: tuple[int, int], name: str) -> tuple[Camera, float]:
    """Return the camera that fits the spline best over the image, and its largest error, px."""
    match = SPLINED.match(lens)
    assert match is not None
    if intrinsics.size != 4 + 2 * int(match["nx"]) * int(match["ny"]):
        raise InputError(f"'{name}': {lens} needs {int(match['nx'])} x {int(match['ny'])} knots; is the file whole?")
    reach_rad = np.radians(min(2.0 * int(match["fov"]), MAX_FOV_DEG)) / 2.0
    return nearest_camera_of(
        lambda rays: _spline_project(rays, lens, intrinsics), size_px, name, float(reach_rad), worst_px=np.inf
    )
