"""`rigkit diff`: two calibrations over the image, two rigs, or boards on one mount, against their uncertainties."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigkit.core.errors import ExitCode

if TYPE_CHECKING:
    from rigkit.calibration.rig.compare import RigDifference
    from rigkit.workflows.diff import BoardsPair, CameraPair, RigPair

HELP = "difference of two calibrations over the image: px map and numbers; same camera or not; of rigs; of mounts"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("a", type=Path, metavar="A.json", help="calibration, rig, or boards on one mount")
    parser.add_argument("b", type=Path, metavar="B.json", help="the same of another day")
    parser.add_argument("-o", "--output", type=Path, metavar="MAP.png", help="map of the difference")
    parser.add_argument("--force", action="store_true", help="replace an existing map")
    parser.add_argument("--json", action="store_true", help="print the result for programs")


def run(args: argparse.Namespace) -> int:
    from rigkit.cli.console import print_json
    from rigkit.workflows.diff import BoardsPair, DiffOptions, RigPair, diff

    done = diff(args.a, args.b, DiffOptions(output=args.output, force=args.force))
    figures: dict[str, Any]
    if isinstance(done, BoardsPair):
        figures, words = _boards_figures(done), _boards_in_words(done)
    elif isinstance(done, RigPair):
        figures = _rig_figures(done)
        words = _rigs_in_words(done, figures)
    else:
        figures = _camera_figures(done)
        words = _camera_in_words(figures)
    print_json(figures) if args.json else print(words)
    return ExitCode.CHECK_FAILED if done.same is False else ExitCode.WELL


def _camera_figures(pair: CameraPair) -> dict[str, Any]:
    """Return the figures for programs; `same` is None where a file has no covariance."""
    judged, difference = pair.judged, pair.difference
    return {
        "rms_px": difference.rms_px,
        "max_px": difference.max_px,
        "rotation_deg": difference.rotation_deg,
        "coverage": difference.coverage,
        "predicted_px": None if judged is None else judged.predicted_px,
        "usual_px": None if judged is None else list(judged.usual_px),
        "ratio": None if judged is None else judged.ratio,
        "chance": None if judged is None else judged.chance,
        "verdict": None if judged is None else str(judged.verdict),
        "same": pair.same,
        "same_model": None if judged is None else judged.same_model,
    }


def _camera_in_words(figures: dict[str, Any]) -> str:
    from rigkit.calibration.compare import CameraVerdict

    known = figures["same"] is not None
    line = (
        f"difference {figures['rms_px']:.4f} px rms, {figures['max_px']:.4f} px at most, over "
        f"{100 * figures['coverage']:.0f} % of the image{', where both had boards' if known else ''}, after a rotation "
        f"of {figures['rotation_deg']:.4f} deg\n"
    )
    if not known:
        return line + "no verdict: a file has no covariance"
    low, high = figures["usual_px"]
    at = f" at {figures['rms_px']:.2g} px" if figures["verdict"] == CameraVerdict.UNIMPORTANT else ""
    return line + (
        f"expected of one camera {figures['predicted_px']:.4f} px ({low:.3f} to {high:.3f} in nine of ten cases), "
        f"{figures['ratio']:.2f} times as much is found "
        f"(chance {figures['chance']:.3g}): {figures['verdict']}{at}"
        + ("" if figures["same_model"] else "; the chance allows for what their different models make of one lens")
    )


def _rig_figures(pair: RigPair) -> dict[str, Any]:
    """Return the figures of the mounts, and of the cameras."""
    return {
        "mounts": [asdict(m) for m in pair.mounts.mounts],
        "chance": pair.mounts.chance,
        "cameras": {name: _camera_figures(own) for name, own in pair.cameras.items()},
        "same": pair.same,
    }


def _boards_figures(pair: BoardsPair) -> dict[str, Any]:
    """Return the figures of the boards of every mount."""
    targets = {n: {"boards": [asdict(m) for m in t.mounts], "chance": t.chance} for n, t in pair.targets.items()}
    return {"targets": targets, "same": pair.same}


def _boards_in_words(pair: BoardsPair) -> str:
    lines = [line for target in pair.targets.values() for line in _mounts_in_words(target)]
    chances = ", ".join(f"{target.chance:.3g}" for target in pair.targets.values())
    verdict = "the same mount" if pair.same else "NOT the same mount: a board moved"
    return "\n".join([*lines, f"boards together: chance {chances}; {verdict}"])


def _mounts_in_words(difference: RigDifference) -> list[str]:
    return [
        f"{m.name}: sits {m.shift_mm:.3f} mm and {m.rotation_deg:.4f} deg from where it sat"
        + ("" if m.chance is None else f" (chance {m.chance:.3g})")
        for m in difference.mounts
    ]


def _rigs_in_words(pair: RigPair, figures: dict[str, Any]) -> str:
    lines = _mounts_in_words(pair.mounts)
    lines += [f"{name}: {_camera_in_words(own)}".replace("\n", "; ") for name, own in figures["cameras"].items()]
    if figures["same"] is None:
        return "\n".join([*lines, "no verdict: a file has no covariance"])
    chance = "" if figures["chance"] is None else f"mounts together: chance {figures['chance']:.3g}; "
    verdict = "the same rig" if figures["same"] else "NOT the same rig: a camera or a lens moved"
    return "\n".join([*lines, f"{chance}{verdict}"])
