"""The difference of two cameras, rigs or mounts as figures, as text, and as a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from rigkit.calibration.compare import CameraVerdict
from rigkit.calibration.rig.compare import RigDifference
from rigkit.core.printing import length_words
from rigkit.core.tables import Table, cells, columns
from rigkit.io.disk.writing import write_atomic
from rigkit.report.pages.page_facts import PageFacts, build_facts_page
from rigkit.report.pictures.figures import difference_png
from rigkit.workflows.checks.diff import BoardsPair, CameraPair, RigPair
from rigkit.workflows.outputs.provenance import digest_line, software_facts

NO_VERDICT = "no verdict: a file of another tool has no covariance; compare calibrations of rigkit"
Pair = CameraPair | RigPair | BoardsPair


def figures_of(pair: Pair) -> dict[str, Any]:
    """Return the figures for machine-readable output."""
    if isinstance(pair, BoardsPair):
        return _boards_figures(pair)
    return _rig_figures(pair) if isinstance(pair, RigPair) else _camera_figures(pair)


def words_of(pair: Pair) -> list[str]:
    """Return the difference as lines of text, the verdict last."""
    if isinstance(pair, BoardsPair):
        return _boards_in_words(pair)
    if isinstance(pair, RigPair):
        return _rigs_in_words(pair, _rig_figures(pair))
    return _camera_in_words(_camera_figures(pair)).split("\n")


def facts_of(pair: Pair) -> PageFacts:
    """Return the contents of the page of a difference."""
    *sentences, verdict = words_of(pair)
    cameras = _cameras_of(pair)
    tables = [_camera_table(cameras)] if cameras else []
    if isinstance(pair, RigPair) and pair.mounts.mounts:
        tables.append(_mount_table("Extrinsics", pair.mounts))
    if isinstance(pair, BoardsPair):
        tables += [_mount_table(f"Boards with {name}", target) for name, target in pair.targets.items()]
    sentences = [line[0].upper() + line[1:] + "." for line in sentences]
    if isinstance(pair, CameraPair):
        # First the verdict with its own figures: the difference, and the expected difference.
        verdict, sentences = f"{sentences[0][:-1]}; {verdict}", []
    return PageFacts(
        headline=verdict[0].upper() + verdict[1:] + ".",
        badge={True: "no contradiction", False: "not the same", None: "no verdict"}[pair.same],
        passed=pair.same,
        sentences=tuple(sentences),
        tables=tuple(tables),
    )


def write_diff_page(path: Path, pair: Pair, files: tuple[Path, Path], *, force: bool) -> None:
    """Write the difference of two `files` as a page; its path was checked by `diff`."""
    pictures = [
        (f"{name} difference over the image".strip(), partial(difference_png, own.difference, name))
        for name, own in _cameras_of(pair).items()
    ]
    alike = files[0].name == files[1].name
    names = [str(Path(p.resolve().parent.name, p.name)) if alike else p.name for p in files]
    digests = zip("AB", names, map(digest_line, files), strict=True)
    provenance = software_facts() | {f"{which} {name}": digest for which, name, digest in digests}
    title = f"rigkit diff: {names[0]} and {names[1]}"
    write_atomic(path, build_facts_page(title, facts_of(pair), provenance, pictures=pictures), force=force)


def _cameras_of(pair: Pair) -> Mapping[str, CameraPair]:
    if isinstance(pair, CameraPair):
        return {"": pair}
    return pair.cameras if isinstance(pair, RigPair) else {}


def _camera_table(cameras: Mapping[str, CameraPair]) -> Table:
    heads = columns(
        "camera | difference rms [px] .4 | at most [px] .4 | expected if unchanged [px] .4 | ratio .2 | p-value | "
        "rotation removed [deg] .4 | of the image [%] .0 | verdict"
    )
    rows = []
    for name, own in cameras.items():
        f = _camera_figures(own)
        numbers = (f["rms_px"], f["max_px"], f["predicted_px"], f["ratio"])
        tail = (f["rotation_deg"], 100.0 * f["coverage"], f["verdict"] or "no covariance")
        rows.append(cells(name or "camera", *numbers, _chance(f["chance"]), *tail))
    note = (
        "Where both had boards, after the best rotation: the orientation of a camera's frame differs between "
        "calibrations. p-value: of at least this difference between two calibrations of one camera."
    )
    return Table("cameras", "Intrinsics", heads, tuple(rows), note)


def _mount_table(title: str, difference: RigDifference) -> Table:
    heads = columns("which | moved by [mm] | rotated by [deg] .4 | p-value")
    rows = tuple(cells(m.name, m.shift_mm, m.rotation_deg, _chance(m.chance)) for m in difference.mounts)
    return Table("mounts", title, heads, rows, "Relative to the first camera or board.")


def _chance(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _camera_figures(pair: CameraPair) -> dict[str, Any]:
    """Return the figures for machine-readable output; `same` is None where a file has no covariance."""
    compared, difference = pair.compared, pair.difference
    of_both = {
        "predicted_px": compared and compared.predicted_px,
        "usual_px": compared and list(compared.interval_px),
        "ratio": compared and compared.ratio,
        "chance": compared and compared.chance,
        "verdict": compared and str(compared.verdict),
    }
    own = {name: getattr(difference, name) for name in ("rms_px", "max_px", "rotation_deg", "coverage")}
    return own | of_both | {"same": pair.same, "same_model": compared and compared.same_model}


def _camera_in_words(figures: dict[str, Any]) -> str:
    known = figures["same"] is not None
    line = (
        f"difference {figures['rms_px']:.4f} px rms, {figures['max_px']:.4f} px at most, over "
        f"{100 * figures['coverage']:.0f} % of the image{', where both had boards' if known else ''}, after a rotation "
        f"of {figures['rotation_deg']:.4f} deg\n"
    )
    if not known:
        return line + NO_VERDICT
    low, high = figures["usual_px"]
    at = f" at {figures['rms_px']:.2g} px" if figures["verdict"] == CameraVerdict.UNIMPORTANT else ""
    # Of normal size but significant: the difference is in a place or a direction that both know more precisely.
    how = "" if figures["same"] or figures["rms_px"] > high else ", but where both are more certain"
    return line + (
        f"expected of one camera {figures['predicted_px']:.4f} px (90 % interval {low:.3f} to {high:.3f}), ratio "
        f"{figures['ratio']:.2f}{how} (p = {figures['chance']:.3g}): {figures['verdict']}{at}"
        + ("" if figures["same_model"] else "; p includes how differently the two models fit one lens")
    )


def _rig_figures(pair: RigPair) -> dict[str, Any]:
    """Return the figures of the mounts, and of the cameras."""
    return {
        "mounts": [asdict(m) for m in pair.mounts.mounts],
        "chance": pair.mounts.chance,
        "scale": pair.mounts.scale,
        "cameras": {name: _camera_figures(own) for name, own in pair.cameras.items()},
        "same": pair.same,
    }


def _boards_figures(pair: BoardsPair) -> dict[str, Any]:
    """Return the figures of the boards of every mount."""
    targets = {n: {"boards": [asdict(m) for m in t.mounts], "chance": t.chance} for n, t in pair.targets.items()}
    return {"targets": targets, "same": pair.same}


def _boards_in_words(pair: BoardsPair) -> list[str]:
    lines = [line for target in pair.targets.values() for line in _mounts_in_words(target)]
    chances = ", ".join(f"{target.chance:.3g}" for target in pair.targets.values())
    verdict = "the boards did not move" if pair.same else "NOT the same: a board moved"
    return [*lines, f"{verdict} (all boards jointly: p = {chances})"]


def _mounts_in_words(difference: RigDifference) -> list[str]:
    return [
        f"{m.name}: moved by {length_words(m.shift_mm, decimals=3)} mm, rotated by {m.rotation_deg:.4f} deg"
        + ("" if m.chance is None else f" (p = {m.chance:.3g})")
        for m in difference.mounts
    ]


def _rigs_in_words(pair: RigPair, figures: dict[str, Any]) -> list[str]:
    lines = _mounts_in_words(pair.mounts)
    lines += [f"{name}: {_camera_in_words(own)}".replace("\n", "; ") for name, own in figures["cameras"].items()]
    if figures["same"] is None:
        return [*(line.removesuffix(f"; {NO_VERDICT}") for line in lines), NO_VERDICT]
    chance = "" if figures["chance"] is None else f" (all extrinsics jointly: p = {figures['chance']:.3g})"
    verdict = "the same rig" if figures["same"] else "NOT the same rig: a camera or a lens moved"
    scale, lenses = pair.mounts.scale, all(own.same is not False for own in pair.cameras.values())
    if scale is not None and lenses:
        # With two cameras, a scale and a shift along the baseline are indistinguishable.
        how = ", or one camera moved along the baseline" if len(figures["cameras"]) == 2 else ""
        verdict = (
            f"NOT the same rig: lengths of the second are {scale:.5g} times those of the first, and nothing else "
            f"differs: the square size of the boards was declared differently{how}"
        )
    return [*lines, f"{verdict}{chance}"]
