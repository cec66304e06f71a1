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

`compare` tells two calibrations apart; `posed` and `hand_eye` are for a camera that is known.

`rig` does the same for several cameras. Each formula that both need stands here once, and does not ask which it is.
`solving` has steps, priors, steps between poses and the squares of what was left out; `clustered` what repeats;
`covariance` covariances and the boards' mean motion. `uncertainty` and `displaced` have how a lens follows another, and
what it may do beyond its model. A file of `rig` that is called as one here has only what a rig does there besides, or
instead.
"""
