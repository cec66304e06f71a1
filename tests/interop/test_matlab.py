"""MATLAB's files: structures of its toolbox, Bouguet's results, pairs; objects, HDF5 and damage are refused."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from rigkit.core.errors import InputError
from rigkit.geometry.rotation import exp_so3
from rigkit.workflows.inputs.camera_files import camera_format, camera_text, import_camera, import_rig, is_rig

RADIAL, TANGENTIAL = [-0.2996, 0.1528, -0.0896], [0.00158, 0.00029]
INTRINSICS = {
    "FocalLength": [533.9, 534.2],
    "PrincipalPoint": [342.3, 239.7],
    "ImageSize": [480.0, 640.0],
    "RadialDistortion": RADIAL,
    "TangentialDistortion": TANGENTIAL,
    "Skew": 0.0,
}
OURS = [533.9, 534.2, 341.3, 238.7, -0.2996, 0.1528, 0.00158, 0.00029, -0.0896]
K = np.array([[533.9, 0.0, 342.3], [0.0, 534.2, 239.7], [0.0, 0.0, 1.0]])
OLD = {
    "IntrinsicMatrix": K.T, "ImageSize": [480.0, 640.0], "RadialDistortion": RADIAL[:2],
    "TangentialDistortion": [0.0, 0.0], "WorldPoints": np.zeros((54, 2)),
}  # fmt: skip
BOUGUET = {
    "fc": np.array([[657.4], [657.8]]), "cc": np.array([[302.98], [242.6]]), "alpha_c": 0.0,
    "kc": np.array([[-0.25], [0.12], [-0.0002], [0.00003], [0.0]]), "nx": 640.0, "ny": 480.0, "x_1": np.zeros((2, 156)),
}  # fmt: skip
SCRIPT = """% Intrinsic and Extrinsic Camera Parameters
%-- Focal length:
fc = [ 657.4 ; 657.8 ];

%-- Principal point:
cc = [ 302.98 ; 242.6 ];
alpha_c = 0.000000000000000;
kc = [ -0.25 ; 0.12 ; ...
  -0.0002 ; 0.00003 ; 0.000000000000000 ];
%-- fc = [ 1 ; 1 ];
nx = 640;
ny = 480;
omc_1 = [ 1.6e+00 ; 1.6e+00 ; -6.6e-01 ];
"""


def _saved(path: Path, content: dict[str, Any]) -> Path:
    savemat(path, content)
    return path


@pytest.mark.parametrize(
    "content",
    [INTRINSICS, {"s": INTRINSICS}, {"s": {"Intrinsics": INTRINSICS, "K": K, **INTRINSICS}}, {"K": K, **INTRINSICS}],
)
def test_structures_of_the_toolbox(content: dict[str, Any], tmp_path: Path) -> None:
    """Pixels are counted from 1 there."""
    path = _saved(tmp_path / "camera.mat", content)
    assert camera_format(camera_text(path)) == "matlab"
    camera = import_camera(path)
    assert (camera.model, camera.size_px) == ("brown", (640, 480))
    assert camera.parameters == pytest.approx(np.array(OURS), abs=1e-12)
    assert not is_rig(path)


def test_what_a_structure_leaves_out_is_zero(tmp_path: Path) -> None:
    fewer = {key: value for key, value in INTRINSICS.items() if not key.endswith(("Distortion", "Skew"))}
    camera = import_camera(_saved(tmp_path / "camera.mat", fewer))
    assert camera.model == "pinhole" and camera.parameters == pytest.approx(OURS[:4], abs=1e-12)


def test_matrices_for_row_vectors(tmp_path: Path) -> None:
    camera = import_camera(_saved(tmp_path / "camera.mat", OLD))
    assert camera.parameters[:6] == pytest.approx([*OURS[:6]], abs=1e-12)


def test_fisheye_of_the_toolbox(tmp_path: Path) -> None:
    """u = S (x, y) + centre of the ray (x, y, a0 + a2 r^2 + ...), as its documentation has it."""
    a, stretch, centre = [875.0, -3e-4, -1e-8, 1e-10], np.array([[1.001, 0.002], [-0.001, 1.0]]), [513.2, 390.7]
    inner = {
        "MappingCoefficients": a, "ImageSize": [768.0, 1024.0], "DistortionCenter": centre, "StretchMatrix": stretch,
    }  # fmt: skip
    camera = import_camera(_saved(tmp_path / "fisheye.mat", {"f": {"Intrinsics": inner, "NumPatterns": 9.0}}))
    flat = np.array([[200.0, -120.0], [-310.0, 50.0], [10.0, 300.0]])
    rho = np.linalg.norm(flat, axis=1)
    rays = np.column_stack([flat, a[0] + a[1] * rho**2 + a[2] * rho**3 + a[3] * rho**4])
    pixels = flat @ stretch.T + centre - 1.0
    ours, valid = camera.unproject(pixels)
    assert valid.all()
    # The stretch turns the image a little, which becomes a turn about the axis.
    angle = np.arctan2(-stretch[1, 0], stretch[1, 1])
    turn = exp_so3(np.array([0.0, 0.0, angle]))
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    both = [np.abs(ours - unit @ R.T).max() for R in (turn, turn.T)]
    assert min(both) < 1e-9


@pytest.mark.parametrize("form", ["mat", "m"])
def test_bouguets_results(form: str, tmp_path: Path) -> None:
    """Pixels are counted from 0 there."""
    path = tmp_path / f"Calib_Results.{form}"
    if form == "mat":
        savemat(path, BOUGUET)
    else:
        path.write_text(SCRIPT)
    camera = import_camera(path)
    assert camera.size_px == (640, 480)
    assert camera.parameters.tolist() == [657.4, 657.8, 302.98, 242.6, -0.25, 0.12, -0.0002, 0.00003, 0.0]


def test_bouguets_pair(tmp_path: Path) -> None:
    both = {f"{k}_{side}": BOUGUET[k] for k in ("fc", "cc", "alpha_c", "kc") for side in ("left", "right")}
    R = exp_so3(np.array([0.01, 0.03, -0.002]))
    t = np.array([[-99.8], [1.1], [0.05]])
    path = _saved(tmp_path / "Calib_Results_stereo.mat", {**both, "R": R, "T": t, "nx": 640.0, "ny": 480.0})
    assert is_rig(path)
    right_from_left = import_rig(path)["right"][1]
    assert right_from_left.rotation == pytest.approx(R)
    assert right_from_left.translation_mm == pytest.approx(t.ravel())
    with pytest.raises(InputError, match="several cameras"):
        import_camera(path)


@pytest.mark.parametrize("newer", [False, True])
def test_the_toolboxs_pair(newer: bool, tmp_path: Path) -> None:
    R, t = exp_so3(np.array([0.01, 0.03, -0.002])), np.array([-99.8, 1.1, 0.05])
    pose = (
        {"PoseCamera2": {"R": R, "Translation": t}} if newer else {"RotationOfCamera2": R.T, "TranslationOfCamera2": t}
    )
    path = _saved(tmp_path / "stereo.mat", {"s": {"CameraParameters1": INTRINSICS, "CameraParameters2": OLD, **pose}})
    rig = import_rig(path)
    assert list(rig) == ["left", "right"]
    assert rig["left"][0].parameters == pytest.approx(np.array(OURS), abs=1e-12)
    assert rig["right"][1].rotation == pytest.approx(R)
    assert rig["right"][1].translation_mm == pytest.approx(t)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"a": np.zeros(3)}, "none of the known|no camera of MATLAB"),
        ({**INTRINSICS, "Skew": 1.5}, "skew"),
        ({k: v for k, v in INTRINSICS.items() if k != "ImageSize"}, "--size"),
        ({k: v for k, v in INTRINSICS.items() if k != "PrincipalPoint"}, "'PrincipalPoint' is missing"),
        ({**BOUGUET, "kc": np.zeros(4)}, "kc has 4 numbers"),
        ({**BOUGUET, "alpha_c": 0.01}, "skew"),
        ({**INTRINSICS, "RadialDistortion": [0.1]}, "RadialDistortion has 1 numbers"),
        ({"a": INTRINSICS, "b": INTRINSICS}, "several cameras"),
        ({**INTRINSICS, "FocalLength": [np.nan, 500.0]}, "FocalLength"),
    ],
)
def test_what_is_no_camera_is_refused(content: dict[str, Any], words: str, tmp_path: Path) -> None:
    path = _saved(tmp_path / "camera.mat", content)
    with pytest.raises(InputError, match=words) as caught:
        import_camera(path)
    assert len(str(caught.value).splitlines()) == 1


def test_size_is_given_where_the_file_does_not_say_it(tmp_path: Path) -> None:
    path = _saved(tmp_path / "camera.mat", {k: v for k, v in INTRINSICS.items() if k != "ImageSize"})
    assert import_camera(path, size_px=(640, 480)).size_px == (640, 480)


def test_hdf5_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(1000))
    with pytest.raises(InputError, match="'-v7'"):
        import_camera(path)


def test_cut_files_are_refused(tmp_path: Path) -> None:
    whole = _saved(tmp_path / "camera.mat", INTRINSICS).read_bytes()
    path = tmp_path / "cut.mat"
    refused = 0
    for cut in range(0, len(whole) - 1, 53):
        path.write_bytes(whole[:cut])
        try:
            import_camera(path)
        except InputError as error:
            refused += len(str(error).splitlines()) == 1
    assert refused > 0.5 * len(range(0, len(whole) - 1, 53))


def _element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def test_objects_are_refused_with_what_to_do(tmp_path: Path) -> None:
    """As MATLAB writes them: the object, and behind it an array of bytes without a name."""
    flags = [_element(6, struct.pack("<II", kind, 0)) for kind in (17, 9)]
    opaque = b"".join([flags[0], _element(1, b"cameraParams"), _element(1, b"MCOS"), _element(1, b"cameraParameters")])
    rest = b"".join([flags[1], _element(5, struct.pack("<ii", 1, 4)), _element(1, b""), _element(2, bytes(4))])
    path = tmp_path / "camera.mat"
    path.write_bytes(
        b"MATLAB 5.0 MAT-file".ljust(124)
        + struct.pack("<H", 0x0100)
        + b"IM"
        + _element(14, opaque)
        + _element(14, rest)
    )
    with pytest.raises(InputError, match=r"'cameraParams' is an object.*toStruct\(cameraParams\)"):
        import_camera(path)


def test_a_name_that_is_none_is_refused(tmp_path: Path) -> None:
    """A byte of a name was damaged: nothing that follows it is to be trusted."""
    with pytest.raises(InputError, match="damaged"):
        import_camera(_saved(tmp_path / "damaged.mat", {"f-c": np.ones(2), **BOUGUET}))


def test_damaged_bytes_are_refused_in_one_line(tmp_path: Path, rng: np.random.Generator) -> None:
    """SciPy's reader ends the process on some of these."""
    whole = [_saved(tmp_path / f"{k}.mat", c).read_bytes() for k, c in enumerate((INTRINSICS, BOUGUET))]
    path, refused = tmp_path / "damaged.mat", 0
    for k in range(300):
        damaged = bytearray(whole[k % 2])
        for place in rng.integers(128, len(damaged), 3):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            import_camera(path)
        except InputError as error:
            refused += len(str(error).splitlines()) == 1
    assert refused > 30
