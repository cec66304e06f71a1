"""Figures for papers: vectors, the same file every time."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest
from helpers.calibration_scenes import lens, random_views
from helpers.reconstructions import make_reconstruction

from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.compare import compare_cameras
from rigkit.cameras.pinhole import Pinhole
from rigkit.geometry.rigid3 import Rigid3
from rigkit.report.pages.calibration_charts import histogram_svg, images_svg, lens_svg, radius_svg
from rigkit.report.pages.calibration_drawings import coverage_svg, pattern_svg, residuals_svg
from rigkit.report.pictures.figures import (
    as_pdf,
    as_png,
    cloud_figure,
    corners_figure,
    difference_png,
    in_dark_colours,
    new_figure,
)
from rigkit.report.render import asset, data_uri


def test_a_pdf_has_vectors_real_fonts_and_no_date() -> None:
    reconstruction = make_reconstruction()
    width, height = reconstruction.camera1.size_px
    image = np.full((height, width), 100, dtype=np.uint8)
    first, again = (as_pdf(corners_figure(reconstruction, image, image)) for _ in range(2))
    assert first == again
    assert first.startswith(b"%PDF")
    assert b"/Type3" not in first
    assert b"CreationDate" not in first
    # The cloud has no photograph in it: all of it is lines and text.
    assert b"/Subtype /Image" not in as_pdf(cloud_figure(reconstruction))


def test_pictures_of_dark_pages_are_dark_and_the_next_one_is_light_again() -> None:
    def drawn() -> bytes:
        figure = new_figure(1.0, 1.0, dpi=20)
        figure.subplots()
        return as_png(figure)

    light, dark, again = drawn(), in_dark_colours(drawn), drawn()
    ground, dark_ground = (
        int(np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE))[0, 0]) for png in (light, dark)
    )
    assert ground == 255 and dark_ground < 40
    assert again == light


@pytest.mark.parametrize("size_px", [(640, 480), (1280, 400), (480, 640)])
def test_the_map_of_a_difference_fills_its_picture(size_px: tuple[int, int]) -> None:
    one, two = (Pinhole(size_px, np.array([f, f, 300.0, 200.0])) for f in (500.0, 501.0))
    picture = cv2.imdecode(np.frombuffer(difference_png(compare_cameras(one, two)), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    rows, columns = (np.flatnonzero((np.asarray(picture) < 250).any(axis=axis)) for axis in (1, 0))
    for inked, length in ((rows, picture.shape[0]), (columns, picture.shape[1])):
        assert inked[0] < 0.15 * length and inked[-1] > 0.85 * length


@pytest.mark.parametrize(("name", "title"), [("left", "left: difference "), ("", "difference ")])
def test_the_map_of_a_difference_names_the_camera_of_a_rig(
    name: str, title: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles: list[str] = []
    monkeypatch.setattr("rigkit.report.pictures.figures.as_png", lambda own: titles.append(own.axes[0].get_title()))
    camera = Pinhole((640, 480), np.array([500.0, 500.0, 300.0, 200.0]))
    difference_png(compare_cameras(camera, camera), name)
    assert titles[0].startswith(title)


@pytest.mark.parametrize("baseline_mm", [(300.0, 0.0, 0.0), (0.0, 0.0, 900.0), (0.0, 1500.0, 0.0)])
def test_the_cloud_s_axes_and_their_numbers_are_all_in_the_picture(baseline_mm: tuple[float, float, float]) -> None:
    figure = cloud_figure(make_reconstruction(cam2_from_cam1=Rigid3(np.eye(3), np.array(baseline_mm))))
    figure.canvas.draw()
    width, height = figure.bbox.width, figure.bbox.height
    for axes in figure.axes:
        drawn = axes.get_tightbbox()
        assert drawn is not None
        assert drawn.x0 >= 0.0 and drawn.y0 >= 0.0 and drawn.x1 <= width and drawn.y1 <= height
        # And the scene fills it: no stamp in the middle.
        assert max(drawn.width / (0.5 * width), drawn.height / height) > 0.8


@pytest.mark.parametrize("baseline_mm", [(300.0, 0.0, 0.0), (-300.0, 0.0, 0.0), (0.0, 0.0, -150.0)])
def test_cameras_are_drawn_within_the_axes(baseline_mm: tuple[float, float, float]) -> None:
    from mpl_toolkits.mplot3d import Axes3D
    from mpl_toolkits.mplot3d.art3d import Line3D

    figure = cloud_figure(make_reconstruction(cam2_from_cam1=Rigid3(np.eye(3), np.array(baseline_mm))))
    lines = [(axes, line) for axes in figure.axes if isinstance(axes, Axes3D) for line in axes.lines]
    assert len(lines) == 4
    for axes, line in lines:
        assert isinstance(line, Line3D)
        for (low, high), values in zip(
            (axes.get_xlim(), axes.get_ylim(), axes.get_zlim()), line.get_data_3d(), strict=True
        ):
            assert low <= np.min(values) and np.max(values) <= high


@pytest.mark.parametrize("baseline_mm", [(300.0, 0.0, 0.0), (0.0, 0.0, -150.0), (250.0, 40.0, 90.0)])
def test_no_axis_name_lies_over_a_number(baseline_mm: tuple[float, float, float]) -> None:
    from mpl_toolkits.mplot3d import Axes3D

    figure = cloud_figure(make_reconstruction(cam2_from_cam1=Rigid3(np.eye(3), np.array(baseline_mm))))
    figure.canvas.draw()
    checked = 0
    for axes in figure.axes:
        assert isinstance(axes, Axes3D)
        three = (axes.xaxis, axes.yaxis, axes.zaxis)
        numbers = [
            tick.label1.get_window_extent()
            for axis in three
            for tick in axis.get_major_ticks()
            if axis.get_view_interval()[0] <= tick.get_loc() <= axis.get_view_interval()[1]
        ]
        for name in (axis.label for axis in three if axis.label.get_text()):
            assert not any(name.get_window_extent().overlaps(number) for number in numbers), name.get_text()
            checked += len(numbers)
    assert checked > 40


def test_words_and_lines_of_drawings_have_a_colour_for_the_night(rng: np.random.Generator) -> None:
    camera = lens("reg")
    found = calibrate(random_views(camera, 6, rng, reach_deg=25.0)[0], camera.size_px, model="brown", board="flat")
    drawings = [draw(found) for draw in (images_svg, histogram_svg, radius_svg, lens_svg)]
    drawings += [draw(found) for draw in (residuals_svg, pattern_svg, coverage_svg)]
    used = {colour for svg in drawings for colour in re.findall(r'<text [^>]*fill="(#[0-9a-f]+)"', svg)}
    used |= {colour for svg in drawings for colour in re.findall(r'<rect [^>]*fill="(#[0-9a-f]+)"', svg)}
    known = set(re.findall(r'\[fill="(#[0-9a-f]+)"\]', str(asset("drawings.css"))))
    assert len(used) >= 4
    assert used <= known
    coded = data_uri("image/svg+xml", drawings[0].encode()).partition(",")[2]
    assert b"prefers-color-scheme: dark" in base64.b64decode(coded)


@pytest.mark.parametrize("baseline_mm", [(-20.0, 0.0, 0.0), (20.0, 0.0, 0.0), (5.0, 0.0, -20.0)])
def test_the_names_of_cameras_close_together_do_not_cover_each_other(baseline_mm: tuple[float, float, float]) -> None:
    from mpl_toolkits.mplot3d import Axes3D, proj3d

    figure = cloud_figure(make_reconstruction(cam2_from_cam1=Rigid3(np.eye(3), np.array(baseline_mm))))
    figure.canvas.draw()
    for axes in figure.axes:
        assert isinstance(axes, Axes3D)
        spans = []
        for text in axes.texts:
            u, v, _ = proj3d.proj_transform(*text.get_position_3d(), axes.get_proj())
            # The window extent of a text in space is where it was before it was projected; its width is right.
            width, x = text.get_window_extent().width, axes.transData.transform((u, v))[0]
            left = x - {"left": 0.0, "center": 0.5, "right": 1.0}[text.get_horizontalalignment()] * width
            spans.append((left, left + width))
        spans.sort()
        assert len(spans) == 2 and spans[0][1] <= spans[1][0]
