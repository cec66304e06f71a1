"""Several cameras, or boards, on one mount: calibrated together."""
