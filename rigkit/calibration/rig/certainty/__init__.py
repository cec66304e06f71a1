"""The uncertainty of a rig: covariance, model selection, model inadequacy, transfer between cameras."""
