"""Joint calibration of several cameras, or boards, on one mount. `calibrate.py` runs these steps in order:

- each camera alone: `rigkit.calibration`
- the views: `observations`; rigidly mounted boards: `board_places`, `board_ties`, `board_sizes`
- initial mounts and frames: `frames`
- the joint least squares: `layout`, `state`, `pose_jacobians`, `shape`, `known`, `solver`; outlier frames: `disagree`,
  `joint`
- uncertainty: `lags`, `solved_again`, `displaced`, `uncertainty`
- diagnosis: `verdicts`
- the result: `assemble`, `result`, `board_rig`

`compare` compares two rigs.
"""
