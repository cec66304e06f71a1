"""A focal length that drifts over a session: a zoom or focus that is turned little by little, a lens that warms up.

Each image gives an amount of change of its focal length (`view_evidence`). An error of the lens or board model gives
such amounts, too, which differ with the board's distance, place and tilt; so the trend over time is tested beside
these.
"""

from __future__ import annotations

import numpy as np

from rigkit.calibration.diagnosis.view_evidence import ViewEvidence, columns_of
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import image_center
from rigkit.core.findings import Finding

CHANCE_OF_DRIFT = 0.001
"""Largest p-value of the trend."""
MIN_FOCUS_RATIO = 6.0
"""Variance that the focal lengths of single images explain, for each degree of freedom, over that of the rest."""
MIN_IMAGES_OF_TREND = 10


def drifting(calibration: Calibration, evidence: ViewEvidence) -> Finding | None:
    """Return a finding where the focal length changes with the order of the images."""
    # Imported here: scipy is slow to import, and most calibrations need no test.
    from scipy.special import stdtr

    columns = columns_of(evidence.own.shape[1])["focus"]
    if evidence.changes()["focus"].ratio < MIN_FOCUS_RATIO:
        return None
    views = [calibration.views[k] for k in evidence.views]
    amounts = evidence.explained(columns)[2][:, 0]
    images = {name: k for k, name in enumerate(dict.fromkeys(view.image for view in calibration.views))}
    shown, number = np.unique([images[view.image] for view in views], return_inverse=True)
    freedom = len(shown) - 5
    if len(shown) < MIN_IMAGES_OF_TREND:
        return None
    centre = image_center(calibration.camera.size_px)
    places = np.array(
        [
            (
                np.linalg.norm(view.pixels.mean(axis=0) - centre),
                np.linalg.norm(view.cam_from_board.translation_mm),
                view.cam_from_board.rotation[2, 2],
            )
            for view in views
        ]
    )
    rows = np.column_stack([np.ones(len(views)), shown[number] / (len(images) - 1.0), places, amounts])
    each = np.stack([np.bincount(number, column) for column in rows.T], axis=1) / np.bincount(number)[:, None]
    system, amount = each[:, :-1], each[:, -1]
    system[:, 2:] /= np.maximum(np.abs(system[:, 2:]).max(axis=0), np.finfo(float).tiny)
    step, _, rank, _ = np.linalg.lstsq(system, amount, rcond=None)
    if rank < system.shape[1]:
        return None
    variance = float(((amount - system @ step) ** 2).sum()) / freedom
    sigma = float(np.sqrt(variance * np.linalg.inv(system.T @ system)[1, 1]))
    chance = 2.0 * float(stdtr(freedom, -abs(step[1]) / max(sigma, np.finfo(float).tiny)))
    if chance > CHANCE_OF_DRIFT:
        return None
    return Finding.bad(
        f"the focal length drifts over the session, by {100.0 * abs(step[1]):.1f} % from the first image to the last "
        f"(p = {chance:.1g}): zoom, focus or temperature; the stated uncertainties are invalid",
        "fix zoom and focus, let the camera warm up, and retake all images",
    )
