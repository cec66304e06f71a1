"""Findings about a rig, in sentences: `rigkit.calibration.diagnosis.verdicts` for several cameras."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.diagnosis.pupil import modelled_pupil
from rigkit.calibration.diagnosis.verdicts import UNCERTAIN_PX, with_headline
from rigkit.calibration.rig.certainty.uncertainty import transfer_uncertainty
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.findings import Finding, Severity, worst

FEW_SHARED = 5
"""A mount has six parameters: fewer shared boards give hardly any check of it."""
OVERDISPERSED = 2.0
"""Overdispersion from which it is reported."""
WORSE = 1.5
"""Held-out error in the rig over that of the cameras alone, from which it is reported."""
MANY_LEFT_OUT = 0.2


def diagnose_rig(
    rig: RigCalibration, far: Sequence[FarProjection], notes: Sequence[Finding], *, in_force: Collection[str]
) -> tuple[Finding, ...]:
    """Return the verdicts, the headline first; `far` are the uncertainties of the cameras' projections, `notes`
    findings from elsewhere, `in_force` as for `diagnose`."""
    # Effects of a cause that was found are not given another one.
    named = worst(notes) is Severity.BAD
    causes = [
        *notes,
        *_not_converged(rig),
        *_left_out(rig),
        *_worse(rig, named=named),
        *_overdispersed(rig, in_force, named=named),
        *_few_shared(rig),
    ]
    headline, *others = with_headline(rig, causes, list(_uncertain(rig, far)))
    pupils = [
        replace(note, message=f"camera '{camera.name}': {note.message}")
        for camera in rig.cameras
        for note in modelled_pupil(camera.calibration)
    ]
    return (headline, *pupils, *_lags(rig), *others)


def _lags(rig: RigCalibration) -> Iterator[Finding]:
    """Yield a finding with the estimated lags and readouts."""
    if not rig.lags:
        return
    words = [*_lag_words(rig), *_readout_words(rig)]
    yield Finding.good(f"{'; '.join(words)}; board poses are interpolated to these times")


def _lag_words(rig: RigCalibration) -> list[str]:
    """Return words for the lag of each camera."""
    first, out = rig.cameras[0].name, []
    for name, lag in rig.lags.items():
        when = "after" if lag.frames >= 0.0 else "before"
        out.append(
            f"camera '{name}' exposes {abs(lag.frames):.3f} ± {lag.sigma:.3f} frame periods {when} '{first}' (jitter "
            f"{lag.scatter:.3f})"
        )
    return out


def _readout_words(rig: RigCalibration) -> list[str]:
    return [
        f"the rolling shutter of camera '{name}' reads an image in {own.frames:.3f} ± {own.sigma:.3f} frame periods"
        for name, own in rig.readouts.items()
    ]


def _not_converged(rig: RigCalibration) -> Iterator[Finding]:
    if not rig.convergence.converged:
        yield Finding.bad(f"the joint solution did not converge ({rig.convergence.reason})")


def _left_out(rig: RigCalibration) -> Iterator[Finding]:
    total = rig.shared_count + len(rig.left_out)
    if len(rig.left_out) > MANY_LEFT_OUT * total:
        yield Finding.look(
            f"{len(rig.left_out)} of {total} shared board poses are left out as outliers: the views disagree on them",
            "hold rig and boards still during the capture, and trigger the cameras together",
        )


def _few_shared(rig: RigCalibration) -> Iterator[Finding]:
    if len(rig.cameras) >= 2 and rig.shared_count < FEW_SHARED:
        yield Finding.look(
            f"only {rig.shared_count} board poses are seen by several cameras at once",
            f"take at least {FEW_SHARED} frames in which several cameras see the board",
        )


def _uncertain(rig: RigCalibration, far: Sequence[FarProjection]) -> Iterator[Finding]:
    for camera, projection in zip(rig.cameras, far, strict=True):
        worst = projection.worst_px
        if worst > UNCERTAIN_PX:
            yield Finding.bad(
                f"the projection uncertainty of camera '{camera.name}' reaches {worst:.1f} px where boards were seen",
                "take more frames, with the boards tilted",
            )
    transfers = [transfer_uncertainty(rig, a, b) for a, b in combinations([c.name for c in rig.cameras], 2)]
    words = [
        f"'{t.a}' to '{t.b}' by {t.median_px:.1f} px" for t in transfers if t is not None and t.median_px > UNCERTAIN_PX
    ]
    if words:
        yield Finding.bad(
            f"points transferred between cameras are uncertain: {', '.join(words)}",
            "take more frames in which both see the board, or that link them by other cameras",
        )


def _timing(rig: RigCalibration) -> str:
    """Return what may be wrong with the times of the images, in words."""
    return "the cameras' time lags vary" if rig.lags else "the cameras were not exactly synchronised"


def _overdispersed(rig: RigCalibration, in_force: Collection[str], *, named: bool) -> Iterator[Finding]:
    if rig.overdispersion <= OVERDISPERSED:
        return
    what = (
        f"overdispersion: frames disagree {rig.overdispersion:.1f} times as much as corner noise explains (included in "
        "all sigmas)"
    )
    if named:
        yield Finding.look(what)
        return
    automatic = " and ".join(f'{name} = "auto"' for name in ("board_shape", "model") if name not in in_force)
    yield Finding.look(
        f"{what}: boards or lenses depart from their models, or {_timing(rig)}",
        (f"try {automatic}, or " if automatic else "take ") + "a flatter board",
    )


def _worse(rig: RigCalibration, *, named: bool) -> Iterator[Finding]:
    known = [c.heldout_rms_px for c in rig.single if c.heldout_rms_px is not None]
    together = rig.heldout_rms_px
    if together is None or len(known) < len(rig.single):
        return
    typical = float(np.sqrt(np.mean(np.square(known))))
    if together > WORSE * typical:
        several = len(rig.cameras) > 1
        cause = f": {_timing(rig)}, or the rig is not rigid" if several else ": the boards are not rigidly mounted"
        yield Finding.look(
            f"held-out frames are predicted {together / typical:.1f} times worse than by the cameras alone"
            f"{'' if named else cause}"
        )
