"""Which images of a rig were taken at the same moment."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.core.errors import InputError
from rigkit.workflows.inputs.folder_session import cameras_in
from rigkit.workflows.inputs.layouts import layouts_of
from rigkit.workflows.moments import moments_of

NAMES = ("left", "right")


def _images(folder: Path, *names: str) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.png" for name in names]
    for path in paths:
        path.touch()
    return paths


def test_folders_are_the_cameras_by_their_names_or_in_their_order(tmp_path: Path) -> None:
    right, left, day = (_images(tmp_path / name, "0", "1") for name in ("right", "left", "day"))
    by_name = [list(pair) for pair in zip(left, right, strict=True)]
    folders = [own[0].parent for own in (right, left, day)]
    assert moments_of(NAMES, folders[:2]) == (by_name, [])
    assert moments_of(NAMES, [folders[0], folders[2]])[0] == [list(pair) for pair in zip(right, day, strict=True)]
    with pytest.raises(InputError, match=r"a rig of 2 cameras \(left, right\) needs a folder .*, got 3"):
        moments_of(NAMES, folders)


@pytest.mark.parametrize("inside", [True, False], ids=["left/01", "left01"])
def test_one_folder_holds_a_rig(inside: bool, tmp_path: Path) -> None:
    for side in NAMES:
        _images(tmp_path / side, "01", "02") if inside else _images(tmp_path, f"{side}01", f"{side}02")
    moments, single = moments_of(NAMES, [tmp_path])
    assert [[str(path.relative_to(tmp_path)) for path in moment] for moment in moments] == [
        [f"{side}/{k}.png" if inside else f"{side}{k}.png" for side in NAMES] for k in ("01", "02")
    ]
    assert not single
    with pytest.raises(InputError, match="of cameras left, right, not of 3 cameras; give a folder of images for each"):
        moments_of(("left", "right", "top"), [tmp_path])


def test_images_without_a_partner_are_named(tmp_path: Path) -> None:
    left, right = _images(tmp_path / "left", "a1", "a2", "a4"), _images(tmp_path / "right", "b1", "b3", "b4")
    moments, single = moments_of(NAMES, [tmp_path / "left", tmp_path / "right"])
    assert moments == [[left[0], right[0]], [left[2], right[2]]] and single == [left[1], right[1]]


def test_counters_that_overlap_are_paired_in_order_if_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    # Two cameras count their own pictures: DSC_3 and IMG_3 are not of one moment.
    left, right = (
        _images(tmp_path / "left", "DSC_1", "DSC_2", "DSC_3"),
        _images(tmp_path / "right", "IMG_3", "IMG_4", "IMG_5"),
    )
    folders = [tmp_path / "left", tmp_path / "right"]
    assert moments_of(NAMES, folders, "order") == ([list(pair) for pair in zip(left, right, strict=True)], [])
    assert not caplog.text
    assert moments_of(NAMES, folders)[0] == [[left[2], right[0]]]
    assert (
        "1 moment by names or numbers, of 3 images of every camera" in caplog.text and "--frames order" in caplog.text
    )


def test_names_that_tell_nothing_leave_the_order(tmp_path: Path) -> None:
    left, right = _images(tmp_path / "left", "a", "b"), _images(tmp_path / "right", "c", "d")
    folders = [tmp_path / "left", tmp_path / "right"]
    assert moments_of(NAMES, folders)[0] == [[left[0], right[0]], [left[1], right[1]]]
    _images(tmp_path / "right", "e")
    with pytest.raises(InputError, match="no two cameras have an image of the same name or number"):
        moments_of(NAMES, folders)


def test_every_camera_must_have_some_moment(tmp_path: Path) -> None:
    for name, images in (("a", ("1", "2")), ("b", ("2", "3")), ("c", ("3", "1"))):
        _images(tmp_path / name, *images)
    with pytest.raises(InputError, match="no frame has an image of every camera"):
        moments_of(("a", "b", "c"), [tmp_path / name for name in "abc"])


@pytest.mark.parametrize(
    "names",
    [
        ("left04", "left08", "right04", "right08"),
        ("right08", "left04", "left08", "right04"),
        ("now_left_4", "now_left_8", "now_right_4", "now_right_8"),
    ],
)
def test_images_are_sorted_by_the_cameras_in_their_names(names: tuple[str, ...], tmp_path: Path) -> None:
    moments, _ = moments_of(NAMES, _images(tmp_path / "left-right", *names))
    assert len(moments) == 2
    for moment in moments:
        one, two = (path.stem for path in moment)
        assert one.replace("left", "right") == two and one in names and two in names


def test_images_are_sorted_by_the_cameras_in_their_folders_names(tmp_path: Path) -> None:
    images = [path for name in ("cam10", "cam1") for path in _images(tmp_path / name, "1", "2")]
    assert moments_of(("cam1", "cam10"), images)[0] == [[images[2], images[0]], [images[3], images[1]]]


@pytest.mark.parametrize(
    "names",
    [
        ("a", "b", "c", "d"),
        ("left_tilt_1", "right_tilt_2", "left_tilt_3", "right_tilt_4"),
        ("left1", "left_right1", "right1", "x"),
        ("left1", "LEFT1", "right1", "x"),
    ],
)
def test_other_names_leave_images_moment_by_moment(names: tuple[str, ...], tmp_path: Path) -> None:
    images = _images(tmp_path, *names)
    assert moments_of(NAMES, images)[0] == [images[:2], images[2:]]
    with pytest.raises(InputError, match="3 different images of 2 cameras"):
        moments_of(NAMES, images[:3])


def test_two_images_of_one_camera_are_no_moment_of_two(tmp_path: Path) -> None:
    images = _images(tmp_path, "left10", "left11")
    with pytest.raises(InputError, match="by their names no image is of camera 'right'; give images of each of left"):
        moments_of(NAMES, images)
    # Cameras called 0 and 1 are not told from numbers.
    assert moments_of(("0", "1"), _images(tmp_path, "at_0_a", "at_0_b"))[0]


@pytest.mark.parametrize(
    ("first", "second", "cameras"),
    [
        ("mav0/cam0/data/{}", "mav0/cam1/data/{}", ["cam0", "cam1"]),
        ("image_00/data/{}", "image_01/data/{}", ["image_00", "image_01"]),
        ("infra1/{}", "infra2/{}", ["infra1", "infra2"]),
        ("img_L_{}", "img_R_{}", ["l", "r"]),
        ("img_left{}", "img_right{}", ["left", "right"]),
        ("L{}", "R{}", ["l", "r"]),
        ("{}_L", "{}_R", ["l", "r"]),
        ("room [1]_left_{}", "room [1]_right_{}", ["left", "right"]),
        ("left", "Right", ["left", "right"]),
        ("mon/left/{}", "tue/left/{}", []),
        ("image_07/{}", "image_08/{}", ["image_07", "image_08"]),
    ],
)
def test_layouts_of_well_known_datasets(first: str, second: str, cameras: list[str], tmp_path: Path) -> None:
    own = [[tmp_path / f"{form.format(k)}.png" for k in ("001", "002")] for form in (first, second)]
    for path in (*own[0], *own[1]):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    # "left" and "right" alone are one moment.
    own = [list(dict.fromkeys(paths)) for paths in own]
    # Copies in a folder farther down are none of the cameras.
    _images(tmp_path / "old" / "backup" / "left", "001")
    if not cameras:
        with pytest.raises(InputError, match="give one folder a camera"):
            cameras_in([tmp_path])
        return
    found = cameras_in([tmp_path])
    assert list(found) == cameras
    assert [sorted(p for folder, one in found[name] for p in folder.glob(one)) for name in cameras] == own


@pytest.mark.parametrize(("digits", "either"), [(6, [3, 4]), (10, [4])])
def test_fewer_moments_than_cameras(digits: int, either: list[int], tmp_path: Path) -> None:
    """KITTI's folders with three images each: the boards, or a number, tell that they are cameras. What has more
    moments is asked first; names of ten digits are times."""
    for camera in range(4):
        _images(tmp_path / f"image_{camera:02d}" / "data", *(f"{k:0{digits}d}" for k in range(3)))
    assert [len(layout.cameras) for layout in layouts_of(sorted(tmp_path.rglob("*.png")))] == either
    assert list(cameras_in([tmp_path], 4)) == [f"image_{k:02d}" for k in range(4)]


def test_as_many_cameras_as_are_known(tmp_path: Path) -> None:
    """Where their number is known, no word is needed; folders of one image each are moments of one camera."""
    for k in range(3):
        _images(tmp_path / "rig" / "linke Kamera", f"{k}")
        _images(tmp_path / "rig" / "rechte Kamera", f"{k}")
        _images(tmp_path / "one" / f"image_{k:02d}", "000")
        _images(tmp_path / "moments" / f"{k}", "A", "B")
    (tmp_path / "empty").mkdir()
    assert list(cameras_in([tmp_path / "rig"], 2)) == ["linke Kamera", "rechte Kamera"]
    assert [[p.name for p in own] for own in moments_of(("l", "r"), [tmp_path / "rig"])[0]] == [
        [f"{k}.png"] * 2 for k in range(3)
    ]
    found = cameras_in([tmp_path / "moments"], 2)
    assert found == {side: [(tmp_path / "moments" / f"{k}", f"{side}.png") for k in range(3)] for side in "AB"}
    assert len(cameras_in([tmp_path / "one"], 1)[""]) == 3
    with pytest.raises(InputError, match="give one folder a camera"):
        cameras_in([tmp_path / "one"])
    with pytest.raises(
        InputError, match=r"of 2 cameras \('linke Kamera', 'rechte Kamera'\) with 3 moments, not of 3 c"
    ):
        cameras_in([tmp_path / "rig"], 3)
    with pytest.raises(InputError, match="has no images"):
        cameras_in([tmp_path / "empty"], 1)


@pytest.mark.parametrize("form", ["{}", "board_{}_"])
def test_a_letter_or_a_word_within_is_a_side_only_where_both_have_the_same_images(form: str, tmp_path: Path) -> None:
    sides = ("L", "R") if form == "{}" else ("left", "right")
    _images(tmp_path, *(f"{form.format(sides[k > 2])}{k}" for k in range(1, 6)))
    assert list(cameras_in([tmp_path])) == [""]


def test_the_cameras_folders_may_be_links(tmp_path: Path) -> None:
    for name in ("left", "right"):
        _images(tmp_path / "disk" / name, "001", "002")
        (tmp_path / "rig").mkdir(exist_ok=True)
        (tmp_path / "rig" / name).symlink_to(tmp_path / "disk" / name, target_is_directory=True)
    assert list(cameras_in([tmp_path / "rig"])) == ["left", "right"]


def test_the_only_folder_with_images_is_meant(tmp_path: Path) -> None:
    for name in ("cam0", "cam1"):
        _images(tmp_path / name / "data", "001", "002")
    assert cameras_in([tmp_path / "cam0"]) == {"": [(tmp_path / "cam0" / "data", "*.png")]}
    folders = [tmp_path / "cam0", tmp_path / "cam1"]
    assert {name: own[0][0] for name, own in cameras_in(folders).items()} == {f.name: f / "data" for f in folders}
    assert len(moments_of(("cam0", "cam1"), folders)[0]) == 2


def test_a_folder_of_two_cameras_for_one_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    _images(tmp_path, "left01", "left02")
    assert len(moments_of(("cam",), [tmp_path])[0]) == 2 and not caplog.text
    _images(tmp_path, "right01", "right02")
    assert len(moments_of(("cam",), [tmp_path])[0]) == 4
    assert "are of 2 cameras (left, right), and all are taken as one camera's" in caplog.text
    caplog.clear()
    for name in ("left", "right"):
        _images(tmp_path / "apart" / name, "1", "2")
    with pytest.raises(InputError, match="give one folder a camera"):
        moments_of(("cam",), [tmp_path / "apart"])
    assert not caplog.text, "they are not taken as one camera's"
