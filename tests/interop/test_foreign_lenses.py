"""Lens models that only other programs have: read within a stated error, against those programs."""

from __future__ import annotations

import logging
import re

import numpy as np
import pycolmap
import pytest
from helpers.cameras import rays_within

from rigkit.core.errors import InputError
from rigkit.interop import foreign_lenses
from rigkit.interop.colmap_cameras import read_colmap_cameras
from rigkit.interop.kalibr import read_kalibr
from rigkit.interop.mrcal import read_cameramodel

SAME_PX = 1e-6
"""Text of nine digits, and COLMAP's own projection."""
RAYS = np.array([[0.0, 0.0, 1.0], [0.3, 0.1, 1.0], [-0.25, 0.2, 1.0], [0.1, -0.3, 1.0], [-0.4, -0.25, 1.0]])
UNIT = RAYS / np.linalg.norm(RAYS, axis=1, keepdims=True)
CORE = np.array([1000.0, 1001.0, 640.0, 480.0])
CAHVOR = [0.01, -0.02, 0.001, -0.1, 0.02]
PRISM = [-0.2, 0.05, 1e-4, -2e-4, 0.01, 0.1, 0.02, 0.001, 1e-3, -2e-4, 5e-4, 1e-4]
MRCALS = {
    "CAHVOR": [[639.99050454, 480.019012762], [937.492631895, 579.061397906], [392.705189259, 677.90866944],
               [739.331110437, 181.783051175], [248.242101621, 234.378164042]],
    "OPENCV12": [[640.0, 480.0], [931.23064583, 577.208993825], [397.572431828, 674.262592687],
                 [737.128881943, 188.617262524], [265.59807036, 245.798215064]],
}  # fmt: skip
"""Pixels of RAYS as mrcal 2.2 projects them (mrcal.project)."""


def _cameramodel(lens: str, intrinsics: list[float]) -> str:
    return (
        f"{{'lensmodel': 'LENSMODEL_{lens}', 'intrinsics': {intrinsics}, "
        "'extrinsics': [0, 0, 0, 0, 0, 0], 'imagersize': [1280, 960]}"
    )


@pytest.mark.parametrize("kind", ["CAHVOR", "OPENCV12"])
def test_lenses_of_mrcal_are_mrcals(kind: str) -> None:
    """The lens itself to the last digit given, the camera of ours by what is stated."""
    if kind == "CAHVOR":
        lens, terms = foreign_lenses.cahvor_lens(CORE, np.array(CAHVOR[:2]), np.array(CAHVOR[2:])), CAHVOR
    else:
        lens, terms = foreign_lenses.brown_prism_lens(CORE, np.array(PRISM)), PRISM
    pixels, seen = lens(UNIT)
    assert seen.all()
    assert np.abs(pixels - MRCALS[kind]).max() < SAME_PX
    camera, _, stated_px = read_cameramodel(_cameramodel(kind, [*CORE.tolist(), *terms]))
    projected, valid = camera.project(RAYS)
    off = np.linalg.norm(projected - MRCALS[kind], axis=1)
    assert valid.all()
    assert 0.01 < stated_px < 1.0
    assert off.max() < 1.1 * stated_px


def test_stereographic_is_the_unified_model() -> None:
    camera, _, stated_px = read_cameramodel(_cameramodel("STEREOGRAPHIC", [400.0, 401.0, 640.0, 480.0]))
    theta = np.radians([20.0, 80.0])
    pixels, valid = camera.project(np.stack([np.sin(theta), np.zeros(2), np.cos(theta)], axis=1))
    assert valid.all()
    assert stated_px == 0.0
    assert pixels[:, 0] == pytest.approx(640.0 + 800.0 * np.tan(theta / 2.0), abs=1e-9)


def test_twelve_terms_without_a_prism_are_eight() -> None:
    camera, _, stated_px = read_cameramodel(_cameramodel("OPENCV12", [*CORE.tolist(), *PRISM[:8], 0.0, 0.0, 0.0, 0.0]))
    assert (camera.model, stated_px) == ("brown", 0.0)
    assert camera.parameters.tolist() == [*CORE.tolist(), *PRISM[:8]]


@pytest.mark.parametrize(
    ("lens", "count", "words"),
    [
        ("CAHVORE_linearity=0.4", 12, "mrcal-convert-lensmodel"),
        ("CAHVOR", 8, "has 9 intrinsics, found 8"),
        ("OPENCV12", 12, "has 16 intrinsics, found 12"),
    ],
)
def test_lenses_of_mrcal_that_are_not_read(lens: str, count: int, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_cameramodel(_cameramodel(lens, [400.0] * count))
    assert len(str(caught.value).splitlines()) == 1


def test_a_lens_that_no_model_follows_is_refused() -> None:
    much = [*PRISM[:8], 1e-2, -2e-3, 5e-3, 1e-3]
    with pytest.raises(InputError, match=r"no model here follows this lens \(the nearest, \w+, is .* px off\)"):
        read_cameramodel(_cameramodel("OPENCV12", [*CORE.tolist(), *much]))


@pytest.mark.parametrize(
    ("line", "limit_px"),
    [
        ("SIMPLE_DIVISION 640 480 500 320.5 240.5 -0.15", SAME_PX),
        ("DIVISION 640 480 500 505 320.5 240.5 -0.25", SAME_PX),
        ("FOV 640 480 400 402 320.5 240.5 0.9", SAME_PX),
        ("FOV 1280 960 500 500 640 480 1.8", 1e-3),
        ("THIN_PRISM_FISHEYE 640 480 250 251 320 240 -0.02 0.004 1e-4 -2e-4 -0.001 1e-4 1e-4 -1e-4", 0.5),
        ("RAD_TAN_THIN_PRISM_FISHEYE 640 480 250 251 320 240 -.02 .004 0 0 0 0 1e-4 -2e-4 1e-4 0 -1e-4 0", 0.5),
    ],
)
def test_models_of_colmap_that_are_not_ours(
    line: str, limit_px: float, rng: np.random.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        camera = read_colmap_cameras(f"7 {line}\n")[7]
    kind, width, height, *values = line.split()
    theirs = pycolmap.Camera(
        model=kind, width=int(width), height=int(height), params=np.array([float(v) for v in values])
    )
    points = rays_within(np.radians(80.0), 600, rng)
    pixels = np.asarray(theirs.img_from_cam(points)) - 0.5
    on = ((pixels > 0.0) & (pixels < np.array(camera.size_px) - 1.0)).all(axis=1)
    projected, valid = camera.project(points[on])
    assert on.sum() > 50
    assert valid.all()
    off = np.linalg.norm(projected - pixels[on], axis=1).max()
    assert off < limit_px
    if "DIVISION" in kind:
        assert camera.model == "scaramuzza"
        assert caplog.text == ""
    else:
        stated = re.search(r"refitted as '\w+', at most (\S+) px away", caplog.text)
        assert stated is not None
        assert off < 1.1 * float(stated[1]) + SAME_PX


def test_lenses_of_colmap_and_opencv_are_theirs(rng: np.random.Generator) -> None:
    """To the last digits, with every term, where the camera of ours above is a refit."""
    import cv2

    rays, core = rays_within(np.radians(80.0), 100, rng), np.array([250.0, 251.0, 320.0, 240.0])
    thin = np.array([-0.02, 0.004, 0.01, -0.02, -0.001, 1e-4, 0.03, -0.04])
    tangential = np.array([-0.02, 0.004, 0.003, -0.002, 0.001, -5e-4, 0.01, -0.02, 0.03, -0.01, -0.02, 0.015])
    for kind, lens, terms in (
        ("FOV", foreign_lenses.fov_lens(core, 0.9), [0.9]),
        ("THIN_PRISM_FISHEYE", foreign_lenses.thin_prism_fisheye_lens(core, thin), thin),
        ("RAD_TAN_THIN_PRISM_FISHEYE", foreign_lenses.fisheye_prism_lens(core, tangential[:6], tangential[6:]),
         tangential),
    ):  # fmt: skip
        theirs = pycolmap.Camera(model=kind, width=640, height=480, params=[*core, *terms])
        np.testing.assert_allclose(lens(rays)[0], theirs.img_from_cam(rays), atol=SAME_PX)
    d, K = np.array([-0.05, 0.01, 0.02, -0.03]), np.array([[250.0, 0.0, 320.0], [0.0, 251.0, 240.0], [0.0, 0.0, 1.0]])
    still = np.zeros(3)
    for xi in (0.8, 1.2):
        pixels, seen = foreign_lenses.unified_brown_lens(core, xi, d)(rays)
        np.testing.assert_allclose(
            pixels, cv2.omnidir.projectPoints(rays[None], still, still, K, xi, d[None])[0][0], atol=SAME_PX
        )
        assert seen.all()
    prism, place = foreign_lenses.brown_prism_lens(core, np.array(PRISM)), rays / rays[:, 2:]
    near = (rays[:, 2] > 0.7)[:, None]
    of_opencv = cv2.projectPoints(place, still, still, K, np.array(PRISM))[0][:, 0]
    np.testing.assert_allclose(np.where(near, prism(rays)[0], 0.0), np.where(near, of_opencv, 0.0), atol=SAME_PX)
    # The tangent from the eye at xi touches the unit sphere where z = -1 / xi.
    edge = np.arccos(-1.0 / 1.2) + np.array([-0.01, 0.01])
    _, seen = foreign_lenses.unified_brown_lens(core, 1.2, d)(np.stack([np.sin(edge), 0.0 * edge, np.cos(edge)], 1))
    assert seen.tolist() == [True, False]


@pytest.mark.parametrize("line", ["FOV 640 480 400 402 320.5 240.5 0", "DIVISION 640 480 -500 505 320.5 240.5 -0.25"])
def test_values_that_no_lens_has_are_refused(line: str) -> None:
    with pytest.raises(InputError, match=r"cameras\.txt, line 1': ") as caught:
        read_colmap_cameras(f"7 {line}\n")
    assert len(str(caught.value).splitlines()) == 1


CHAIN = """cam0:
  camera_model: {model}
  distortion_coeffs: {distortion}
  distortion_model: {kind}
  intrinsics: {intrinsics}
  resolution: [752, 480]
"""


def test_kalibrs_pinhole_fov(caplog: pytest.LogCaptureFixture) -> None:
    """ATAN camera: r_d = atan(2 r tan(w / 2)) / w (Kalibr's FovDistortion)."""
    chain = CHAIN.format(model="pinhole", kind="fov", intrinsics="[460, 461, 370, 240]", distortion="[0.92]")
    with caplog.at_level(logging.INFO):
        (camera,), _ = read_kalibr(chain)
    r = np.tan(np.radians(40.0))
    pixels, valid = camera.project(np.array([[r, 0.0, 1.0]]))
    assert valid.all()
    assert pixels[0, 0] == pytest.approx(370.0 + 460.0 * np.arctan(2.0 * r * np.tan(0.46)) / 0.92, abs=1e-3)
    assert "pinhole-fov was refitted" in caplog.text


def test_kalibrs_omni_radtan_is_opencvs_omnidir(caplog: pytest.LogCaptureFixture) -> None:
    import cv2

    d = [-0.05, 0.01, 2e-4, -3e-4]
    chain = CHAIN.format(model="omni", kind="radtan", intrinsics="[1.2, 900, 901, 370, 240]", distortion=d)
    with caplog.at_level(logging.INFO):
        (camera,), _ = read_kalibr(chain)
    stated = re.search(r"omni-radtan was refitted as '\w+', at most (\S+) px away", caplog.text)
    assert stated is not None
    K = np.array([[900.0, 0.0, 370.0], [0.0, 901.0, 240.0], [0.0, 0.0, 1.0]])
    still = (np.zeros(3), np.zeros(3))
    theirs = cv2.omnidir.projectPoints(UNIT[None], *still, K, 1.2, np.array([d]))[0][0]
    assert np.linalg.norm(camera.project(UNIT)[0] - theirs, axis=1).max() < 1.1 * float(stated[1]) + SAME_PX


def test_kalibrs_other_distortions_are_refused() -> None:
    chain = CHAIN.format(model="eucm", kind="radtan", intrinsics="[0.6, 1.1, 460, 461, 370, 240]", distortion=[0.1] * 4)
    with pytest.raises(InputError, match="eucm with distortion_model 'radtan' is not supported"):
        read_kalibr(chain)
