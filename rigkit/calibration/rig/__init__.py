"""Several cameras, or boards, on one mount: calibrated together. `calibrate.py` runs it all, in this order.

- each camera alone: `rigkit.calibration`
- views in: `observations`; boards on one mount: `board_places`, `board_ties`, `board_sizes`
- a start: `frames`
- one least squares: `layout`, `state`, `pose_jacobians` (how views follow from the rig), `shape`, `known`,
  `solver`; what does not fit in it left out: `disagree`, `joint`
- how sure that is: `heldout`, `flatness`, `lags`, `between_models`, `displaced`, `uncertainty`
- what to think of it: `verdicts`
- what comes out: `assemble`, `result`, `board_rig`

`compare` tells two rigs apart.
"""
