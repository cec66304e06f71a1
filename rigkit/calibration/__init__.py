"""Camera and rig calibration from views of boards: `calibrate.py` runs it all, in this order.

- views in, as arrays: `usable`, `observations`; which end of a board is which: `board_orientation`
- a start without any guess: `radial_alignment`, `initialise`, `poses`
- one model by least squares: `state`, `shape`, `camera_prior`, `evidence`, `linearise`, `normal_equations`,
  `solver`, `outliers`, `fit`
- which model and board shape: `folds`, `heldout`, `models_tried`, `choice`, `lens_choice`, `one_model`
- how sure that is: `repeats`, `clustered`, `covariance`, `uncertainty`, `between_models`, `departures`, `series`,
  `displaced`
- what to think of it: `captured`, `coverage`, `neighbours`, `moved`, `changing`, `mixed`, `verdicts`
- what comes out: `assemble`, `result`

`compare` tells two calibrations apart; `posed` and `hand_eye` are for a camera that is known.

`rig` does the same for several cameras. Each formula that both need stands here once, and does not ask which it is:
steps and priors in `normal_equations` and `solver`, what repeats in `clustered`, covariances and the boards' mean
motion in `covariance`, steps between poses in `poses`, the squares of what was left out in `state`, how a lens follows
another and what it may do beyond its model in `uncertainty` and `displaced`. A file of `rig` that is called as one here
has only what a rig does there besides, or instead.
"""
