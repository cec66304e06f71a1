"""`rigkit validate`: every pair and every estimator against what a person measured."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.cli.console import note, print_json, progress_on_stderr
from rigkit.cli.workflow import (
    add_dataset_arguments,
    exit_code_of,
    failed_pairs,
    find_boards,
    geometry_of,
    load_cameras,
    match_found,
    output_folder,
    over_pairs,
    reconstruct_other_chain,
    select_dataset,
    shifts_of,
    write_results,
)
from rigkit.core.errors import ExitCode, InputError

if TYPE_CHECKING:
    from rigkit.cli.workflow import LoadedCamera, PairFailure
    from rigkit.io.manifest import Dataset, Pair
    from rigkit.reconstruction.pairing import MatchedPair
    from rigkit.reconstruction.reconstruct import Reconstruction
    from rigkit.report.page import PairSection
    from rigkit.validation.checks import ValidationReport
    from rigkit.validation.crosscheck import CrossCheckReport
    from rigkit.validation.intrinsics import CalibrationShifts
    from rigkit.validation.tables import PaperTables, Table

HELP = "the tables against measured truth, report and PLY; exit code 1 if a check fails"

PAPER = "hajder2021"
"""Folder with the paper's tables, beside the data set."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_dataset_arguments(parser)
    parser.add_argument("--no-pictures", action="store_true", help="leave out PNG pictures and the HTML report")
    parser.add_argument(
        "--figures", choices=("png", "pdf"), default="png", help="pdf: the pictures for a paper as well (vectors)"
    )
    parser.add_argument("--no-crosscheck", action="store_true", help="leave out the comparison with pycolmap")


def run(args: argparse.Namespace) -> int:
    dataset = select_dataset(args)
    return validate_dataset(args, dataset, output_folder(args, dataset.name))


def validate_dataset(args: argparse.Namespace, dataset: Dataset, out: Path) -> int:
    """Validate every pair of a data set, write the results into `out` and return the exit code."""
    started = time.monotonic()
    if not any(pair.truth.count for pair in dataset.pairs):
        raise InputError(
            f"{dataset.manifest}: nothing was measured of these pairs; add a baseline or angles under [pairs.truth]"
        )
    paper = _paper_tables(dataset)
    progress = progress_on_stderr()
    cameras = load_cameras(dataset, recalibrate=args.recalibrate, progress=progress)
    jobs = [
        PairJob(
            pair,
            cameras,
            args.chain,
            not args.no_pictures,
            not args.no_crosscheck,
            args.figures == "pdf",
        )
        for pair in dataset.pairs
    ]
    outcomes, failures = over_pairs(validate_pair, jobs, args.jobs, "reconstructing and validating pairs", progress)
    return finish(args, dataset, outcomes, failures, paper, out, time.monotonic() - started)


@dataclass(frozen=True, eq=False, slots=True)
class PairJob:
    """What one process needs to know of one pair."""

    pair: Pair
    cameras: Mapping[str, LoadedCamera]
    chain: str
    pictures: bool
    crosscheck: bool
    pdf: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class PairOutcome:
    """What comes back: the reports by estimator, files by relative path, and the page's section."""

    pair_id: str
    reports: tuple[ValidationReport, ...]
    best: ValidationReport
    other_ways: CrossCheckReport | None
    causes: tuple[str, ...]
    files: Mapping[str, bytes]
    section: PairSection | None


def validate_pair(job: PairJob) -> PairOutcome:
    """Reconstruct one pair with every estimator and judge each."""
    from rigkit.core.errors import RigkitError
    from rigkit.validation.diagnose import camera_suspects

    pair = job.pair
    names = (pair.camera1.camera_id, pair.camera2.camera_id)
    camera1, camera2 = (job.cameras[name].camera for name in names)
    found1, found2, image1, image2 = find_boards(pair, camera1, camera2)
    known = {name: loaded.camera for name, loaded in job.cameras.items()}
    causes = camera_suspects(pair.pair_id, names, (found1, found2), pair.boards, known)
    try:
        return _judge(job, match_found(pair, camera1, camera2, found1, found2, job.chain), image1, image2, causes)
    except RigkitError as error:
        if not causes:
            raise
        raise type(error)(f"{error}; probable cause: {'; '.join(causes)}") from error


def _judge(job: PairJob, matched: MatchedPair, image1: Any, image2: Any, causes: tuple[str, ...]) -> PairOutcome:
    from rigkit.affine.registry import AFFINE_METHODS
    from rigkit.io.ply import ply_bytes
    from rigkit.reconstruction.reconstruct import reconstruct_from
    from rigkit.validation.checks import validate_each
    from rigkit.validation.crosscheck import crosscheck
    from rigkit.validation.tables import best_report

    pair = job.pair
    geometry = geometry_of(matched, pair)
    reconstructions = {m: reconstruct_from(geometry, affine_method=m, image1=image1) for m in AFFINE_METHODS}
    shifts = _shifts(reconstructions, job)
    reports = validate_each(list(reconstructions.values()), pair.truth, [shifts[m] for m in reconstructions])
    best = best_report(reports)
    files: dict[str, bytes] = {
        f"{pair.pair_id}/{method}.ply": ply_bytes(r.cloud) for method, r in reconstructions.items()
    }
    shown = reconstructions[best.affine_method]
    other_ways = None
    if job.crosscheck:
        other = reconstruct_other_chain(matched, pair)
        other_ways = crosscheck(shown, other_chain=other, shifts=shifts[best.affine_method])
    section = (
        _pictures(reconstructions, shown, reports, other_ways, image1, image2, files, job.pdf) if job.pictures else None
    )
    return PairOutcome(pair.pair_id, reports, best, other_ways, causes, files, section)


def _shifts(reconstructions: Mapping[str, Reconstruction], job: PairJob) -> dict[str, CalibrationShifts | None]:
    """Return what the calibrations' uncertainty does to each reconstruction, by estimator.

    The likelihood sees the corners, not the affinities: estimators that kept the same corners share the answer.
    """
    cameras = (job.cameras[job.pair.camera1.camera_id], job.cameras[job.pair.camera2.camera_id])
    known: list[tuple[Reconstruction, CalibrationShifts | None]] = []
    out: dict[str, CalibrationShifts | None] = {}
    for method, reconstruction in reconstructions.items():
        same = [shifts for first, shifts in known if first.same_points(reconstruction)]
        out[method] = same[0] if same else shifts_of(reconstruction, *cameras)
        if not same:
            known.append((reconstruction, out[method]))
    return out


def _pictures(
    reconstructions: Mapping[str, Reconstruction],
    reconstruction: Reconstruction,
    reports: tuple[ValidationReport, ...],
    other_ways: CrossCheckReport | None,
    image1: Any,
    image2: Any,
    files: dict[str, bytes],
    pdf: bool,
) -> PairSection:
    """Draw the pair's pictures into `files`; return the section of the page, with the same pictures as JPEG."""
    from rigkit.report.drawings import normal_errors_svg, residuals_svg
    from rigkit.report.figures import as_jpeg, as_pdf, as_png, cloud_figure, corners_figure, epipolar_figure
    from rigkit.report.validation_page import crosscheck_table, pair_section

    figures = {
        "corners": corners_figure(reconstruction, image1, image2),
        "epipolar": epipolar_figure(reconstruction, image1, image2),
        "cloud": cloud_figure(reconstruction),
    }
    drawn = {name: as_png(figure) for name, figure in figures.items()}
    for name, figure in figures.items():
        files[f"{reconstruction.pair_id}/{name}.png"] = drawn[name]
        if pdf:
            files[f"{reconstruction.pair_id}/{name}.pdf"] = as_pdf(figure)
    shown = [
        ("Corners as found and matched", "image/jpeg", as_jpeg(drawn["corners"])),
        ("Epipolar curves of every seventh corner", "image/jpeg", as_jpeg(drawn["epipolar"])),
        ("What the corners leave over", "image/svg+xml", residuals_svg(reconstruction).encode()),
        ("Normal errors of the estimators", "image/svg+xml", normal_errors_svg(reconstructions, reports).encode()),
    ]
    extra = [] if other_ways is None else [crosscheck_table([other_ways])]
    return pair_section(reconstruction, reports, shown, extra)


def finish(
    args: argparse.Namespace,
    dataset: Dataset,
    outcomes: list[PairOutcome],
    failures: tuple[PairFailure, ...],
    paper: PaperTables | None,
    out: Path,
    seconds: float,
) -> int:
    """Write tables, clouds, pictures and the page; print the summary; return the exit code."""
    from rigkit.report.page import build_page
    from rigkit.report.tables import tables_to_csv, tables_to_json, tables_to_latex, tables_to_markdown, tables_to_text
    from rigkit.report.validation_page import crosscheck_table, summary_table
    from rigkit.validation.diagnose import suspects
    from rigkit.validation.tables import build_tables

    reports = [report for outcome in outcomes for report in outcome.reports]
    compared = [outcome.other_ways for outcome in outcomes if outcome.other_ways is not None]
    passed = not failures and all(r.passed for r in reports) and all(r.passed for r in compared)
    causes = [cause for outcome in outcomes for cause in outcome.causes]
    causes += suspects([outcome.best for outcome in outcomes])
    causes += [f"pair '{report.pair_id}': {words}" for report in compared for words in report.suspects]
    summary = summary_table([outcome.best for outcome in outcomes])
    tables = [summary, *build_tables(reports, paper)]
    if compared:
        tables.insert(-2, crosscheck_table(compared))
    files: dict[str, str | bytes] = {
        "tables.md": tables_to_markdown(tables),
        "tables.csv": tables_to_csv(tables),
        "tables.tex": tables_to_latex(tables),
        "tables.json": tables_to_json(tables),
    }
    for outcome in outcomes:
        files.update(outcome.files)
    sections = [outcome.section for outcome in outcomes if outcome.section is not None]
    if sections:
        lead = f"pairs: {len(outcomes)}; reconstructions: {len(reports)}; {seconds:.0f} s"
        lead += "".join(f"; not validated: {failure}" for failure in failures)
        shown = [table for table in tables if table.key not in ("checks", "estimators")] + _calibrations(dataset)
        title = f"rigkit validation: {dataset.name}"
        files["report.html"] = build_page(title, lead, passed, shown, sections, _provenance(args, dataset))
    write_results(out, files, force=args.force, inputs=dataset.inputs)
    if args.json:
        print_json(
            {
                "passed": passed,
                "output": str(out),
                "causes": causes,
                "reports": [report.to_dict() for report in reports],
            }
            | failed_pairs(failures)
        )
    else:
        print(tables_to_text([summary]))
        _say_failures(reports, compared)
        for cause in causes:
            # Where everything passed it explains nothing, but a person should know.
            if passed:
                note(f"to look at: {cause}")
            else:
                print(f"probable cause: {cause}")
        words = "all checks passed" if passed else "NOT every pair was validated" if failures else "a check FAILED"
        where = out / ("report.html" if sections else "tables.md")
        print(f"{words}; {where}, {seconds:.1f} s")
    return exit_code_of(failures, 0 if passed else ExitCode.CHECK_FAILED)


def _say_failures(reports: list[ValidationReport], compared: list[CrossCheckReport]) -> None:
    for report in reports:
        for c in report.checks:
            if not c.passed:
                print(
                    f"FAILED {report.pair_id} {report.affine_method} {c.name}: {c.ours:.3f} {c.unit}, measured "
                    f"{c.measured:g} ± {c.measured_sigma:g} ({c.how}), off by {c.k:.1f} combined sigmas"
                )
        for words in report.unchecked:
            print(f"NOT CHECKED {report.pair_id} {report.affine_method} {words}")
    for other in compared:
        for c in other.checks:
            if not c.passed:
                print(
                    f"DISAGREES {other.pair_id} {c.name}: {c.ours:.4f} {c.unit}, {c.how} {c.measured:.4f}, "
                    f"{c.k:.1f} combined sigmas apart"
                )
        for words in other.skipped:
            note(f"{other.pair_id}: not cross-checked by {words}")
    for words in dict.fromkeys(f"{report.pair_id}: {n}" for report in reports for n in report.notes):
        note(words)


def _calibrations(dataset: Dataset) -> list[Table]:
    """Return the table of the cameras in use; none where their files say no more than the camera."""
    from rigkit.io.calibration_file import load_calibration
    from rigkit.report.validation_page import camera_table

    used = {name for pair in dataset.pairs for name in (pair.camera1.camera_id, pair.camera2.camera_id)}
    known = {}
    for entry in dataset.cameras:
        if entry.camera_id in used:
            try:
                known[entry.camera_id] = load_calibration(entry.calibration)
            except InputError:
                # Another tool's camera, or a calibration that could not be kept: the reconstruction did without.
                continue
    return [camera_table(known)] if known else []


def _paper_tables(dataset: Dataset) -> PaperTables | None:
    """Return the paper's tables where they lie beside the data set."""
    from rigkit.io.paper_tables import load_paper_tables

    folder = dataset.root.parent / PAPER
    return load_paper_tables(folder) if folder.is_dir() else None


def _provenance(args: argparse.Namespace, dataset: Dataset) -> dict[str, str]:
    """Return what somebody needs to know to get the same page again."""
    import hashlib
    import platform
    from datetime import UTC, datetime
    from importlib.metadata import version

    facts = {"rigkit": version("rigkit"), "Python": platform.python_version()}
    facts |= {name: version(name) for name in ("numpy", "opencv-contrib-python-headless", "open3d", "pycolmap")}
    facts |= {"written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"), "chain": args.chain}

    def digest(path: Path) -> str:
        return f"{path.name}, SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()}"

    facts["manifest"] = digest(dataset.manifest)
    for entry in dataset.cameras:
        if entry.calibration.is_file():
            facts[f"camera {entry.camera_id}"] = digest(entry.calibration)
    for pair in dataset.pairs:
        facts[f"pair {pair.pair_id}"] = f"{digest(pair.image1)}; {digest(pair.image2)}"
    return facts
