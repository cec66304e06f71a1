"""The page of a calibration: in a browser, and its drawings against known values."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import MIN_FONT_PX, probed, probed_at_widths
from helpers.calibration_scenes import BOARD, lens, random_views, with_outliers

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.departures import Departures
from rigkit.calibration.certainty.uncertainty import FarProjection, projection_uncertainty
from rigkit.calibration.diagnosis.verdicts import diagnose
from rigkit.calibration.result import Calibration, Candidate
from rigkit.calibration.with_pupil import CENTRAL, MOVING, kept_central
from rigkit.cameras.eucm import EUCM
from rigkit.cli.calibration_output import describe
from rigkit.core.findings import Finding
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import Knowledge
from rigkit.planning.plan import plan_views
from rigkit.report.pages.calibration_drawings import pattern_svg, residuals_svg, uncertainty_svg
from rigkit.report.pages.calibration_facts import _coverage_words, focal_words
from rigkit.report.pages.calibration_page import CalibrationSection, build_calibration_page, thumbnail_jpeg
from rigkit.report.pages.plan_page import plan_words

NOISE_PX = 0.2
IMAGES = 20
MAX_BYTES = 5e6

PROBE = """<script>
const drawn = [...document.querySelectorAll(".drawings svg")].map((s) => s.getBoundingClientRect().height > 100);
const loaded = [...document.images].map((i) => i.complete && i.naturalWidth > 0);
document.body.dataset.probe = [drawn.length, drawn.every((v) => v), loaded.length, loaded.every((v) => v),
  document.body.scrollWidth <= innerWidth].join("|");
</script></body>"""
SORT_PROBE = """<script>
const table = document.querySelector("table.pictures");
const cells = (k) => [...table.tBodies[0].rows].map((row) => row.cells[k].textContent.trim());
const press = (k) => table.tHead.rows[0].cells[k].querySelector("button").click();
press(3); const up = cells(3).map(parseFloat); press(3); const down = cells(3).map(parseFloat);
press(1); const names = cells(1);
document.querySelector("button.enlarge").click();
const open = document.querySelector("dialog").open;
const canvas = document.querySelector("canvas[data-scene]");
document.querySelector("button[data-from=top]").click();
const ordered = (a) => a.every((v, i) => i === 0 || a[i - 1] <= v);
const told = [ordered(up), ordered([...down].reverse()), names.join(","), open, canvas.dataset.view];
document.body.dataset.probe += "|" + told.join("|");
</script></body>"""


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    rng = np.random.default_rng(5)
    camera = lens("reg")
    views = with_outliers(random_views(camera, IMAGES, rng, reach_deg=33.0, noise_px=NOISE_PX)[0], 0.01, 40.0, rng)
    result = calibrate(views, camera.size_px, model="brown", board="flat")
    return replace(result, dropped=(("<b>.jpg", "no board & nothing"),))


def page(calibration: Calibration) -> str:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, (1240, 1624), dtype=np.uint8)
    thumbnails = {v.image: thumbnail_jpeg(image, [v]) for v in calibration.views}
    sections = [CalibrationSection("A & B", calibration, thumbnails)]
    return build_calibration_page("title", "lead", sections, {"session.toml": "x"})


@pytest.fixture(scope="module")
def text(calibration: Calibration) -> str:
    return page(calibration)


@pytest.fixture(scope="module")
def found_words(text: str, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What the page is in a browser, which starts once for all: five things of `PROBE`, five of `SORT_PROBE`."""
    probes = PROBE.replace("</body>", SORT_PROBE)
    return probed(text.replace("</body>", probes).replace('loading="lazy"', ""), tmp_path_factory.mktemp("page"))


def test_works_without_network(text: str, found_words: list[str]) -> None:
    assert not re.search(r"""(src|href)=["']?https?:""", text)
    assert len(text) < MAX_BYTES
    assert "&lt;b&gt;.jpg" in text and "<b>.jpg" not in text
    assert found_words[:5] == ["8", "true", str(IMAGES), "true", "true"]


@pytest.mark.thorough
def test_fits_a_phone_a_tablet_and_a_screen(calibration: Calibration, tmp_path: Path) -> None:
    for width, (wide, small) in probed_at_widths(page(calibration), tmp_path)[0].items():
        assert wide <= width
        assert small >= MIN_FONT_PX


def test_tables_sort_pictures_enlarge_and_the_view_turns(calibration: Calibration, found_words: list[str]) -> None:
    up, down, names, open_, view = found_words[5:]
    assert (up, down, open_) == ("true", "true", "true")
    images = sorted((v.image for v in calibration.views), key=lambda n: int(re.sub(r"\D", "", n)))
    assert names.split(",") == images
    assert view.split()[:2] == ["0.000", "1.571"]


def test_a_training_rms_above_the_heldout_one_is_explained(calibration: Calibration) -> None:
    odd = replace(calibration, heldout_rms_px=0.5 * calibration.rms_px)
    for text in (describe(odd), page(odd)):
        assert re.search(
            r"training RMS [\d.]+ px \(.*equal weights; the held-out RMS weights corners by their sigmas\)", text
        )
    assert "equal weights" not in describe(replace(calibration, heldout_rms_px=2.0 * calibration.rms_px))


def test_chosen_models_are_named_as_chosen(calibration: Calibration) -> None:
    """Whether the lens looks from one point is no model of it, and what was not kept is not called chosen."""
    asked = [Candidate(name, 9, 0.1, 0.1, name == MOVING, f"why {name}") for name in (CENTRAL, MOVING)]
    models = [Candidate(name, 9, 0.1, 0.1, name == "brown 5", f"why {name}") for name in ("ucm", "brown 5")]
    moving, central = (
        describe(replace(calibration, candidates=(*models, *two))) for two in (asked, kept_central(asked))
    )
    for printed in (moving, central):
        assert "model brown 5, of 2 compared: why brown 5" in printed
    assert f"lens with {MOVING}, of 2 compared: why {MOVING}" in moving
    assert f"lens with {CENTRAL}, of 2 compared: a moving pupil is not significant" in central
    assert [one.reason for one in kept_central(models)] == [one.reason for one in models]


def reported_focal_px(calibration: Calibration) -> tuple[float, float]:
    """Return the focal length and its standard deviation as they are printed."""
    pattern = r"focal length on the axis ([\d.]+) ± ([\d.]+) px, horizontal field of view [\d.]+ degrees"
    words = re.search(pattern, describe(calibration))
    assert words is not None and "focal length on the axis" in page(calibration)
    return float(words[1]), float(words[2])


def test_the_focal_length_is_told_whatever_a_model_calls_fx(calibration: Calibration) -> None:
    focal_px, sigma_px = reported_focal_px(calibration)
    fx, fy = calibration.camera.parameters[:2]
    half = 0.5 * np.array([np.sqrt(fy / fx), np.sqrt(fx / fy)])
    expected = calibration.widening * np.sqrt(half @ calibration.covariance[:2, :2] @ half)
    assert focal_px == pytest.approx(np.sqrt(fx * fy), abs=0.01 * sigma_px + 0.01)
    assert sigma_px == pytest.approx(expected, rel=0.05)
    truth = lens("wide")
    views = random_views(truth, IMAGES, np.random.default_rng(2), reach_deg=55.0, noise_px=NOISE_PX)[0]
    sphere = calibrate(views, truth.size_px, model="double_sphere", board="flat")
    focal_px, sigma_px = reported_focal_px(sphere)
    assert abs(sphere.camera.parameters[0] - truth.focal_px) > 50.0 > 10.0 * abs(focal_px - truth.focal_px)


def test_the_focal_length_of_a_lens_at_the_edge_of_its_model_is_told(calibration: Calibration) -> None:
    fx, fy, cx, cy = calibration.camera.parameters[:4].tolist()
    camera = EUCM(calibration.camera.size_px, np.array([fx, fy, cx, cy, 0.0, 1.0]))
    covariance = np.diag([4.0, 4.0, 1.0, 1.0, 1e-4, 1e-2])
    edge = replace(calibration, camera=camera, covariance=covariance, frame_covariance=np.eye(12), rivals=())
    expected = edge.widening * np.sqrt(0.25 * (fy / fx + fx / fy) * 4.0)
    focal, sigma = (float(word) for word in focal_words(edge).removesuffix(" px").split(" ± "))
    assert focal == pytest.approx(np.sqrt(fx * fy), rel=1e-3)
    assert sigma == pytest.approx(expected, rel=0.1)


def test_the_page_has_the_figures_of_the_calibration(calibration: Calibration) -> None:
    text = re.sub(r'src="data:[^"]*"', "", page(calibration))
    assert f"held-out RMS <b>{calibration.heldout_rms_px:.3f} px</b>" in text
    assert f"training RMS {calibration.rms_px:.3f} px" in text
    for verdict in calibration.verdicts:
        assert verdict.text.split("'")[0] in text
    for view in calibration.views:
        assert re.search(
            rf'<td class="text">{view.image}</td>.*?{view.rms_px:.3f}</td><td>{int(view.kept.sum())}</td>', text
        )


def test_residual_vectors_are_true_to_their_magnification(calibration: Calibration) -> None:
    svg = residuals_svg(calibration)
    times = float(re.search(r"magnified ([\d.e+]+) times", svg)[1])  # type: ignore[index]
    drawn = np.array(re.findall(r"M([-\d.]+) ([-\d.]+)l([-\d.]+) ([-\d.]+)", svg.split(" stroke")[0]), dtype=float)
    kept = np.concatenate([v.kept for v in calibration.views])
    residuals = np.concatenate([v.residuals_px for v in calibration.views])[kept]
    zoom = 600.0 / calibration.camera.size_px[0]
    assert len(drawn) == kept.sum() < len(kept)
    # Drawn to a tenth of a unit.
    assert np.abs(drawn[:, 2:] / (zoom * times) - residuals).max() < 0.06 / (zoom * times)
    assert f"crosses: {(~kept).sum()} corners" in svg


def test_numbers_on_the_uncertainty_map(calibration: Calibration) -> None:
    svg = uncertainty_svg(calibration)
    width, height = calibration.camera.size_px
    for u, v in ((0.0, 0.0), (width - 1.0, 0.0), (0.5 * (width - 1), 0.5 * (height - 1)), (width - 1.0, height - 1.0)):
        worst = float(projection_uncertainty(calibration, np.array([u, v])).worst_px)
        assert f">{worst:.3g}<" in svg


def test_residual_patterns_separate_chance_from_a_lens_that_does_not_fit(calibration: Calibration) -> None:
    def coloured(c: Calibration) -> tuple[int, int]:
        found = re.search(r"(\d+) of (\d+) significant", pattern_svg(c))
        assert found is not None
        return int(found[1]), int(found[2])

    beyond, cells = coloured(calibration)
    # One per cent by chance; ten times that would not be chance in a hundred cells.
    assert cells > 50 and beyond <= 0.1 * cells
    camera = lens("reg")
    views = random_views(camera, IMAGES, np.random.default_rng(6), reach_deg=33.0, noise_px=0.02, board=BOARD)[0]
    wrong = calibrate(views, camera.size_px, model="ucm", board="flat", folds=0)
    beyond, cells = coloured(wrong)
    assert beyond > 0.3 * cells


def test_the_pictures_to_take_next_are_on_the_page(calibration: Calibration) -> None:
    plan = plan_views(Knowledge.of(calibration), [BOARD], projection_goal(calibration.camera), 2)
    text = build_calibration_page("t", "l", [CalibrationSection("cam", calibration, {}, plan)], {})
    assert "Next 2 images to take" in text and plan_words(plan)[1] in text
    assert "images to take" not in build_calibration_page("t", "l", [CalibrationSection("cam", calibration)], {})


def test_the_headline_and_the_finding_have_one_figure(calibration: Calibration) -> None:
    unsure = replace(
        calibration, covariance=25.0 * calibration.covariance / FarProjection.of(calibration).worst_px ** 2
    )
    judged = replace(unsure, verdicts=diagnose(unsure))
    text = page(judged)
    headline = re.search(r"where boards were seen \(at worst ±([\d.]+) px", text)
    finding = re.search(r"uncertainty reaches ([\d.]+) px \(one standard deviation\) where boards were seen", text)
    assert headline is not None and finding is not None
    assert float(headline[1]) == float(finding[1]) == 5.0


def test_the_sentence_and_the_map_have_one_worst_place(calibration: Calibration) -> None:
    text = page(calibration)
    beyond = re.search(r"at worst ±([\d.e+]+) px elsewhere", text)
    drawn = re.search(r"px at best, ([\d.e+]+) px at worst", text)
    assert beyond is not None and drawn is not None
    assert beyond[1] == f"{float(drawn[1]):.2g}"


@pytest.mark.parametrize(("most", "advice"), [(np.inf, "image can be used"), (0.0, "inside the dashed line")])
def test_what_a_bad_calibration_says_of_the_rest_of_the_image_is_no_advice(
    most: float, advice: str, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rigkit.report.pages.calibration_facts.MAX_RATIO_BEYOND", most)
    printed = [
        _coverage_words(replace(calibration, verdicts=(finding,)))
        for finding in (Finding.good("well"), Finding.bad("ill"))
    ]
    assert "px elsewhere" in printed[1] and printed[0].startswith(printed[1].rstrip("."))
    assert advice in printed[0] and advice not in printed[1]


@pytest.mark.parametrize("range_mm", [500.0, np.inf])
def test_uncertainties_near_and_far_are_widened_where_few_images_tell_them(
    calibration: Calibration, range_mm: float
) -> None:
    """What the images leave open grows by the square of the widening; what models leave out stays."""
    pixels = np.array([[100.0, 80.0], [300.0, 200.0]])
    known = [replace(calibration, freedom=freedom) for freedom in (2.0, 5.0, 500.0)]
    a, b, many = (projection_uncertainty(c, pixels, range_mm=range_mm).covariance for c in known)
    of_a, of_b, of_many = (Departures.of(c).noise.widening ** 2 for c in known)
    assert of_a > of_b > of_many
    by_a, by_b = (a - many) / (of_a - of_many), (b - many) / (of_b - of_many)
    np.testing.assert_allclose(by_a, by_b, rtol=1e-6)
    assert (np.linalg.eigvalsh(by_a) > 0.0).all()
