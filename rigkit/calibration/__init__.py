"""Calibration of a camera or a rig from views of boards. `calibrate.py` runs these steps in order:

- `views`: the usable views (`usable`) as arrays (`observations`), and the folds of the cross-validation, with
  near-duplicate images in one fold (`repeats`)
- `solving`: initial values (`radial_alignment`, `initialise`, `poses`), then least squares for one camera model
  (`state`, `shape`, `camera_prior`, `evidence`, `linearise`, `normal_equations`, `solver`, `outliers`, `fit`) with a
  cluster-robust covariance (`clustered`)
- `choosing`: model selection by held-out error (`choice`, `models_tried`, `candidate_fits`), the uncertainty that it
  leaves (`between_models`), and boards numbered from the other end (`board_orientation`)
- `certainty`: uncertainty of parameters and projection (`covariance`, `uncertainty`), model inadequacy (`departures`,
  `series`, `displaced`), and which part of the image the boards covered (`coverage`)
- `diagnosis`: of images, residuals and result (`captured`, `moved`, `changing`, `flipped`, `two_kinds`,
  `pupil`, with `view_evidence`), summarised by `verdicts`
- the result: `assemble`, `result` (with `board_shape`, `pupil`)
- a second calibration with a moving entrance pupil, where the residuals indicate one: `with_pupil`

Classes, in the order in which a calibration makes them::

    options of `calibrate`                                  Request            choosing/models_tried
    camera model of one size, to be fitted                  CandidateModel     choosing/models_tried
    least-squares solution                                  Fit                solving/fit
    fitted model with its held-out error                    FittedModel        choosing/choice
    best size and board shape of one camera model           ModelOutcome       choosing/models_tried
    camera with all its models fitted, none chosen yet      CandidateFits      choosing/candidate_fits
    model chosen, alone or together with like cameras       ModelChoice        choosing/candidate_fits
    other model that the images support about as well       RivalFit           choosing/between_models
    result                                                  Calibration        result
    summary of a FittedModel in the result                  Candidate          result
    summary of a RivalFit in the result                     Rival              result

`compare` compares two calibrations; `posed` and `hand_eye` work with a camera that is known.

`rig` calibrates several cameras together. A module of `rig` holds only what differs from the module of the same name
here; formulas that one camera and a rig share are here.
"""
