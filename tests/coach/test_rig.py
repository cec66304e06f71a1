"""The coach for several cameras: advice, kept frames, and the uncertainty of the mounts."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.coach_scenes import (
    BOARD,
    CAMERA,
    MOUNT,
    NOISE_PX,
    REACH,
    SIZE,
    ask,
    both,
    frame_observation,
    options,
    picture,
    shared_boards,
)

from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.choosing.models_tried import Request
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.coach.coach import Coach, Take
from rigkit.coach.guide import GuideOptions
from rigkit.coach.look import FrameObservation, observe_frame
from rigkit.coach.rig import SHARED_FRAMES, RigGuide
from rigkit.coach.sources import frames_of_folders
from rigkit.core.arrays import principal_axes
from rigkit.core.errors import InputError
from rigkit.core.measurement_task import Quantity, Task
from rigkit.geometry.board_pose import board_pose
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, log_so3, unit
from rigkit.io.manifests.rig_session import load_rig_session
from rigkit.planning.candidates import board_poses_in_view
from rigkit.planning.information import CornerError, SharedViews, median_motion, mount_error_px, mount_information
from rigkit.workflows.capture.coach import _frames, open_coach
from rigkit.workflows.options.coach import CoachOptions

DRAWS = 120


def test_the_error_of_a_mount_is_what_repeated_frames_show(rng: np.random.Generator) -> None:
    in_a, in_b = shared_boards(1)
    shared = SharedViews(CAMERA, CAMERA, in_a, in_b, CornerError(NOISE_PX))
    information = mount_information(shared)
    errors = []
    for _ in range(DRAWS):
        poses = []
        for held in (in_a, in_b):
            exact, _ = CAMERA.project(held.pose(0).apply(BOARD.points()))
            rays, _ = CAMERA.unproject(exact + NOISE_PX * rng.standard_normal(exact.shape))
            poses.append(board_pose(rays, BOARD.points()).cam_from_board)
        found = poses[1] @ poses[0].inverse()
        turn, shift = log_so3(found.rotation @ MOUNT.rotation.T), found.translation_mm - MOUNT.translation_mm
        errors.append(np.concatenate([turn, shift]))
    # Errors in units of what is stated have the covariance 1; so many draws tell it to a quarter.
    whitened = np.array(errors) @ np.linalg.cholesky(information[0])
    assert (whitened**2).mean() == pytest.approx(1.0, abs=0.25)
    in_px = mount_error_px(shared, information[0])
    assert 0.3 * NOISE_PX < in_px < 3.0 * NOISE_PX
    assert mount_error_px(shared, 4.0 * information[0]) == pytest.approx(0.5 * in_px)
    assert np.allclose(median_motion([MOUNT] * 3).matrix(), MOUNT.matrix())


def test_a_rig_is_enough_when_lenses_and_mounts_are(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    # Many calibrations: which model the lens has is told, not found each time.
    monkeypatch.setattr(
        "rigkit.coach.full_calibration.Request", lambda **asked: Request(**(asked | {"model": "brown"}))
    )
    monkeypatch.setattr(
        "rigkit.coach.full_rig_calibration.calibrate_rig",
        lambda views, sizes, model, board, candidate_fits: calibrate_rig(views, sizes, model="brown", degree=5),
    )
    guide = RigGuide(("left", "right"), GuideOptions(boards=(BOARD,), hfov_deg=52.0, goal_px=0.3, reach=REACH))
    empty = [FrameObservation(size_px=SIZE, view=None)] * 2
    first = guide.advise(empty)
    assert first.words.startswith("left: Hold the board") and first.targets[1] is None and first.mount_px is None
    # Every camera by itself: both lenses are known well, and of the mount nothing.
    alone = board_poses_in_view(CAMERA, BOARD, REACH)
    for k in range(0, 220, 10):
        own = frame_observation(alone.pose(k), rng, f"{k}")
        guide.add([own, empty[0]] if k % 20 else [empty[0], own])
    lenses_known = guide.advise(empty)
    assert all(lens.enough for lens in lenses_known.lenses)
    assert not lenses_known.enough and "both see it" in lenses_known.words
    in_a, _ = shared_boards(40)
    for k in range(0, 40, 5):
        now = both(in_a.pose(k), rng, f"s{k}")
        if 5 < k < 5 * (SHARED_FRAMES - 1):
            guide.add(now)  # As the others; each question calibrates anew.
            continue
        advice = guide.advise(now)
        if advice.enough:
            break
        assert k >= 25 or advice.take, "a board that both see is worth it"
        guide.add(now)
        if k == 0:
            assert all(target is not None for target in guide.advise(empty).targets), "outlines in both images"
    assert advice.enough and k >= 5 * SHARED_FRAMES
    assert advice.mount_px is not None and advice.mount_px < 0.3
    assert advice.words.startswith("Enough: ")
    state = guide.state(now, advice)
    assert [camera["name"] for camera in state["cameras"]] == ["left", "right"]
    assert state["cameras"][0]["map"][0] and json.dumps(state)


@pytest.fixture(scope="module")
def pairs() -> Sequence[list[np.ndarray]]:
    in_a, in_b = shared_boards(3)
    rng = np.random.default_rng(3)
    return [[picture(held.pose(k), rng) for held in (in_a, in_b)] for k in range(3)]


def rig_options(folder: Path, **more: object) -> CoachOptions:
    return CoachOptions(folder=folder, boards=("9x6x25",), guide=options(folder).guide, **more)  # type: ignore[arg-type]


def test_frames_of_several_cameras_are_kept_together(pairs: Sequence[list[np.ndarray]], tmp_path: Path) -> None:
    incoming = [tmp_path / "in" / name for name in ("left", "right")]
    for c, folder in enumerate(incoming):
        folder.mkdir(parents=True)
        for k, pair in enumerate(pairs):
            cv2.imwrite(str(folder / f"img{k}.png"), pair[c])
    # Taken by one camera only: it waits for the other's.
    (incoming[0] / "img7.png").write_bytes((incoming[0] / "img0.png").read_bytes())
    coach = open_coach(rig_options(tmp_path / "session", watch=tuple(incoming)))
    for images, source in frames_of_folders(incoming, until_idle_s=0.5):
        coach.look(images, take=Take.YES, source=source)
    taken = len(coach.guide.frames)
    assert taken == len(pairs)
    kept = [sorted((tmp_path / "session/images" / name).glob("*.png")) for name in ("left", "right")]
    assert [p.name for p in kept[0]] == [p.name for p in kept[1]] and len(kept[0]) == taken
    session = load_rig_session(tmp_path / "session/session.toml")
    assert list(session.cameras) == ["left", "right"]
    # Killed between two images of a frame: what is whole goes on, and what there is stays.
    kept[1][-1].unlink()
    again = open_coach(rig_options(tmp_path / "session", watch=tuple(incoming)))
    assert len(again.guide.frames) == taken - 1 and kept[0][-1].exists()
    again.look(pairs[0], take=Take.YES)
    assert again.keeper.frames[-1] == f"frame-{taken + 1:04d}.png"
    with pytest.raises(InputError, match="1 images of 2 cameras"):
        again.look(pairs[0][:1])
    with pytest.raises(InputError, match="called alike"):
        open_coach(rig_options(tmp_path / "other", watch=(tmp_path / "a/left", tmp_path / "b/left")))


def test_a_watched_folder_of_two_cameras_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("left01.png", "left02.png", "right01.png", "right02.png"):
        (tmp_path / name).touch()
    assert _frames(rig_options(tmp_path / "session", watch=(tmp_path,))) is not None
    assert "of 2 cameras (left, right), and all are taken as one camera's" in caplog.text


def test_two_images_come_in_one_upload(
    pairs: Sequence[list[np.ndarray]], tmp_path: Path, serve: Callable[[Coach, tuple[str, ...]], int]
) -> None:
    coach: Coach = open_coach(rig_options(tmp_path, cameras=2))
    port = serve(coach, ("127.0.0.1", "192.168.7.7"))
    data = [cv2.imencode(".png", image)[1].tobytes() for image in pairs[0]]
    path = f"/secret/look?sizes={len(data[0])},{len(data[1])}"
    status, printed = ask(port, "POST", path, data[0] + data[1])
    assert status == 200 and [len(camera["corners"]) for camera in json.loads(printed)["cameras"]] == [54, 54]
    status, page = ask(port, "GET", "/secret/")
    assert status == 200 and b'data-names="[&quot;camera0&quot;, &quot;camera1&quot;]"' in page
    # As from another machine of the network, by the address that it was told, and by another name.
    assert ask(port, "GET", "/secret/", Host=f"192.168.7.7:{port}")[0] == 200
    assert ask(port, "GET", "/secret/", Host=f"192.168.7.8:{port}")[0] == 403


def test_a_look_at_a_smaller_picture_shows_the_same(pairs: Sequence[list[np.ndarray]]) -> None:
    image = pairs[0][0]
    whole, half = observe_frame(image, [BOARD], "a"), observe_frame(image, [BOARD], "a", shrink=2)
    assert whole.view is not None and half.view is not None and half.size_px == SIZE
    order = [np.lexsort(g.view.pixels.T) for g in (whole, half) if g.view is not None]
    assert np.abs(whole.view.pixels[order[0]] - half.view.pixels[order[1]]).max() < 0.6
    assert half.edge_px == pytest.approx(whole.edge_px, rel=0.05)
    assert half.as_photo().still and not half.still


def length_error_mm(calibration: Calibration, length: Task) -> float:
    """By how much lengths across the image, level and upright, are measured wrongly by lenses that are one standard
    deviation off in each independent direction: root of the squares' sum, of which the mean over the image is taken."""
    known = uncertain_camera(calibration)
    camera = known.camera
    u, v = np.meshgrid(np.linspace(0.0, SIZE[0] - 1.0, 13), np.linspace(0.0, SIZE[1] - 1.0, 10))
    middle, valid = camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2))
    middle, squared = middle[valid], 0.0
    level = unit(np.cross([0.0, 1.0, 0.0], middle))
    half, far = 0.5 * length.size_mm, length.distance_mm
    ways = [(far * middle - half * way, far * middle + half * way) for way in (level, np.cross(middle, level))]
    ends = [[camera.project(end)[0] for end in way] for way in ways]
    seen = np.all([camera.on_image(end) for way in ends for end in way], axis=0)
    for error in principal_axes(known.covariance):
        wrong = camera.with_parameters(camera.parameters + error)
        for one, other in ends:
            angle = angle_between(wrong.unproject(one[seen])[0], wrong.unproject(other[seen])[0])
            squared += float(((2.0 * far * np.tan(0.5 * angle) - length.size_mm) ** 2).mean()) / len(ways)
    return float(np.sqrt(squared))


def test_a_length_is_measured_with_each_other_camera_or_with_the_only_one(tmp_path: Path) -> None:
    length = Task(quantity=Quantity.LENGTH, size_mm=100.0, distance_mm=500.0)
    guide = GuideOptions(boards=(BOARD,), hfov_deg=52.0, goal_mm=0.2, reach=REACH)
    coach = open_coach(CoachOptions(folder=tmp_path, boards=("9x6x25",), guide=guide, length=length))
    (alone,) = coach.guide.options.lengths([CAMERA], [Rigid3.identity()])
    (both,) = coach.guide.options.lengths([CAMERA, CAMERA], [Rigid3.identity(), MOUNT])
    assert alone.wanted == both.wanted == 0.2 and alone.goal.unit == both.goal.unit == "mm"
    # Of one camera the lens, of two both and how they stand to each other.
    count = CAMERA.parameters.size
    assert alone.goal.weight.shape == (count, count) and both.goal.weight.shape == (2 * count + 6, 2 * count + 6)


def test_the_goal_may_be_a_length_in_mm(tmp_path: Path, rng: np.random.Generator) -> None:
    guide = GuideOptions(boards=(BOARD,), hfov_deg=52.0, goal_mm=0.2, reach=REACH)
    length = Task(quantity=Quantity.LENGTH, size_mm=100.0, distance_mm=500.0)
    coach = open_coach(CoachOptions(folder=tmp_path, boards=("9x6x25",), guide=guide, length=length))
    held = board_poses_in_view(CAMERA, BOARD, REACH)
    for k in range(0, 120, 10):
        coach.guide.add([frame_observation(held.pose(k), rng, f"{k}")])
    advice = coach.guide.advise([frame_observation(held.pose(7), rng, "x")])
    (lens,) = advice.lenses
    in_px, in_mm = lens.remaining
    assert in_px.reached and in_mm.requirement.goal.unit == "mm"
    calibration = coach.guide.lenses[0].calibration
    assert calibration is not None
    assert in_mm.error == pytest.approx(length_error_mm(calibration, length), rel=0.005)
    assert in_mm.error <= 0.2 and advice.enough
