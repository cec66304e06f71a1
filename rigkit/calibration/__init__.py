"""Camera and rig calibration from views of boards: `calibrate.py` runs it all, in this order.

- `views`: what can be used (`usable`), as arrays (`observations`), and what is left out together (`repeats`, `folds`)
- `solving`: a start (`radial_alignment`, `initialise`, `poses`), then one model by least squares (`state`, `shape`,
  `camera_prior`, `evidence`, `linearise`, `normal_equations`, `solver`, `outliers`, `fit`) with its covariance
  (`clustered`)
- `choosing`: which end of a board is which (`board_orientation`), which model and which board shape (`heldout`,
  `choice`, `models_tried`, `lens_choice`, `one_model`); `between_models` says what that leaves open, `begun` keeps it
  for a rig
- `certainty`, how sure that is: `covariance`, `uncertainty`, `departures`, `series`, `displaced`; `coverage` says where
  boards were
- `judging`: `captured`, `moved`, `changing`, `mixed`, `turned`, `two_kinds`, `pupil` (with `view_evidence` and
  `neighbours`), `verdicts`
- what comes out: `assemble`, `result` (with `board_shape`, `pupil`)
- again with a pupil that moves, where the images ask for it: `with_pupil`

What a calibration is called on its way::

    what was asked for                                  Request              choosing/models_tried
    a model, of one size, that is to be fitted          ModelInQuestion      choosing/models_tried
    solved by least squares                             Fit                  solving/fit
    one of several, with its held-out errors            FittedModel          choosing/choice
    the best size and board shape of one model          ModelOutcome         choosing/one_model
    a camera with all of these, before it is decided    BegunCalibration     choosing/begun
    the model that it gets, of all or with its twins    ModelChoice          choosing/lens_choice
    another that images support as well, with poses     RivalFit             choosing/between_models
    the result                                          Calibration          result
    what the result says of each FittedModel            Candidate            result
    what it says of each RivalFit                       Rival                result

`compare` tells two calibrations separation; `posed` and `hand_eye` are for a camera that is known.

`rig` does the same for several cameras. Each formula that both need stands here once, and does not ask which it is.
`solving` has steps, priors, steps between poses and the squares of what was left out; `clustered` what repeats;
`covariance` covariances and the boards' mean motion. `uncertainty` and `displaced` have how a lens follows another, and
what it may do beyond its model. A file of `rig` that is called as one here has only what a rig does there besides, or
instead.
"""
