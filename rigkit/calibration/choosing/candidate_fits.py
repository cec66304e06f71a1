"""One camera with all candidate models fitted: the common part of calibrating it alone and in its rig.

Results are cached, so that a second calibration of the same images does not repeat them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from rigkit.calibration.choosing.choice import FittedModel, models_of
from rigkit.calibration.choosing.lens_choice import lenses_on_boards, lenses_on_flat_boards
from rigkit.calibration.choosing.models_tried import CandidateModel, Request, fit_all, wanted_models
from rigkit.calibration.choosing.one_model import ModelOutcome, solved
from rigkit.calibration.result import Candidate
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.repeats import cluster_numbers
from rigkit.calibration.views.usable import usable_views
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError


@contextmanager
def camera_named_in_errors(name: str, views: Sequence[BoardView]) -> Iterator[None]:
    """Add the camera's name to errors, and the cause where all images are near-duplicates."""
    try:
        yield
    except (InputError, DegenerateError) as error:
        words = str(error)
        images = [view.image for view in views]
        if isinstance(error, DegenerateError) and len(set(images)) > 1:
            place = cluster_numbers(images, [v.board.board_id for v in views], [v.pixels for v in views])
            if not place.any():
                words = (
                    f"calibration: all {len(set(images))} images show the board at the same pose and count as "
                    f"one; move it between images ({words})"
                )
        if not name and words == str(error):
            raise
        raise type(error)(f"camera '{name}': {words}" if name else words) from error


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CandidateFits:
    """A camera with all candidate models fitted to its views.

    Attributes
    ----------
    name : name of the camera in messages, "" for a single camera.
    request : options of the calibration.
    views, dropped, observations : all views, (image, reason) of those not usable, and the usable ones as arrays.
    wanted, options, failed : models to fit, those fitted, and those that failed.
    tried : the options compared on flat boards; with a single model the options themselves.
    """

    name: str
    request: Request
    views: Sequence[BoardView]
    dropped: tuple[tuple[str, str], ...]
    observations: Observations
    wanted: list[CandidateModel]
    options: list[FittedModel]
    failed: list[Candidate]
    tried: list[FittedModel]
    _outcomes: dict[str, ModelOutcome] = field(default_factory=dict)
    _on_boards: dict[str, dict[str, FittedModel]] = field(default_factory=dict)

    def outcome_of(self, model: str) -> ModelOutcome:
        """Return the outcome of a camera model."""
        if model not in self._outcomes:
            with camera_named_in_errors(self.name, self.observations.views):
                own = [option for option in self.options if option.model == model]
                wanted = [one for one in self.wanted if one.camera.model == model]
                self._outcomes[model] = solved(self.observations, own, wanted, self.failed, self.request)
        return self._outcomes[model]

    def on_boards_of(self, model: str, names: Sequence[str]) -> list[FittedModel]:
        """Return the options of the given `names`, compared on the board shapes that a camera model found."""
        done = self._on_boards.setdefault(model, {})
        return lenses_on_boards(self.outcome_of(model), self.tried, names, self.request, done)

    def for_request(self, name: str, views: Sequence[BoardView], request: Request) -> Self | None:
        """Return this camera under another name and pupil option, sharing the cached results; None where the views or
        the other options differ."""
        then, now = ((h.size_px, h.model, h.degree, h.board, h.folds) for h in (self.request, request))
        if then != now or len(views) != len(self.views) or not all(map(_same, self.views, views)):
            return None
        return replace(self, name=name, request=request)


def _same(a: BoardView, b: BoardView) -> bool:
    """Return whether two views are equal; they may be copies from another process."""
    arrays = ((a.grid, b.grid), (a.pixels, b.pixels), (a.sigma_px, b.sigma_px), (a.points(), b.points()))
    named = (a.image, a.board.board_id) == (b.image, b.board.board_id)
    return named and all(np.array_equal(x, y) for x, y in arrays)


def fit_candidates(name: str, views: Sequence[BoardView], request: Request) -> CandidateFits:
    """Return a camera with all models of `request` fitted; raises as `calibrate`, with the camera's name."""
    with camera_named_in_errors(name, views):
        wanted = wanted_models(request)
        used, dropped = usable_views(views, request.size_px)
        observations = Observations.from_views(used)
        options, failed = fit_all(observations, request, wanted)
        several = len(models_of(options)) > 1
        tried = lenses_on_flat_boards(observations, options, request) if several else options
    return CandidateFits(
        name=name,
        request=request,
        views=views,
        dropped=dropped,
        observations=observations,
        wanted=wanted,
        options=options,
        failed=failed,
        tried=tried,
    )
