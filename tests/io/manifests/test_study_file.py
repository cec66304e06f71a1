"""Study files, and running them: interrupted, in several processes, the same numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rigkit.core.errors import InputError
from rigkit.core.posetype import PoseType
from rigkit.io.manifests.study_file import load_study
from rigkit.synthetic.noise import NoisyImages
from rigkit.workflows.study import run_study, study_key

ROOT = Path(__file__).resolve().parents[3]
MINIMAL = """
schema = "rigkit.study/1"
name = "small"
trials = 120
seed = 3
pose_types = ["general", "forward"]
methods = ["F2UDIR", "3SDIR"]

[noise]
on = "directions"
sigma_deg = [0, 2.5]
"""
FULL = (
    MINIMAL.replace("sigma_deg = [0, 2.5]", 'sigma_px = [0.1]\nimages = "2"').replace('"directions"', '"corners"')
    + """
[estimation]
support = "neighbours"
det_scale = "ls"
epipolar = "estimated"
min_conditioning = 0.1

[scene]
board = { columns = 5, rows = 4, square_mm = 30 }
focal_px = 900
centre_px = [400, 300]
parallax_deg = [10, 20]
baseline_mm = 100
in_plane_deg = -10

[[claims]]
text = "order"
smaller = { method = "3SDIR", plane = 1, sigma = 0.1, pose_type = "general" }
larger = { method = "F2UDIR", plane = 2, sigma = 0.1, pose_type = "forward" }
"""
)


def write(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(text)
    return path


def test_everything_is_read(tmp_path: Path) -> None:
    study = load_study(write(tmp_path, FULL))
    assert study.pose_types == (PoseType.GENERAL, PoseType.FORWARD)
    assert (study.noise, study.sigmas, study.images) == ("corners", (0.1,), NoisyImages.SECOND)
    assert (study.support, study.det_scale, study.epipolar, study.min_conditioning) == (
        "neighbours",
        "ls",
        "estimated",
        0.1,
    )
    assert (study.board.size, study.board.square_x_mm) == ((5, 4), 30.0)
    assert (study.focal_px, study.centre_px, study.parallax_deg) == (900.0, (400.0, 300.0), (10.0, 20.0))
    assert (study.baseline_mm, study.in_plane_deg) == (100.0, -10.0)
    assert study.claims[0].smaller == {"method": "3SDIR", "plane": 1, "sigma": 0.1, "pose_type": "general"}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("trials = 120", "", "'trials' is missing"),
        ("seed = 3", "seed = 3\nspeed = 4", "unknown key 'speed'; did you mean 'seed'"),
        ('"forward"]', '"backward"]', "'backward', which is unknown"),
        ("sigma_deg", "sigma_px", "'sigma_deg' is missing"),
        ('"3SDIR"', '"3DIR"', "'3DIR' is unknown"),
    ],
)
def test_refusals(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_study(write(tmp_path, MINIMAL.replace(old, new)))


def test_shipped_studies_are_read() -> None:
    paths = sorted((ROOT / "datasets" / "synthetic").glob("*.toml"))
    assert len(paths) >= 6
    names = [load_study(path).name for path in paths]
    assert names == [path.stem for path in paths]


def test_interruptions_do_not_change_the_numbers(tmp_path: Path) -> None:
    study = load_study(write(tmp_path, MINIMAL))
    alone = run_study(study)
    assert [chunk.shape[3] for chunk in alone] == [50, 50, 20]
    parts = tmp_path / "parts"
    reported: list[int] = []

    class Interrupt(Exception):
        pass

    def stop_after_two(what: str, done: int, total: int) -> None:
        reported.append(done)
        if done == 2:
            raise Interrupt

    with pytest.raises(Interrupt):
        run_study(study, parts=parts, progress=stop_after_two)
    left = sorted(parts.iterdir())
    assert len(left) == 2
    # A damaged part is computed again, not trusted.
    left[0].write_bytes(left[0].read_bytes()[:100])
    reported.clear()
    resumed = run_study(study, parts=parts, progress=lambda what, done, total: reported.append(done))
    assert reported == [1, 2, 3]
    for first, second in zip(alone, resumed, strict=True):
        np.testing.assert_array_equal(first, second)
    assert not parts.exists()


@pytest.mark.thorough
def test_processes_do_not_change_the_numbers(tmp_path: Path) -> None:
    study = load_study(write(tmp_path, MINIMAL))
    for one, two in zip(run_study(study), run_study(study, jobs=2), strict=True):
        np.testing.assert_array_equal(one, two)


def test_the_key_depends_on_everything_that_matters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = load_study(write(tmp_path, MINIMAL))
    keys = {study_key(study)}
    for old, new in (("seed = 3", "seed = 4"), ("[0, 2.5]", "[0, 2.6]"), ('"3SDIR"', '"2SDIR"'), ("120", "121")):
        keys.add(study_key(load_study(write(tmp_path, MINIMAL.replace(old, new)))))
    assert len(keys) == 5
    renamed = MINIMAL.replace('"small"', '"other"') + '[[claims]]\ntext = "x"\nsmaller = {}\nlarger = {}\n'
    assert study_key(load_study(write(tmp_path, renamed))) == study_key(study)
    # What other code left half done is not mixed with what this code computes.
    monkeypatch.setattr("rigkit.workflows.study.source_hash", lambda: "other code")
    assert study_key(study) not in keys


def test_dask_without_dask_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib

    def absent(name: str) -> None:
        raise ImportError(name=name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(InputError, match="pip install joblib distributed"):
        run_study(load_study(write(tmp_path, MINIMAL)), dask="tcp://localhost:1")


def test_a_dask_cluster_gives_the_same_numbers(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="needs: pip install joblib distributed")
    pytest.importorskip("joblib", reason="needs: pip install joblib distributed")
    study = load_study(write(tmp_path, MINIMAL))
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        remote = run_study(study, dask=cluster.scheduler_address)
    for first, second in zip(run_study(study), remote, strict=True):
        np.testing.assert_array_equal(first, second)
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        run_study(study, dask="tcp://127.0.0.1:9")
