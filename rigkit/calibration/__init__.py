"""Camera and rig calibration from views of boards: `calibrate.py` runs it all, in this order.

- views in, as arrays: `usable`, `observations`; which end of a board is which: `board_orientation`
- a start without any guess: `radial_alignment`, `initialise`, `poses`
- one model by least squares: `state`, `shape`, `camera_prior`, `evidence`, `linearise`, `normal_equations`,
  `solver`, `outliers`, `fit`
- which model and board shape: `folds`, `models_tried`, `choice`, `lens_choice`, `one_model`
- how sure that is: `repeats`, `clustered`, `uncertainty`, `between_models`, `departures`
- what to think of it: `captured`, `coverage`, `neighbours`, `moved`, `changing`, `mixed`, `verdicts`
- what comes out: `assemble`, `result`

`compare` tells two calibrations apart; `posed` and `hand_eye` are for a camera that is known. `rig` does
the same for several cameras, under the same names of files, on top of what is here.
"""
