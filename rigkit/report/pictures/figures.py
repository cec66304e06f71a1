"""Pictures of a reconstructed pair: corners, epipolar curves, and the oriented cloud with both cameras.

Figures use matplotlib's object interface, without global state or display.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.cameras.compare import CameraDifference
from rigkit.core.arrays import FloatArray, Pixels, in_8_bits
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.report.pictures.scene_view import PYRAMID
from rigkit.report.svg import round_down

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BOARD_COLOURS = ("#e6550d", "#1f77b4", "#2ca02c", "#9467bd", "#d6b300", "#17becf", "#e377c2", "#7f7f7f")
"""Colours of boards in all pictures, readable on dark and light images."""

MIN_SHOWN_PX = 1e-4
"""Smaller differences of cameras are not drawn."""
DPI = 110
MAP_PROPORTION = 0.62 / 0.77
"""Beside its scale a map has this part of the figure's width, and of its height: no bands remain."""
NORMAL_LENGTH_SQUARES = 0.8
BARE_NORMAL = 0.08
"""Length of a drawn normal without boards, relative to the median distance of the points."""
BARE_POINT = 1.5
MAX_NORMALS = 300
"""Maximum number of normals drawn for a cloud without boards."""
NORMAL_COLOUR = "#1f6fd0"
PYRAMID_DEPTH_IN_FIGURE = 0.18
"""Depth of a drawn camera pyramid, relative to the median distance of the points."""

FAR = 4.0
"""Points farther than this many times the median distance are outside of the picture's limits."""

FILL = 0.8
"""Fraction of the picture that the box around the scene fills; the rest is for the numbers along its edges."""

SIDE_PAD, ABOVE_PAD = 10.0, 24.0
"""Typographic points between the depth axis and its name, seen from the side and from above."""

CURVE_SAMPLES = 240
JPEG_QUALITY = 85
PAIR_RIM, PAIR_TOP = 0.005, 0.95
"""Margin and top of the two images in their figure; the title is above."""
DARK_GROUND, DARK_WORDS = "#14181f", "#c8cfda"
"""Colours of dark pages."""


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return an empty figure of `width` x `height` inches, without a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **options)
    FigureCanvasAgg(figure)
    return figure


def board_colour(index: int) -> str:
    """Return the colour of a board in all pictures."""
    return BOARD_COLOURS[index % len(BOARD_COLOURS)]


def corners_figure(reconstruction: Reconstruction, image1: NDArray[Any], image2: NDArray[Any]) -> Figure:
    """Draw the matched corners over both images: rows joined, first corner marked, boards named."""
    figure, axes = pair_axes(image1, image2)
    for axis, pixels in zip(axes, (reconstruction.pixels1, reconstruction.pixels2), strict=True):
        _draw_boards(axis, reconstruction, pixels)
    axes[0].set_title(f"{reconstruction.pair_id}: corners, view 1", fontsize=9, y=1.0)
    axes[1].set_title("view 2 (ring: first corner)", fontsize=9, y=1.0)
    return figure


def epipolar_figure(
    reconstruction: Reconstruction, image1: NDArray[Any], image2: NDArray[Any], *, every: int = 7
) -> Figure:
    """Draw every `every`-th corner and its epipolar curve over both images; the curve passes through the corner."""
    figure, axes = pair_axes(image1, image2)
    chosen = np.arange(0, len(reconstruction.pixels1), every)
    pose = reconstruction.cam2_from_cam1
    for axis, camera, other, pixels, other_pixels, motion in (
        (
            axes[0],
            reconstruction.camera1,
            reconstruction.camera2,
            reconstruction.pixels1,
            reconstruction.pixels2,
            pose.inverse(),
        ),
        (axes[1], reconstruction.camera2, reconstruction.camera1, reconstruction.pixels2, reconstruction.pixels1, pose),
    ):
        curves = epipolar_curves(other, camera, motion, other_pixels[chosen])
        boards = reconstruction.matches.board_index[chosen]
        for board in np.unique(boards):
            on, colour = boards == board, board_colour(int(board))
            # One line for each board, with gaps between curves: matplotlib is slow with many lines.
            gapped = np.pad(curves[on], ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)
            axis.plot(gapped[:, 0], gapped[:, 1], color=colour, linewidth=0.7)
            dots = {"marker": "o", "markersize": 3.5, "markeredgecolor": "white", "markeredgewidth": 0.5}
            axis.plot(*pixels[chosen[on]].T, linestyle="none", color=colour, **dots)
        axis.set_xlim(-0.5, camera.size_px[0] - 0.5)
        axis.set_ylim(camera.size_px[1] - 0.5, -0.5)
    rms = reconstruction.sampson_rms_px
    axes[0].set_title(f"{reconstruction.pair_id}: epipolar curves, Sampson rms {rms:.3f} px", fontsize=9, y=1.0)
    passed = "corner" if reconstruction.boards else "point"
    axes[1].set_title(f"view 2 (each curve passes through its {passed})", fontsize=9, y=1.0)
    return figure


def epipolar_curves(camera1: Camera, camera2: Camera, cam2_from_cam1: Rigid3, pixels1: Pixels) -> FloatArray:
    """Return the epipolar curves of `pixels1` (N, 2) in image 2 as (N, CURVE_SAMPLES, 2), NaN where not in view.

    The curve is the image of the viewing ray from the epipole to the vanishing point: straight in a perspective view,
    curved in a fisheye image.
    """
    rays, _ = camera1.unproject(pixels1)
    towards = rays @ cam2_from_cam1.rotation.T
    origin = cam2_from_cam1.translation_mm / np.linalg.norm(cam2_from_cam1.translation_mm)
    mix = np.linspace(0.0, 1.0, CURVE_SAMPLES)[:, None]
    # Directions between the epipole and the vanishing point all lie in the epipolar plane.
    directions = (1.0 - mix) * origin + mix * towards[:, None, :]
    pixels, valid = camera2.project(directions)
    width, height = camera2.size_px
    inside = valid & (pixels >= -0.5).all(axis=-1) & (pixels[..., 0] < width) & (pixels[..., 1] < height)
    return np.where(inside[..., None], pixels, np.nan)


def cloud_figure(reconstruction: Reconstruction, *, unit: str = "mm") -> Figure:
    """Draw the oriented cloud from two directions: points and normals by board, cameras as pyramids."""
    figure = new_figure(13, 6, dpi=DPI)
    figure.subplots_adjust(left=0.0, right=0.97, bottom=0.02, top=0.94, wspace=0.0)
    cloud = reconstruction.cloud
    scene = cloud.points_mm
    reach = float(np.median(np.linalg.norm(scene, axis=1)))
    square = (
        float(np.mean([b.square_x_mm for b in reconstruction.boards])) if reconstruction.boards else reach * BARE_NORMAL
    )
    for place, (elevation, azimuth) in enumerate(((18.0, -70.0), (65.0, -90.0))):
        axis: Any = figure.add_subplot(1, 2, place + 1, projection="3d")
        for index, name in enumerate((*cloud.board_ids, "no board")):
            on = cloud.board_index == (index if index < len(cloud.board_ids) else -1)
            if not on.any():
                continue
            p, n = _in_plot_axes(scene[on]), _in_plot_axes(cloud.normals[on]) * square * NORMAL_LENGTH_SQUARES
            if not reconstruction.boards:
                # In the colours of the images, with few normals.
                axis.scatter(*p.T, s=BARE_POINT, c=cloud.colours[on] / 255.0, depthshade=False, linewidths=0)
                some = np.s_[:: max(1, len(p) // MAX_NORMALS)]
                axis.quiver(*p[some].T, *n[some].T, color=NORMAL_COLOUR, linewidth=0.5, arrow_length_ratio=0.0)
                continue
            colour = board_colour(index)
            axis.scatter(*p.T, s=5, color=colour, label=name, depthshade=False)
            axis.quiver(*p.T, *n.T, color=colour, linewidth=0.6, arrow_length_ratio=0.25)
        second = reconstruction.cam2_from_cam1.inverse()
        # Words on the far side of each: they would cover one another where the baseline is short.
        to_the_right = np.array([-np.sin(np.radians(azimuth)), 0.0, np.cos(np.radians(azimuth))])
        sides = ("right", "left") if to_the_right @ second.translation_mm >= 0.0 else ("left", "right")
        cameras = ((Rigid3.identity(), "camera 1", sides[0]), (second, "camera 2", sides[1]))
        depth = reach * PYRAMID_DEPTH_IN_FIGURE
        for cam1_from_cam, name, side in cameras:
            _draw_pyramid(axis, cam1_from_cam, depth, name, side)
        axis.view_init(elev=elevation, azim=azimuth)
        _fit_equal(axis, reconstruction, np.concatenate([_pyramid(pose, depth) for pose, _, _ in cameras]))
        axis.set_xlabel(f"x {unit}", fontsize=7)
        from_above = elevation > 45.0
        axis.set_ylabel(f"z {unit}", fontsize=7, labelpad=ABOVE_PAD if from_above else SIDE_PAD)
        if from_above:
            axis.set_zticks([])
        axis.set_zlabel("" if from_above else f"-y {unit}", fontsize=7)
        axis.tick_params(labelsize=6)
    if reconstruction.boards:
        axis.legend(fontsize=7, loc="upper right")
    title = f"{reconstruction.pair_id}, {reconstruction.affine_method}: {len(cloud)} points, "
    figure.suptitle(f"{title}baseline {reconstruction.baseline_mm:.2f} {unit}", fontsize=10)
    return figure


def pair_pictures(
    r: Reconstruction, image1: NDArray[Any], image2: NDArray[Any], *, pdf: bool = False
) -> dict[str, bytes]:
    """Return the pictures of a pair by relative path; with `pdf` also as PDF."""
    figures = {
        "corners": corners_figure(r, image1, image2),
        "epipolar": epipolar_figure(r, image1, image2),
        "cloud": cloud_figure(r),
    }
    files: dict[str, bytes] = {}
    for name, figure in figures.items():
        files[f"{r.pair_id}/{name}.png"] = as_png(figure)
        if pdf:
            files[f"{r.pair_id}/{name}.pdf"] = as_pdf(figure)
    return files


def difference_png(difference: CameraDifference, name: str = "") -> bytes:
    """Draw the difference of two cameras over the image, with length as colour and arrows, titled by the `name` of the
    camera in its rig."""
    u, v = difference.pixels[..., 0], difference.pixels[..., 1]
    figure = new_figure(8, float(np.clip(8 * MAP_PROPORTION * np.ptp(v) / np.ptp(u), 2.5, 12.0)), dpi=DPI)
    axis: Any = figure.subplots()
    # Rounding errors must not look like a pattern.
    top = max(float(difference.max_px), MIN_SHOWN_PX)
    mesh = axis.pcolormesh(u, v, difference.map_px, shading="nearest", cmap="viridis", vmin=0.0, vmax=top)
    some = np.s_[::3, ::3]
    arrows = difference.difference_px[some]
    words = ""
    if difference.max_px > MIN_SHOWN_PX:
        times = round_down(6.0 * float(u[0, 1] - u[0, 0]) / difference.max_px)
        drawn: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / times}
        axis.quiver(u[some], v[some], *np.moveaxis(arrows, -1, 0), color="white", width=0.002, **drawn)
        words = f" (arrows magnified {times:g} times)"
    axis.set_aspect("equal")
    axis.invert_yaxis()
    figure.colorbar(mesh, ax=axis, label="px")
    words = f"difference {difference.rms_px:.4f} px rms, {difference.max_px:.4f} px at most{words}"
    axis.set_title(f"{name}: {words}" if name else words, fontsize=9)
    return as_png(figure)


def _in_plot_axes(vectors: FloatArray) -> FloatArray:
    """Return vectors in plot axes (x right, y away, z up), from camera axes (x right, y down, z forward)."""
    return np.stack([vectors[..., 0], vectors[..., 2], -vectors[..., 1]], axis=-1)


def _pyramid(cam1_from_cam: Rigid3, depth: float) -> FloatArray:
    """Return tip and base (5, 3) of a camera's pyramid, in plot axes."""
    return _in_plot_axes(cam1_from_cam.apply(depth * PYRAMID))


def _draw_pyramid(axis: Any, cam1_from_cam: Rigid3, depth: float, name: str, side: str) -> None:
    tip, *base = _pyramid(cam1_from_cam, depth)
    # One line through all eight edges; two of them are drawn twice.
    edges = np.stack([tip, base[0], base[1], tip, base[2], base[3], tip, base[3], base[0], base[1], base[2]])
    axis.plot(*edges.T, color="black", linewidth=0.8)
    # Below the tip, so that it does not cover the numbers of an axis.
    axis.text(*tip, f"\n{name}", fontsize=7, horizontalalignment=side, verticalalignment="top", linespacing=0.5)


def _fit_equal(axis: Any, reconstruction: Reconstruction, pyramids: FloatArray) -> None:
    """Set limits around the cloud and the cameras' `pyramids` (N, 3), in plot axes, with equal scales on all axes, and
    fill the picture with that box."""
    from mpl_toolkits.mplot3d import proj3d

    points = reconstruction.cloud.points_mm
    distance = np.linalg.norm(points, axis=1)
    points = points[distance < FAR * np.median(distance)]
    everything = np.concatenate([_in_plot_axes(points), pyramids])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.05 * (high - low).max()
    low, high = low - margin, high + margin
    axis.set_xlim(low[0], high[0])
    axis.set_ylim(low[1], high[1])
    axis.set_zlim(low[2], high[2])
    axis.set_box_aspect(high - low)
    ends = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3)
    u, v, _ = proj3d.proj_transform(*ends.T, axis.get_proj())
    seen = axis.transData.transform(np.stack([u, v], axis=1)) - axis.transData.transform((0.0, 0.0))
    room = 0.5 * np.array([axis.bbox.width, axis.bbox.height])
    axis.set_box_aspect(high - low, zoom=FILL * float((room / np.abs(seen).max(axis=0)).min()))


def _draw_boards(axis: Any, reconstruction: Reconstruction, pixels: Pixels) -> None:
    matches = reconstruction.matches
    for index, board in enumerate(reconstruction.boards):
        on = np.flatnonzero(matches.board_index == index)
        if not len(on):
            continue
        order = on[np.lexsort((matches.grid[on, 0], matches.grid[on, 1]))]
        p = pixels[order]
        colour = board_colour(index)
        # A gap after every row: lines along rows show the order of the corners.
        ends = np.flatnonzero(np.diff(matches.grid[order, 1])) + 1
        rows = np.insert(p, ends, np.nan, axis=0)
        axis.plot(rows[:, 0], rows[:, 1], color=colour, linewidth=0.8, alpha=0.8)
        axis.scatter(p[:, 0], p[:, 1], s=7, color=colour, linewidths=0)
        axis.plot(*p[0], marker="o", markersize=9, markerfacecolor="none", markeredgecolor=colour, markeredgewidth=1.5)
        label = {"boxstyle": "round,pad=0.2", "facecolor": "white", "alpha": 0.75, "linewidth": 0}
        axis.text(*p.mean(axis=0), board.board_id, color=colour, fontsize=8, ha="center", va="center", bbox=label)


def pair_axes(image1: NDArray[Any], image2: NDArray[Any]) -> tuple[Figure, Sequence[Any]]:
    """Return a figure with both images side by side, and its axes in pixels of the images."""
    figure = new_figure(14, 7 * image1.shape[0] / image1.shape[1] + 0.35, dpi=DPI)
    axes = figure.subplots(1, 2)
    figure.subplots_adjust(left=PAIR_RIM, right=1.0 - PAIR_RIM, bottom=PAIR_RIM, top=PAIR_TOP, wspace=0.01)
    for axis, image in zip(axes, (image1, image2), strict=True):
        height, width = image.shape[:2]
        fitted = _reduced_rgb(image, axis.bbox.width, axis.bbox.height)
        axis.imshow(fitted, interpolation="antialiased", extent=(-0.5, width - 0.5, height - 0.5, -0.5))
        axis.set_axis_off()
    return figure, axes


def _reduced_rgb(image: NDArray[Any], width: float, height: float) -> NDArray[np.uint8]:
    """Return the image as 8-bit RGB, reduced to `width` x `height` px: matplotlib is ten times slower at that.

    Grey images are stretched to full contrast.
    """
    import cv2

    scale = min(width / image.shape[1], height / image.shape[0], 1.0)
    size = (max(round(scale * image.shape[1]), 1), max(round(scale * image.shape[0]), 1))
    small: NDArray[Any] = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else image
    if image.ndim == 3:
        return in_8_bits(small)
    low, high = int(image.min()), int(image.max())
    shown = ((small.astype(np.float32) - low) * (255.0 / max(high - low, 1))).astype(np.uint8)
    return np.repeat(shown[..., None], 3, axis=2)


def as_png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    import cv2

    # A higher compression hardly reduces photographs, but takes three times as long.
    return bytes(cv2.imencode(".png", _drawn(figure), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def in_dark_colours(draw: Callable[[], bytes]) -> bytes:
    """Return the picture of `draw` in the colours of dark pages."""
    import matplotlib

    grounds = ("figure.facecolor", "axes.facecolor", "savefig.facecolor")
    words = ("axes.edgecolor", "axes.labelcolor", "text.color", "xtick.color", "ytick.color")
    colours: dict[Any, str] = dict.fromkeys(grounds, DARK_GROUND) | dict.fromkeys(words, DARK_WORDS)
    with matplotlib.rc_context(colours):
        return draw()


def pair_jpeg(png: bytes) -> bytes:
    """Return a figure of `pair_axes` as JPEG without title and margin: pages have captions."""
    import cv2

    picture = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
    height, width = picture.shape[:2]
    top, rim = round((1.0 - PAIR_TOP) * height) + 1, round(PAIR_RIM * width)
    cut = picture[top : height - round(PAIR_RIM * height), rim : width - rim]
    return bytes(cv2.imencode(".jpg", cut, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def _drawn(figure: Figure) -> NDArray[np.uint8]:
    """Return the pixels (H, W, 3) of a figure, in BGR order."""
    import cv2

    canvas: Any = figure.canvas
    canvas.draw()
    return np.asarray(cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR), dtype=np.uint8)


def as_pdf(figure: Figure) -> bytes:
    """Return a figure as vector PDF with embedded photographs."""
    import matplotlib

    buffer = io.BytesIO()
    # TrueType fonts: publishers refuse Type 3. No date: the same figure gives the same file.
    with matplotlib.rc_context({"pdf.fonttype": 42}):
        figure.savefig(buffer, format="pdf", metadata={"CreationDate": None})
    return buffer.getvalue()
