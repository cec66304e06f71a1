"""The page of a dense cloud in a real browser: it is drawn, it turns, and nothing comes from the network."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers.browser import probed

from rigkit.core.cloud import OrientedCloud
from rigkit.report.pages.cloud_page import MAX_DRAWN, build_cloud_page

PROBE = """<script>
const canvas = document.querySelector("canvas[data-cloud]"), box = document.querySelector("[data-shape]");
const pixels = () => [...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data];
const drawn = () => { window.dispatchEvent(new Event("beforeprint")); return pixels(); };
const count = (image, colour) =>
  image.filter((v, i) => i % 4 === colour && v > 200 && image[i + 3 - colour] > 0).length;
const before = drawn(), first = canvas.dataset.view;
canvas.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowLeft"}));
const after = drawn(), second = canvas.dataset.view;
box.checked = true;
const grey = drawn();
const differ = before.filter((v, i) => v !== after[i]).length;
const same = grey.filter((v, i) => i % 4 === 0 && (v !== grey[i + 1] || v !== grey[i + 2])).length;
const rows = before.flatMap((v, i) => i % 4 === 3 && v ? [Math.floor(i / 4 / canvas.width)] : []);
const columns = before.flatMap((v, i) => i % 4 === 3 && v ? [Math.floor(i / 4) % canvas.width] : []);
columns.sort((a, b) => a - b);
const wide = (columns[columns.length - 1] - columns[0]) / canvas.width;
const tall = (rows[rows.length - 1] - rows[0]) / canvas.height;
document.body.dataset.probe = [first, second, count(before, 0), count(before, 2), differ, same, tall, wide].join("|");
</script></body>"""


def sheets(count: int, rng: np.random.Generator) -> OrientedCloud:
    """A red sheet before a blue one of the same size: seen from the front the red one hides most of the other."""
    points = rng.uniform(-100.0, 100.0, (count, 3))
    points[:, 2] = np.where(np.arange(count) % 2, 500.0, 530.0)
    near = points[:, 2] < 510.0
    return OrientedCloud(
        points_mm=points,
        normals=np.tile([0.0, 0.0, -1.0], (count, 1)),
        colours=np.where(near[:, None], [255, 0, 0], [0, 0, 255]).astype(np.uint8),
        board_index=np.full(count, -1),
        grid=np.zeros((count, 2), dtype=np.int64),
        sigma_mm=np.full(count, 0.25),
        normal_sigma_rad=np.full(count, 0.01),
        board_ids=(),
    )


def test_a_cloud_is_drawn_near_points_before_far_ones_and_turns(tmp_path: Path, rng: np.random.Generator) -> None:
    page = build_cloud_page("A < B", sheets(60_000, rng), {"rigkit": "x"}, unit="mm")
    assert not re.search(r"""(src|href)=["']?https?:""", page)
    assert "A &lt; B" in page
    assert "half of them known to 0.25 mm or better" in page
    first, second, red, blue, differ, coloured, *_ = probed(page.replace("</body>", PROBE), tmp_path)
    assert abs(float(first.split()[0]) - float(second.split()[0])) > 0.05
    assert int(red) > 20_000
    assert 0 < int(blue) < 0.5 * int(red)
    assert int(differ) > 10_000
    assert int(coloured) == 0


def test_a_deep_cloud_fills_the_first_view(tmp_path: Path, rng: np.random.Generator) -> None:
    cloud = sheets(20_000, rng)
    deep = replace(
        cloud, points_mm=cloud.points_mm * [1.0, 1.0, 0.0] + [[0.0, 0.0, 1.0]] * rng.uniform(500, 1700, (20_000, 1))
    )
    *_, tall, wide = probed(build_cloud_page("deep", deep, {}, unit="mm").replace("</body>", PROBE), tmp_path)
    assert 0.8 < max(float(tall), float(wide)) < 1.0


def test_of_very_many_points_some_are_shown(rng: np.random.Generator) -> None:
    page = build_cloud_page("many", sheets(2 * MAX_DRAWN + 2, rng), {}, unit="mm")
    shown = re.search(r'data-count="(\d+)"', page)
    assert shown is not None
    assert 0.5 * MAX_DRAWN < int(shown[1]) <= MAX_DRAWN
    assert f"{shown[1]} are shown" in page
